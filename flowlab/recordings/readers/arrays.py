"""One episode as arrays, as diffusion policies keep them: an ``.npz`` file, or a folder of ``.npy`` files."""

import zipfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from flowlab.array_files import map_array, map_member
from flowlab.errors import DataError
from flowlab.recordings.base import ImageStream, SampleStream, Streams
from flowlab.recordings.image_files import check_depth
from flowlab.recordings.intrinsics import Intrinsics
from flowlab.recordings.poses import check_poses, pose_stream
from flowlab.recordings.recording_yaml import FILE_NAME, Metadata
from flowlab.recordings.sample_files import check_times, to_float32
from flowlab.recordings.stamps import Timing
from flowlab.text import cut

_OF_TIMES = ("timestamp", "timestamps", "time", "times", "time_s", "ts", "stamps")
NAMES = {
    "color": ("color", "rgb", "img", "image", "images", "colors"),
    "depth": ("depth", "depths", "depth_img"),
    "cloud": ("point_cloud", "pointcloud", "points", "cloud"),
    "state": ("state", "agent_pos", "robot_state", "qpos"),
    "action": ("action", "actions"),
    "time": ("time", "time_s", "timestamp", "timestamps"),
    "intrinsics": ("intrinsics", "K"),
    "pose": (
        "T_world_cam",
        "cam2world",
        "camera_to_world",
        "camera_pose",
        "extrinsics",
        "extrinsic",
        "T_cam_world",
        "world2cam",
        "world_to_camera",
        "poses",
        "camera_poses",
    ),
    "ends": ("episode_ends",),
}
"""What arrays may be called, by what they are."""
TIMED = ("color", "depth", "state", "action")
NAMES |= {f"{what} time": tuple(f"{name}_{t}" for name in NAMES[what] for t in _OF_TIMES) for what in TIMED}
POSES = ("T_world_cam", "cam2world", "camera_to_world")
"""Those of poses whose names say that they map the camera to the world."""
_INVERSE = ("T_cam_world", "world2cam", "world_to_camera")


@dataclass(frozen=True, slots=True)
class _Store:
    """Where arrays lie; pictures are mapped into memory, not read."""

    path: Path
    names: dict[str, str]
    """Name of each array there is, by what it is."""

    def load(self, what: str) -> np.ndarray | None:
        """An array by what it is; None where there is none."""
        if what not in self.names:
            return None
        name = self.names[what]
        return map_array(self.path / f"{name}.npy") if self.path.is_dir() else map_member(self.path, name)


class ArraysReader:
    """Reads arrays with a row per step."""

    name = "arrays"
    expects = "an .npz file or a folder of .npy files with color and depth (img and depth, say)"
    fallback = False

    def probe(self, path: Path) -> bool:
        """Whether arrays of pictures, or of clouds, are there by name."""
        found = _find(path)
        return "cloud" in found or ("color" in found and "depth" in found)

    def read(self, path: Path, given: Metadata) -> Streams:
        """The streams. Arrays of clouds alone are refused, for points have no identity to track."""
        names = _find(path)
        missing = [what for what in ("color", "depth") if what not in names]
        if missing and "cloud" in names:
            raise DataError(
                f"{path}: holds point clouds ('{names['cloud']}') but no color and depth pictures; tracks cannot be "
                "made from clouds, so record or keep the pictures"
            )
        if missing:
            raise DataError(f"{path}: has no array for {missing[0]}; it may be called {', '.join(NAMES[missing[0]])}")
        _check_single(path, names)
        store = _Store(path, names)
        color, depth = store.load("color"), store.load("depth")
        assert color is not None
        assert depth is not None
        _check(store, names, color, depth)
        stamps, depth_stamps = _times(store, len(color), given)
        K = store.load("intrinsics")
        T = None if given.T_world_cam is not None else store.load("pose")
        known: tuple[tuple[str, Metadata], ...] = (
            () if K is None else ((f"{path.name}:{names['intrinsics']}", _known(path, K)),)
        )
        poses = None
        if T is not None and _moves(T):
            poses = _poses(store, T, *stamps)
        elif T is not None:
            known += ((f"{path.name}:{names['pose']}", _pose(path, names["pose"], T)),)
        return Streams(
            _pictures(names["color"], partial(_color, store, color), *stamps),
            _pictures(names["depth"], partial(_depth, store, depth), *depth_stamps),
            state=_samples(store, "state", *stamps),
            action=_samples(store, "action", *stamps),
            known=known,
            used=tuple(f"{name}.npy" for what, name in names.items() if _is_read(what, names)),
            poses=poses,
        )


