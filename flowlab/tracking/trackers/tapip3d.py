"""TAPIP3D (Zhang et al.): follows points through a cloud of features in the world, given depth and camera poses.

Contract, as read in its public code (``inference.py``, ``utils/inference_utils.py``, ``models/__init__.py``,
``models/point_tracker_3d.py``):

- A model is called with ``rgb_obs`` (1, T, 3, H, W) of 0 to 1, ``depth_obs`` (1, T, H, W) with 0 for no reading,
  ``intrinsics`` (1, T, 3, 3), integer pixel centers, ``extrinsics`` (1, T, 4, 4) from world to camera, and
  ``query_point`` (1, N, 4) as (t, x, y, z) in the world. It gives positions in the world and logits of visibility,
  of which 0.9 and more is visible.
- It slides windows of ``seq_len`` frames by half; where there are fewer frames than one window, the answer is the
  question.
- A checkpoint is ``{"cfg": DictConfig, "weight": state dict}``.
"""

import collections
import importlib
import typing
from pathlib import Path
from typing import Any, ClassVar, Literal

import cv2
import numpy as np

from flowlab.errors import MissingLibraryError
from flowlab.limits import MAX_WEIGHTS_BYTES
from flowlab.records import Clip
from flowlab.tracking.base import Session
from flowlab.tracking.trackers.rgbd import Network, Positions, RgbdSession, RgbdTracker
from flowlab.untrusted import check_regular

_VISIBLE = 0.9
_ITERATIONS = 6
_SUPPORT = 16
"""Side of a grid of points of the first frame that is followed along, as its script does."""
_SETTINGS = (
    *(("dictconfig", "DictConfig"), ("listconfig", "ListConfig"), ("nodes", "AnyNode")),
    *(("base", "Metadata"), ("base", "ContainerMetadata")),
)
"""What settings are made of: modules and classes of OmegaConf."""


class Tapip3d(RgbdTracker):
    """TAPIP3D, in the frame of the world."""

    name: ClassVar[str] = "tapip3d"
    license: ClassVar[str] = (
        "code Apache-2.0, with parts of CoTracker's (CC-BY-NC 4.0, not for commercial use); weights: none found"
    )
    github: ClassVar[str] = "zbw001/TAPIP3D"
    modules: ClassVar[tuple[str, ...]] = ("models", "utils.inference_utils")

    resolution_factor: Literal[1, 2] = 2
    """Pixels of the pictures that the network sees, as a multiple of those it was trained on."""

    @property
    def weights_url(self) -> str:
        """Where the published weights are."""
        return "https://huggingface.co/zbww/tapip3d/resolve/main/tapip3d_final.pth"

    def restore(self, network: Network, file: Path) -> None:
        """Build the network that the file describes, and give it its weights."""
        saved = _read(self.name, file)
        models, settings = network.modules["models"], saved["cfg"]
        with network.code:
            _leave_hub_alone(settings["model"])
            native = settings["train_dataset"]["resolution"]
            network.model = models.from_config(settings["model"], image_size=native)
            network.model.load_state_dict(saved["weight"], strict=True)
            network.model.set_eval_mode("raw")
        height, width = (int(side * self.resolution_factor**0.5) for side in native)
        network.size = height, width

    def session(self, network: Network, clip: Clip, device: str) -> Session:
        """A session; the pictures are resized for every question."""
        return _Session(self, network, clip, device, network.model.seq_len)


def _read(name: str, file: Path) -> Any:
    """What a checkpoint holds. Its settings are objects of OmegaConf's; of all others none is made."""
    import torch

    try:
        known = [getattr(importlib.import_module(f"omegaconf.{module}"), kind) for module, kind in _SETTINGS]
    except ImportError as error:
        raise MissingLibraryError(
            f"tracker '{name}': its weights hold settings of the Python package omegaconf; type: pip install hydra-core"
        ) from error
    check_regular(file, MAX_WEIGHTS_BYTES)
    with torch.serialization.safe_globals([*known, typing.Any, collections.defaultdict, dict, list, int]):
        saved = torch.load(file, map_location="cpu", weights_only=True)
    if not {"cfg", "weight"} <= set(saved):
        raise ValueError(f"holds {', '.join(map(str, list(saved)[:3]))}, expected cfg and weight")
    return saved


