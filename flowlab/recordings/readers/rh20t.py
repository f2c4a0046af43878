"""RH20T's timestamped folders, which RISE and MBA use too.

<episode>/metadata.json, timestamp.txt, cam_<serial>/{color,depth}/<ms>.png,
tcp/<ms>.npy and gripper_command/<ms>.npy in the episode or in the camera's folder;
calib/<calibration>/{intrinsics,extrinsics}.npy beside the episode or above it
"""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flowlab.array_files import load_array
from flowlab.errors import DataError
from flowlab.geometry.transforms import inverse
from flowlab.recordings.base import SampleStream, Streams
from flowlab.recordings.image_files import COLOR_SUFFIXES, color_stream, depth_stream, list_images
from flowlab.recordings.intrinsics import Intrinsics
from flowlab.recordings.readers.safe_pickle import pickled_numbers
from flowlab.recordings.recording_yaml import FILE_NAME, Metadata, check_rigid
from flowlab.recordings.sample_files import to_float32
from flowlab.recordings.stamps import Timing
from flowlab.recordings.unused_files import unread_keys
from flowlab.recordings.verdicts import Check, Verdict
from flowlab.text import cut, is_plain_name, shown
from flowlab.untrusted import read_json, read_text

_MAX_ROW_BYTES = 1 << 20
_LATEST_MS = 1e15
"""In the year 33658."""
_LENS = re.compile(r"dist|lens|coef")
"""What files of distortion are called."""
_KNOWN = {"finish_time", "rating", "calib", "calib_quality", "task", "task_id", "user", "user_id", "scene", "scene_id"}
"""Keys of metadata.json that are read, or tell nothing of where and when things were."""
_OTHERS = (
    "gripper", "joint", "tcp_base", "force_torque", "force_torque_base", "high_freq_data", "transformed", "audio*",
)  # fmt: skip
"""Folders of RH20T that are not used where there is state."""
STATE = ("tcp", "gripper_command")
"""Folders of robot state, in the order of its columns."""


class RH20TReader:
    """Reads one camera of an episode."""

    name = "rh20t"
    expects = "an episode folder with cam_<serial>/color and cam_<serial>/depth"
    fallback = False

    def probe(self, path: Path) -> bool:
        """Whether it is an episode, or the folder of a camera in one."""
        return bool(_cameras(path)) or (path.name.startswith("cam_") and _has_pictures(path))

    def read(self, path: Path, given: Metadata) -> Streams:
        """The streams of one camera, color up to the ``finish_time`` of ``metadata.json``; names are milliseconds."""
        folder = path if _has_pictures(path) else _choose(path, given.camera)
        episode, serial = folder.parent, folder.name.removeprefix("cam_")
        about, keys = _about(episode / "metadata.json")
        told = unread_keys("metadata.json", keys, "", given.ignore)
        unread = tuple(f"metadata.json:{key}" for key in keys)
        stop_ms = float(about.get("finish_time", np.inf))
        color = _timed(folder / "color", COLOR_SUFFIXES, stop_ms)
        depth = _timed(folder / "depth", (".png",))
        calibration, checks = _calibration(episode, serial, about)
        success = {"success": float(about["rating"]) > 1} if "rating" in about else {}
        l515 = re.fullmatch(r"f\d{7}", serial) is not None
        known = Metadata(depth_unit_m=0.00025 if l515 else 0.001, **success)
        custom = f"the custom of RH20T for {'an L515' if l515 else 'all but the L515'}, by the serial {shown(serial)}"
        return Streams(
            color_stream(*color),
            depth_stream(*depth),
            state=_state([folder, episode]),
            known=(*calibration, (custom, known)),
            registered=True,
            checks=(*checks, *told, *_after_finish(folder, len(color[0]))),
            used=_used(path, folder, color[0], depth[0]),
            passed_over=_passed_over(path, folder, np.isfinite(stop_ms)),
            unread=unread,
        )


