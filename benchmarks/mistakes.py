"""Mistakes that people make with recordings of an RGB-D camera, for ``wrong_recordings.py``."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Literal

import cv2
import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from flowlab.geometry.transforms import inverse, rigid
from flowlab.recordings.recording_yaml import FILE_NAME

Pictures = tuple[np.ndarray, ...]
_LOST = 4
"""Frames of a stream that its recorder lost."""


@dataclass(frozen=True)
class Film:
    """A recording in memory: what a plain folder holds."""

    color: Pictures
    """BGR."""
    depth: Pictures
    """16 bits."""
    time_s: tuple[float, ...]
    K: np.ndarray
    depth_unit_m: float
    T_world_cam: np.ndarray | None
    """Of a camera whose poses are known."""
    still: bool
    """Whether the camera does not move."""
    stands: np.ndarray | None = None
    """T_world_cam of a camera that does not move, where it is known."""
    state: np.ndarray | None = None
    """Of the robot, whose first three numbers are its gripper's position in the world [m]; a row for every picture."""

    def write(self, folder: Path) -> None:
        """Write it as a plain folder."""
        for name, pictures in (("color", self.color), ("depth", self.depth)):
            (folder / name).mkdir(parents=True)
            for k, picture in enumerate(pictures):
                path = str(folder / name / f"{k:06d}.png")
                cv2.imwrite(path, picture, [cv2.IMWRITE_PNG_COMPRESSION, 1])
        (folder / "times.txt").write_text("".join(f"{t!r}\n" for t in self.time_s))
        numbers = {"fx": self.K[0, 0], "fy": self.K[1, 1], "cx": self.K[0, 2], "cy": self.K[1, 2]}
        about = {"times": "times.txt", "depth_unit_m": self.depth_unit_m,
                 "intrinsics": {k: float(v) for k, v in numbers.items()}}  # fmt: skip
        if self.T_world_cam is not None:
            np.save(folder / "T_world_cam.npy", self.T_world_cam)
            about["T_world_cam_file"] = "T_world_cam.npy"
        if self.stands is not None:
            about["T_world_cam"] = self.stands.tolist()
        if self.state is not None:
            np.save(folder / "state.npy", self.state)
            about["state"] = "state.npy"
        (folder / FILE_NAME).write_text(yaml.safe_dump(about))

    def rows(self, color: np.ndarray, depth: np.ndarray) -> "Film":
        """So many rows of these pictures, with the times and poses of their color pictures."""
        count = min(len(color), len(depth))
        color, depth = color[:count], depth[:count]
        return replace(
            self, color=tuple(self.color[k] for k in color), depth=tuple(self.depth[k] for k in depth),
            time_s=tuple(self.time_s[k] for k in color),
            T_world_cam=None if self.T_world_cam is None else self.T_world_cam[color],
            state=None if self.state is None else self.state[color],
        )  # fmt: skip


Change = Callable[[Film], Film]


@dataclass(frozen=True)
class Mistake:
    """Something that is done wrong."""

    make: Change
    still: bool = False
    """Whether only a camera that does not move is asked."""
    posed: bool = False
    """Whether only a camera whose poses are known is asked."""
    stood: bool = False
    """Whether only a camera that does not move, and whose pose is known, is asked."""
    acting: bool = False
    """Whether only recordings with a state are."""

    def concerns(self, film: Film) -> bool:
        """Whether it can be made with this film."""
        return (
            (film.still or not self.still)
            and (film.T_world_cam is not None or not self.posed)
            and (film.stands is not None or not self.stood)
            and (film.state is not None or not self.acting)
        )


def _late(frames: int) -> Change:
    """Depth was taken so many frames after color, or before."""

    def make(film: Film) -> Film:
        k = np.arange(len(film.color) - abs(frames))
        return film.rows(k + max(frames, 0), k + max(-frames, 0))

    return make


def _with_depth(change: Callable[[np.ndarray, Film], np.ndarray]) -> Change:
    return lambda film: replace(film, depth=tuple(change(d, film) for d in film.depth))