def _leave_hub_alone(settings: Any) -> None:
    """Keep the encoder from downloading CoTracker's weights, which the file's own replace anyway."""
    if "pretrained" in settings["encoder"]:
        with importlib.import_module("omegaconf").open_dict(settings):
            settings["encoder"]["pretrained"] = False


class _Session(RgbdSession):
    """One call for all frames."""

    def positions(self, clip: Clip, queries_txy: np.ndarray, z: np.ndarray) -> Positions:
        """The network's answer."""
        import torch

        def tensor(values: np.ndarray) -> Any:
            return torch.from_numpy(values.astype(np.float32))[None].to(self._device)

        scene = {k: tensor(v) for k, v in _resized(clip, self._network.size).items()}
        queries = tensor(_in_world(clip, queries_txy, z))
        support = self._network.modules["utils.inference_utils"].get_grid_queries(
            _SUPPORT, depths=scene["depth_obs"], intrinsics=scene["intrinsics"], extrinsics=scene["extrinsics"]
        )
        self._network.model.set_image_size(self._network.size)
        with torch.autocast("cuda", dtype=torch.bfloat16, enabled=self._device == "cuda"):
            said, _ = self._network.model(
                **scene,
                query_point=torch.cat([queries, support], 1),
                num_iters=_ITERATIONS,
                mode="inference",
                depth_roi=tensor(_depth_range(clip.depth))[0],
            )
        xyz_world, logits = (v[0, :, : len(z)].float().cpu() for v in (said.coords, said.visibs))
        seen = torch.sigmoid(logits).numpy()
        return Positions(clip.to_camera(xyz_world.numpy().astype(float)), seen >= _VISIBLE, seen)


def _resized(clip: Clip, size: tuple[int, int]) -> dict[str, np.ndarray]:
    """Pictures, depth and calibration of a clip at another size; depth is not interpolated, so that it has no edges."""
    height, width = size
    scale = np.array([width / clip.camera.width, height / clip.camera.height])
    K = clip.camera.K.copy()
    K[:2, :2] *= scale[:, None]
    K[:2, 2] = (K[:2, 2] + 0.5) * scale - 0.5
    rgb = np.stack([cv2.resize(p, (width, height), interpolation=cv2.INTER_LINEAR) for p in clip.rgb])
    depth = np.stack([cv2.resize(d, (width, height), interpolation=cv2.INTER_NEAREST_EXACT) for d in clip.depth])
    return {
        "rgb_obs": rgb.transpose(0, 3, 1, 2) / np.float32(255),
        "depth_obs": depth,
        "intrinsics": np.broadcast_to(K, (len(clip), 3, 3)),
        "extrinsics": np.linalg.inv(clip.poses()),
    }


def _in_world(clip: Clip, queries_txy: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Queries (N, 4) as (t, x, y, z) in the world."""
    xyz_cam = clip.camera.at(np.eye(4)).unproject(queries_txy[:, 1:].astype(float), z)
    T = clip.poses()[queries_txy[:, 0].astype(int)]
    xyz_world = (T[:, :3, :3] @ xyz_cam[..., None])[..., 0] + T[:, :3, 3]
    return np.concatenate([queries_txy[:, :1], xyz_world], 1)


def _depth_range(depth: np.ndarray) -> np.ndarray:
    """Depths (least, most) of which the network takes its unit: most is 1.5 interquartile ranges above the third."""
    values = depth[depth > 0]
    quarters = [max(int(share * len(values)), 1) - 1 for share in (0.25, 0.75)]
    low, high = np.partition(values, quarters)[quarters]
    return np.array([1e-7, high + 1.5 * (high - low)])