def _used(path: Path, folder: Path, *pictures: list[Path]) -> tuple[str, ...]:
    """The files of an episode that are read, below the recording."""
    of_episode = [folder.parent / name for name in ("metadata.json", "timestamp.txt")]
    state = [f for where in _state_folders([folder, folder.parent]) for f in list_images(where, (".npy",))]
    every = (*of_episode, *state, *(f for files in pictures for f in files))
    return tuple(f.relative_to(path).as_posix() for f in every if f.is_relative_to(path))


def _passed_over(path: Path, folder: Path, timed: bool) -> tuple[tuple[str, str], ...]:
    """What such episodes have beside what is used."""
    others = [c.relative_to(path).as_posix() for c in _cameras(path) if c != folder]
    known = [(name, "of another camera") for name in others]
    color = (folder / "color").relative_to(path).as_posix()
    known += [(f"{color}/*{suffix}", "taken after 'finish_time'") for suffix in COLOR_SUFFIXES if timed]
    if _state_folders([folder, folder.parent]):
        known += [(f"{at}{name}", "RH20T's other numbers of the robot") for at in ("", "*/") for name in _OTHERS]
    return (*known, *((f"{at}timestamps.npy", "the names tell the times") for at in ("", "*/")))


def _after_finish(folder: Path, count: int) -> tuple[Check, ...]:
    """What is said of color pictures that were taken after the end of the demonstration."""
    late = len(list_images(folder / "color", COLOR_SUFFIXES)) - count
    says = f"{late} color pictures after the 'finish_time' of metadata.json are not used"
    return (Check("finish time", Verdict.OK, says),) if late else ()


def _has_pictures(folder: Path) -> bool:
    """Whether it is the folder of a camera."""
    return (folder / "color").is_dir() and (folder / "depth").is_dir()


def _cameras(episode: Path) -> list[Path]:
    """The folders of the cameras of an episode."""
    return sorted(f for f in episode.glob("cam_*") if _has_pictures(f)) if episode.is_dir() else []


def _choose(episode: Path, serial: str | None) -> Path:
    """The folder of the camera that is asked for, or of the only one."""
    cameras = _cameras(episode)
    if not cameras:
        raise DataError(f"{episode}: has no folder cam_<serial> with color/ and depth/ in it")
    serials = [c.name.removeprefix("cam_") for c in cameras]
    if serial is None and len(cameras) == 1:
        return cameras[0]
    if serial in serials:
        return cameras[serials.index(serial)]
    found = f"has no camera {serial}" if serial is not None else f"has {len(cameras)} cameras"
    raise DataError(
        f"{episode}: {found}; choose one of {', '.join(serials)} in {FILE_NAME} or the calibration file, "
        f"with 'camera: \"{serials[0]}\"'"
    )


def _about(file: Path) -> tuple[dict[str, Any], list[str]]:
    """What ``metadata.json`` says that matters here, and its keys that are not RH20T's."""
    if not file.is_file():
        return {}, []
    values = read_json(file, "correct it, or delete it")
    if not isinstance(values, dict):
        raise DataError(f"{file}: holds {shown(values)}, expected names and values")
    found = {k: values[k] for k in ("finish_time", "rating", "calib") if values.get(k) is not None}
    for key in ("finish_time", "rating"):
        if key in found and not (isinstance(found[key], int | float) and abs(found[key]) < _LATEST_MS):
            raise DataError(f"{file}: '{key}' is {shown(found[key])}, expected a number")
    return found, sorted(map(str, values.keys() - _KNOWN))


def _timed(folder: Path, suffixes: Sequence[str], stop_ms: float = np.inf) -> tuple[list[Path], np.ndarray, Timing]:
    """Files whose names are milliseconds by the custom of the layout, and these."""
    files = list_images(folder, suffixes)
    strangers = [f.name for f in files if not (f.stem.isascii() and f.stem.isdecimal() and len(f.stem) < 16)]
    if strangers:
        raise DataError(
            f"{folder}: {shown(strangers[0])} is not named by its time in milliseconds, as RH20T's files are"
        )
    kept = [f for f in files if int(f.stem) <= stop_ms]
    timing = Timing(f"the names in {folder.name}/", unit=None, custom="ms", integers=True, names=True)
    return kept, np.array([float(f.stem) for f in kept]), timing