def _is_read(what: str, names: dict[str, str]) -> bool:
    """Whether an array is used by what it is: times where there is what they are of, one time for all where it is."""
    if what == "time":
        return "color time" not in names or "depth time" not in names
    return what != "cloud" and (not what.endswith(" time") or what.removesuffix(" time") in names)


def _find(path: Path) -> dict[str, str]:
    """What arrays there are, by name; nothing is read of them."""
    present = _present(path)
    return {what: name for what, names in NAMES.items() for name in reversed(names) if name in present}


def _present(path: Path) -> set[str]:
    """Names of the arrays there are."""
    return _members(path) if path.is_file() else {f.stem for f in path.glob("*.npy")}


def _check_single(path: Path, used: dict[str, str]) -> None:
    """Refuse several arrays that are called as one thing, unless they are the same."""
    present = _present(path)
    for what in NAMES.keys() - {"cloud", "ends"}:
        several = [name for name in NAMES[what] if name in present]
        if len(several) < 2:
            continue
        found = [array for name in several if (array := _Store(path, {what: name}).load(what)) is not None]
        if not all(np.array_equal(found[0], other) for other in found[1:]):
            raise DataError(f"{path}: {', '.join(several)} may all be the {what}, and are not the same; keep one, or "
                            "call the others otherwise")  # fmt: skip


def _members(path: Path) -> set[str]:
    """Names of the arrays in an ``.npz`` file."""
    if path.suffix != ".npz":
        return set()
    try:
        with zipfile.ZipFile(path) as file:
            return {n.removesuffix(".npy") for n in file.namelist()}
    except (OSError, zipfile.BadZipFile):
        return set()


def _pictures(name: str, read: Callable[[int], np.ndarray], time_s: np.ndarray, timing: Timing) -> ImageStream:
    """The pictures of an array."""
    return ImageStream(tuple(f"{name}[{k}]" for k in range(len(time_s))), time_s, read, timing)


def _check(store: _Store, names: dict[str, str], color: np.ndarray, depth: np.ndarray) -> None:
    """Refuse arrays that are no color and depth of one episode."""
    path, ends = store.path, store.load("ends")
    if ends is not None and np.size(ends) > 1:
        raise DataError(f"{path}: holds {np.size(ends)} episodes, one after the other; write one file per episode")
    if color.ndim != 4 or 3 not in (color.shape[-1], color.shape[1]):
        raise DataError(
            f"{path}: '{names['color']}' has the shape {cut(str(color.shape))}, expected (steps, height, width, 3)"
        )
    if color.dtype != np.uint8:
        raise DataError(f"{path}: '{names['color']}' has the type {color.dtype}, expected uint8, 0 to 255, RGB")
    if depth.ndim not in (3, 4) or len(color) != len(depth):
        raise DataError(
            f"{path}: '{names['depth']}' has the shape {cut(str(depth.shape))}, expected ({len(color)}, height, width)"
        )
    if 0 in (*color.shape, *depth.shape):
        raise DataError(f"{path}: has no steps, or pictures without a pixel")


def _color(store: _Store, pictures: np.ndarray, index: int) -> np.ndarray:
    """One color picture, channels last."""
    picture = np.asarray(pictures[index])
    return np.ascontiguousarray(picture if picture.shape[-1] == 3 else picture.transpose(1, 2, 0))


def _depth(store: _Store, pictures: np.ndarray, index: int) -> np.ndarray:
    """One depth picture."""
    return check_depth(np.array(pictures[index]))


_Stamps = tuple[np.ndarray, Timing]


def _times(store: _Store, steps: int, given: Metadata) -> tuple[_Stamps, _Stamps]:
    """When every step was, and what is known of that; of color and of depth, which may have times of their own."""
    every = _stamps(store, "time", steps)
    color, depth = (_stamps(store, f"{what} time", steps) for what in ("color", "depth"))
    first = color or every
    if first is not None:
        return first, depth or every or first
    if given.fps is None:
        where = FILE_NAME if store.path.is_dir() else store.path.with_suffix(".yaml").name
        raise DataError(f"{store.path}: has no times; write 'fps: 10' (steps per second) into {where}")
    counted = np.arange(steps) / given.fps, Timing("steps over fps")
    if depth is not None:
        raise DataError(f"{store.path}: '{store.names['depth time']}' has the times of depth, and there are none of "
                        "color; call those 'color_timestamps' or 'timestamp'")  # fmt: skip
    return counted, counted


