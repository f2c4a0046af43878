"""What trackers share that take color and depth and hand over 3D: a checkout of code, CUDA, camera coordinates."""

import importlib
from abc import abstractmethod
from dataclasses import dataclass
from types import ModuleType
from typing import Any, ClassVar, Literal, NamedTuple, Self

import numpy as np
from jaxtyping import Bool, Float, Float32
from pydantic import DirectoryPath
from scipy.ndimage import distance_transform_edt

from flowlab.errors import FlowlabError, MissingLibraryError
from flowlab.records import Clip, Tracks2D
from flowlab.tracking.trackers.checkout import Checkout
from flowlab.tracking.trackers.weights import PretrainedSession, PretrainedTracker, brief, import_advice

_NEAREST_M = 0.05
"""What is nearer to the camera than this, or behind it, is no position."""


class RgbdTracker(PretrainedTracker):
    """A tracker whose network takes color, depth and calibration, and says where points are in 3D.

    It wants the clip whole, since chunks keep nothing of what is said in 3D. Its code calls CUDA itself.
    """

    chunked: ClassVar[bool] = False
    github: ClassVar[str]
    """Where the code is."""
    modules: ClassVar[tuple[str, ...]]
    """What is used of it."""

    device: Literal["auto", "cuda"] = "auto"
    """What the network runs on: CUDA, in either case."""
    repo: DirectoryPath | None = None
    """Folder of a checkout of the code, which is no package that could be installed."""

    def build(self) -> "Network":
        """The code; the network comes with its weights."""
        if self.repo is None:
            raise MissingLibraryError(
                f"tracker '{self.name}' needs the code of {self.github}; type: git clone --recursive "
                f"https://github.com/{self.github}, install what its README asks for, and set the tracker's option "
                "repo to that folder (--set track.options.repo=FOLDER)"
            )
        code = Checkout(self.repo)
        try:
            with code:
                return Network(code, {name: importlib.import_module(name) for name in self.modules})
        except Exception as error:  # whatever code of others may raise while it is imported
            raise MissingLibraryError(
                f"tracker '{self.name}': the code in {self.repo} cannot be imported ({brief(error)}); "
                f"{import_advice(error) or self._advice(error)}"
            ) from error

    def _advice(self, error: Exception) -> str:
        """What to type where something is not there."""
        missing = getattr(error, "name", None) or ""
        if not missing or any(f"{module}.".startswith(f"{missing}.") for module in self.modules):
            return f"expected a checkout: git clone --recursive https://github.com/{self.github}"
        return f"install {missing.partition('.')[0]} as {self.repo}/README.md says"

    def _device(self) -> str:
        """CUDA."""
        if super()._device() != "cuda":
            raise MissingLibraryError(
                f"tracker '{self.name}' runs on CUDA only, since its code calls it itself, and torch finds none here; "
                "use a machine with an NVIDIA GPU, or another tracker, such as 'rigid-bodies'"
            )
        return "cuda"


@dataclass
class Network:
    """A network, once it has its weights, with the code that it needs while it runs."""

    code: Checkout
    modules: dict[str, ModuleType]
    model: Any = None
    size: tuple[int, int] = (0, 0)
    """Height and width of the pictures it is given, where it does not resize them itself."""

    def eval(self) -> Self:
        """Get ready to be used."""
        self.model.eval()
        return self

    def to(self, device: str) -> Self:
        """Move to a device. (What the model's own ``to`` returns is not to be relied on.)"""
        self.model.to(device)
        return self


class Positions(NamedTuple):
    """What a network says of N points in T frames."""

    xyz_cam: Float[np.ndarray, "T N 3"]
    """In the camera's frame [m]."""
    visible: Bool[np.ndarray, "T N"]
    confidence: Float[np.ndarray, "T N"]