def _with_color(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    return lambda film: replace(film, color=tuple(change(c) for c in film.color))


def _unit(share: float) -> Change:
    return lambda film: replace(film, depth_unit_m=film.depth_unit_m * share)


def _focal(share: float) -> Change:
    return lambda film: replace(film, K=film.K * [[share, 1, 1], [1, share, 1], [1, 1, 1]])


def _from_beside(meters: float) -> Change:
    """Depth as another camera sees it, so far to the side."""

    def change(depth: np.ndarray, film: Film) -> np.ndarray:
        moved = np.zeros_like(depth)
        v, u = np.nonzero(depth)
        to = np.rint(u + meters * film.K[0, 0] / (depth[v, u] * film.depth_unit_m)).astype(int)
        inside = to < depth.shape[1]
        moved[v[inside], to[inside]] = depth[v[inside], u[inside]]
        return moved

    return _with_depth(change)


def _wider(depth: np.ndarray, film: Film) -> np.ndarray:
    """As a camera sees it whose lens is wider by a quarter."""
    height, width = depth.shape
    smaller = np.array([[0.8, 0, 0.1 * width], [0, 0.8, 0.1 * height]])
    return cv2.warpAffine(depth, smaller, (width, height), flags=cv2.INTER_NEAREST)


def _disparity(depth: np.ndarray, film: Film) -> np.ndarray:
    seen = np.maximum(depth * film.depth_unit_m, 0.1)
    return np.where(depth > 0, np.rint(30 * film.K[0, 0] * 0.05 / seen), 0).astype(np.uint16)


def _frozen(stream: Literal["color", "depth"]) -> Change:
    """One stream stands still for the second third."""

    def make(film: Film) -> Film:
        k, held = np.arange(len(film.color)), _held(len(film.color))
        frozen = film.rows(held, k) if stream == "color" else film.rows(k, held)
        return replace(frozen, time_s=film.time_s, T_world_cam=film.T_world_cam, state=film.state)

    return make


def _lost(film: Film) -> Film:
    """Frames of depth were lost, and what is left was numbered on."""
    k = np.arange(len(film.color))
    return film.rows(k, np.delete(k, np.arange(len(k) // 3, len(k) // 3 + _LOST)))


def _as_text(film: Film) -> Film:
    """Pictures in the order of their numbers as text, but times: 0, 1, 10, 11, ..."""
    order = sorted(range(len(film.color)), key=str)
    sorted_as_text = film.rows(np.array(order), np.array(order))
    return replace(sorted_as_text, time_s=film.time_s, T_world_cam=film.T_world_cam, state=film.state)


def _bumped(film: Film) -> Film:
    """From the middle on, the camera looks elsewhere."""
    height, width = film.depth[0].shape
    shift = np.array([[1, 0, 0.05 * width], [0, 1, 0.02 * height]])

    def after(pictures: Pictures, border: int) -> Pictures:
        return tuple(
            p
            if 2 * k < len(pictures)
            else cv2.warpAffine(p, shift, (width, height), flags=cv2.INTER_NEAREST, borderMode=border)
            for k, p in enumerate(pictures)
        )

    color, depth = after(film.color, cv2.BORDER_REPLICATE), after(film.depth, cv2.BORDER_CONSTANT)
    return replace(film, color=color, depth=depth)


def _poses(change: Callable[[np.ndarray], np.ndarray]) -> Mistake:
    def make(film: Film) -> Film:
        assert film.T_world_cam is not None
        return replace(film, T_world_cam=change(film.T_world_cam))

    return Mistake(make, posed=True)


def _stands(change: Callable[[np.ndarray], np.ndarray]) -> Mistake:
    def make(film: Film) -> Film:
        assert film.stands is not None
        return replace(film, stands=change(film.stands))

    return Mistake(make, stood=True)


def _turned(degrees: float) -> Mistake:
    """About an axis that is none of the camera's."""
    R = Rotation.from_rotvec(np.radians(degrees) * np.array([0.6, 0.64, 0.48])).as_matrix()
    return _stands(lambda T: rigid(T[:3, :3] @ R, T[:3, 3]))


def _with_state(change: Callable[[np.ndarray], np.ndarray]) -> Mistake:
    def make(film: Film) -> Film:
        assert film.state is not None
        return replace(film, state=change(film.state))

    return Mistake(make, acting=True)


def _scaled(share: float) -> Mistake:
    return _poses(lambda T: rigid(T[:, :3, :3], T[:1, :3, 3] + share * (T[:, :3, 3] - T[:1, :3, 3])))


def _held(count: int) -> np.ndarray:
    """Which of so many is shown where the second third stands still."""
    k = np.arange(count)
    return np.where((k >= count // 3) & (k < 2 * count // 3), count // 3, k)


def _other_quaternions(T: np.ndarray) -> np.ndarray:
    """Quaternions written as w, x, y, z and read as x, y, z, w."""
    xyzw = Rotation.from_matrix(T[:, :3, :3]).as_quat()
    return rigid(Rotation.from_quat(np.roll(xyzw, 1, axis=1)).as_matrix(), T[:, :3, 3])


def _of_the_hand(T: np.ndarray) -> np.ndarray:
    """Poses of the hand that the camera is mounted on: 6 cm behind, turned by 30 degrees."""
    return T @ rigid(Rotation.from_euler("x", 30, degrees=True).as_matrix(), np.array([0.0, 0.0, -0.06]))


_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])

MISTAKES = MappingProxyType(
    {
        "none": Mistake(lambda film: film),
        "depth 1 frame late": Mistake(_late(1)),
        "depth 3 frames late": Mistake(_late(3)),
        "depth 3 frames early": Mistake(_late(-3)),
        "4 frames of depth lost": Mistake(_lost),
        "depth frozen for a third": Mistake(_frozen("depth")),
        "color frozen for a third": Mistake(_frozen("color")),
        "order of names as text": Mistake(_as_text),
        "depth unit x 10": Mistake(_unit(10)),
        "depth unit / 10": Mistake(_unit(0.1)),
        "depth unit x 2": Mistake(_unit(2)),
        "depth unit / 4": Mistake(_unit(0.25)),
        "disparity as depth": Mistake(_with_depth(_disparity)),
        "depth mirrored": Mistake(_with_depth(lambda depth, _: depth[:, ::-1])),
        "depth upside down": Mistake(_with_depth(lambda depth, _: depth[::-1, ::-1])),
        "depth from 25 mm beside": Mistake(_from_beside(0.025)),
        "depth from 55 mm beside": Mistake(_from_beside(0.055)),
        "depth of a wider lens": Mistake(_with_depth(_wider)),
        "red for blue": Mistake(_with_color(lambda color: color[..., ::-1])),
        "color mirrored": Mistake(_with_color(lambda color: color[:, ::-1])),
        "K of pictures twice as large": Mistake(lambda film: replace(film, K=film.K * [[2], [2], [1]])),
        "cx for cy": Mistake(lambda film: replace(film, K=_other_center(film.K))),
        "focal length / 2": Mistake(_focal(0.5)),
        "focal length x 1.3": Mistake(_focal(1.3)),
        "focal length x 1.1": Mistake(_focal(1.1)),
        "camera bumped": Mistake(_bumped, still=True),
        "poses inverted": _poses(inverse),
        "poses in OpenGL's axes": _poses(lambda T: T @ _OPENGL),
        "poses in millimeters": _poses(lambda T: rigid(T[:, :3, :3], 1000 * T[:, :3, 3])),
        "poses of the hand": _poses(_of_the_hand),
        "quaternions w first": _poses(_other_quaternions),
        "rotations transposed": _poses(lambda T: rigid(T[:, :3, :3].swapaxes(1, 2), T[:, :3, 3])),
        "poses backward": _poses(lambda T: T[::-1]),
        "poses 5 frames late": _poses(lambda T: T[np.maximum(np.arange(len(T)) - 5, 0)]),
        "poses frozen for a third": _poses(lambda T: T[_held(len(T))]),
        "poses x 0.7": _scaled(0.7),
        "poses x 1.5": _scaled(1.5),
        "T_world_cam turned by 10 degrees": _turned(10),
        "T_world_cam turned by 30 degrees": _turned(30),
        "T_world_cam turned by 90 degrees": _turned(90),
        "T_world_cam inverted": _stands(inverse),
        "T_world_cam in OpenGL's axes": _stands(lambda T: T @ _OPENGL),
        "state 5 frames late": _with_state(lambda s: s[np.maximum(np.arange(len(s)) - 5, 0)]),
        "state in millimeters": _with_state(lambda s: np.concatenate([1000 * s[:, :3], s[:, 3:]], 1)),
    }
)
"""By name."""


def _other_center(K: np.ndarray) -> np.ndarray:
    swapped = K.copy()
    swapped[:2, 2] = K[1, 2], K[0, 2]
    return swapped