def _stamps(store: _Store, what: str, steps: int | None) -> _Stamps | None:
    """An array of times, and what is known of them; None where there is none."""
    time_s = store.load(what)
    if time_s is None:
        return None
    count = len(time_s) if steps is None and time_s.ndim else steps
    if time_s.shape != (count,) or time_s.dtype.kind not in "iuf":
        found = f"{time_s.dtype} {cut(str(time_s.shape))}"
        raise DataError(f"{store.path}: '{store.names[what]}' is {found}, expected numbers ({count},)")
    stamps, timing = check_times(store.path, np.asarray(time_s), time_s.dtype.kind in "iu")
    return stamps, replace(timing, source=f"'{store.names[what]}'")


def _samples(store: _Store, what: str, time_s: np.ndarray, timing: Timing) -> tuple[SampleStream, ...]:
    """The rows of state or actions, at their own times where they have some; nothing where there is no such array."""
    values = store.load(what)
    if values is None:
        return ()
    own = _stamps(store, f"{what} time", None)
    stamps, known = own or (time_s, timing)
    if values.ndim != 2 or len(values) != len(stamps) or values.dtype.kind not in "fiu":
        raise DataError(
            f"{store.path}: '{store.names[what]}' is {values.dtype} {values.shape}, "
            f"expected numbers ({len(stamps)}, width)"
        )
    rows = to_float32(values)
    if not np.isfinite(rows).all():
        raise DataError(f"{store.path}: '{store.names[what]}' holds values that are not finite")
    return (SampleStream(what, stamps, rows, known),)


def _known(path: Path, K: np.ndarray) -> Metadata:
    """The intrinsics that a matrix tells."""
    if K.shape[-2:] != (3, 3) or not K.size or K.dtype.kind not in "iuf":
        raise DataError(f"{path}: the intrinsics are {K.dtype} {cut(str(K.shape))}, expected numbers (3, 3)")
    every = K.reshape(-1, 3, 3).astype(float)
    if not np.allclose(every, every[0], rtol=1e-6, atol=1e-6):
        raise DataError(
            f"{path}: the intrinsics change from step to step, expected one camera; write one file for each"
        )
    return Metadata(intrinsics=Intrinsics.from_matrix(every[0]))


def _moves(T: np.ndarray) -> bool:
    """Whether poses are others from step to step."""
    return T.ndim == 3 and T.dtype.kind in "iuf" and len(T) > 1 and not np.allclose(T, T[:1], rtol=0, atol=1e-6)


def _poses(store: _Store, T: np.ndarray, time_s: np.ndarray, timing: Timing) -> SampleStream:
    """The poses of a camera that moves."""
    name = store.names["pose"]
    if name not in POSES:
        raise DataError(
            f"{store.path}: '{name}' {_direction(name)}; camera to world is called 'T_world_cam', else invert it"
        )
    found = check_poses(f"{store.path}: '{name}'", T)
    if len(found) != len(time_s):
        raise DataError(f"{store.path}: '{name}' has {len(found)} poses for {len(time_s)} steps, expected one for each")
    return pose_stream(f"'{name}'", time_s, found, timing)


def _direction(name: str) -> str:
    """What is said of poses that are not called as those of the camera in the world."""
    if name in _INVERSE:
        return "maps the world to the camera, by its name"
    return "does not say whether it maps camera to world or world to camera"


def _pose(path: Path, name: str, T: np.ndarray) -> Metadata:
    """The pose of the camera, where it is the same at every step."""
    advice = f"give the pose of a camera that stands still as 'T_world_cam' in {FILE_NAME}"
    if T.shape[-2:] != (4, 4) or not T.size or T.dtype.kind not in "iuf":
        raise DataError(f"{path}: '{name}' is {T.dtype} {cut(str(T.shape))}, expected numbers (4, 4); {advice}")
    every = T.reshape(-1, 4, 4).astype(float)
    if name not in POSES:
        raise DataError(f"{path}: '{name}' {_direction(name)}; {advice}")
    return Metadata(T_world_cam=every[0].tolist())