class RgbdSession(PretrainedSession):
    """Answers in 3D. A point that has no depth reading at its own frame is not followed: held, and not visible."""

    def __init__(self, tracker: RgbdTracker, network: Network, clip: Clip, device: str, least: int) -> None:
        """``least``: frames below which the network says nothing; a shorter part is held at its last frame."""
        self._tracker, self._network, self._clip, self._device, self._least = tracker, network, clip, device, least

    @abstractmethod
    def positions(self, clip: Clip, queries_txy: Float32[np.ndarray, "N 3"], z: Float32[np.ndarray, "N"]) -> Positions:
        """What the network says of points with a depth z [m] in a clip, where t counts from its first frame."""

    def follow(self, queries_txy: Float32[np.ndarray, "M 3"], start: int, stop: int) -> Tracks2D:
        """Follow the points that have a depth."""
        rows = np.minimum(np.arange(start, max(stop, start + self._least)), stop - 1)
        whole, length = self._clip, stop - start
        poses = None if whole.T_world_cam is None else whole.T_world_cam[rows]
        part = Clip(whole.rgb[rows], whole.depth[rows], whole.camera, poses)
        z = _readings(part.depth, queries_txy)
        known = np.flatnonzero(z > 0)
        if len(known) == 0:
            return _placed(part, queries_txy, known, z, None, length)
        return _placed(part, queries_txy, known, z, self._said(part, queries_txy[known], z[known]), length)

    def _said(self, part: Clip, queries_txy: np.ndarray, z: np.ndarray) -> Positions:
        """What the network says; whatever goes wrong in its code is one sentence."""
        import torch

        try:
            with self._network.code:
                return self.positions(part, queries_txy, z)
        except torch.OutOfMemoryError as error:
            raise FlowlabError(
                f"tracker '{self._tracker.name}': {len(part)} frames with {len(z)} points need more memory than the "
                "GPU has; give shorter recordings, fewer points (--set queries.points=N), or a larger GPU"
            ) from error
        except Exception as error:
            raise FlowlabError(
                f"tracker '{self._tracker.name}': its code fails ({type(error).__name__}: {brief(error)}); "
                f"{self._tracker.repo} may be of another version than docs/trackers.md names"
            ) from error


def _readings(depth: Float32[np.ndarray, "T H W"], queries_txy: np.ndarray) -> np.ndarray:
    """The depth [m] read at each query's own frame and nearest pixel; 0 where none is."""
    t, x, y = np.rint(queries_txy).astype(int).T
    inside = (x >= 0) & (y >= 0) & (x < depth.shape[2]) & (y < depth.shape[1])
    x, y = np.where(inside, x, 0), np.where(inside, y, 0)
    return np.where(inside, depth[t, y, x], np.float32(0))


def _placed(
    clip: Clip, queries_txy: np.ndarray, known: np.ndarray, z: np.ndarray, said: Positions | None, length: int
) -> Tracks2D:
    """Tracks of all queries through ``length`` frames, of which those ``known`` are where the network says."""
    shape = (length, len(queries_txy))
    xy = np.broadcast_to(queries_txy[:, 1:], (*shape, 2)).astype(np.float32)
    xyz, visible, confidence = np.zeros((*shape, 3), np.float32), np.zeros(shape, bool), np.zeros(shape, np.float32)
    if said is not None:
        camera = clip.camera.at(np.eye(4))
        t = queries_txy[known, 0].astype(int)
        found = np.array(said.xyz_cam, float)
        found[t, np.arange(len(t))] = camera.unproject(queries_txy[known, 1:].astype(float), z[known])
        found = found[:length]
        there = np.isfinite(found).all(-1) & (found[..., 2] > _NEAREST_M)
        found[~there] = (0, 0, 1)
        uv, _ = camera.project(found)
        size = np.array([clip.camera.width, clip.camera.height])
        inside = ((uv > -0.5) & (uv < size - 0.5)).all(-1)
        xy[:, known] = np.where(there[..., None], uv.clip(-size, 2 * size), xy[:, known])
        xyz[:, known] = np.where(there[..., None], found, 0)
        visible[:, known] = said.visible[:length] & there & inside
        confidence[:, known] = np.where(there, said.confidence[:length].clip(0, 1), 0)
    return Tracks2D(xy, visible, confidence, xyz_cam=xyz)


def without_holes(depth: Float32[np.ndarray, "T H W"]) -> Float32[np.ndarray, "T H W"]:
    """Depth with every hole filled by the nearest reading of its picture, or of the picture nearest in time."""
    seen = np.flatnonzero((depth > 0).any((1, 2)))
    filled = np.empty_like(depth)
    for t in range(len(depth)):
        source = depth[seen[np.abs(seen - t).argmin()]]
        at = distance_transform_edt(source <= 0, return_distances=False, return_indices=True)
        filled[t] = source[tuple(at)]
    return filled