def _state(folders: list[Path]) -> tuple[SampleStream, ...]:
    """Pose of the tool (position and quaternion) and command of the gripper, where they were recorded."""
    found = []
    for folder in _state_folders(folders):
        files, stamps, timing = _timed(folder, (".npy",))
        if files:
            found.append(SampleStream(folder.name, stamps, _rows(files), timing))
    return tuple(found)


def _state_folders(folders: list[Path]) -> list[Path]:
    """Those of the robot's state, each from the first of some folders that has it."""
    found = (next((f / name for f in folders if (f / name).is_dir()), None) for name in STATE)
    return [folder for folder in found if folder is not None]


def _rows(files: list[Path]) -> np.ndarray:
    """The arrays of files as rows of one width."""
    rows: list[np.ndarray] = []
    for file in files:
        found = np.atleast_1d(load_array(file, _MAX_ROW_BYTES))
        row = to_float32(found) if found.dtype.kind in "biuf" else np.full(1, np.nan)
        if row.ndim != 1 or (rows and row.shape != rows[0].shape) or not np.isfinite(row).all():
            expected = f"{len(rows[0])} finite numbers as in the others" if rows else "finite numbers"
            raise DataError(f"{file}: holds {found.dtype} {cut(str(found.shape))}, expected {expected}")
        rows.append(row)
    return np.stack(rows)


def _calibration(
    episode: Path, serial: str, about: dict[str, Any]
) -> tuple[tuple[tuple[str, Metadata], ...], tuple[Check, ...]]:
    """Intrinsics and pose of a camera; the world is the calibration marker."""
    stamp = episode / "timestamp.txt"
    words = read_text(stamp, _MAX_ROW_BYTES).split() if stamp.is_file() else []
    name = words[0] if words else about.get("calib")
    if name is None:
        return (), ()
    if not is_plain_name(str(name)):
        raise DataError(f"{episode}: its calibration is called {shown(name)}, expected the name of a folder in calib/")
    folder = next((f for p in list(episode.parents)[:3] if (f := p / "calib" / str(name)).is_dir()), None)
    if folder is None:
        return (), (Check("calibration", Verdict.DOUBTFUL, f"its calibration calib/{name} is not beside it"),)
    values: dict[str, Any] = {}
    K = pickled_numbers(folder / "intrinsics.npy", serial)
    if K is not None:
        if len(K) not in (9, 12):
            raise DataError(f"{folder / 'intrinsics.npy'}: has {len(K)} numbers for camera {serial}, expected 9 or 12")
        values["intrinsics"] = Intrinsics.from_matrix(K.reshape(3, -1))
    T_cam_marker = pickled_numbers(folder / "extrinsics.npy", serial)
    if T_cam_marker is not None:
        values["T_world_cam"] = _pose(folder / "extrinsics.npy", serial, T_cam_marker)
    checks = []
    if lens := sorted(f.name for f in folder.iterdir() if _LENS.search(f.name.lower())):
        says = f"calib/{name} has {cut(', '.join(lens))}, which is not read; write the 'distortion' into 'intrinsics'"
        checks.append(Check("calibration", Verdict.DOUBTFUL, f"{says} in {FILE_NAME}"))
    says = "the world is the marker of the calibration" if T_cam_marker is not None else "its pose is not calibrated"
    return ((f"calib/{name}", Metadata(**values)),), (Check("world", Verdict.OK, says), *checks)


def _pose(file: Path, serial: str, T_cam_marker: np.ndarray) -> list[list[float]]:
    """Pose of the camera as seen from the marker."""
    if len(T_cam_marker) != 16 or not np.isfinite(T_cam_marker).all():
        raise DataError(f"{file}: has {len(T_cam_marker)} numbers for camera {serial}, expected 16 that are finite")
    T: list[list[float]] = inverse(T_cam_marker.reshape(4, 4)).tolist()
    try:
        return [list(row) for row in check_rigid(tuple(map(tuple, [*T[:3], (0, 0, 0, 1)])))]  # type: ignore[arg-type]
    except ValueError as error:
        raise DataError(f"{file}: the pose of camera {serial} {error}") from error
