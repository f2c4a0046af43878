"""RH20T's timestamped folders, which RISE and MBA use too.

<episode>/metadata.json, timestamp.txt, cam_<serial>/{color,depth}/<ms>.png,
tcp/<ms>.npy and gripper_command/<ms>.npy in the episode or in the camera's folder;
calib/<calibration>/{intrinsics,extrinsics}.npy beside the episode or above it
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flowlab.errors import DataError
from flowlab.geometry.transforms import inverse
from flowlab.recordings.base import SampleStream, Streams
from flowlab.recordings.image_files import COLOR_SUFFIXES, color_stream, depth_stream, list_images
from flowlab.recordings.metadata import FILE_NAME, Intrinsics, Metadata
from flowlab.recordings.readers.safe_pickle import load_pickled_mapping

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
        about = _about(episode / "metadata.json")
        stop_s = float(about["finish_time"]) / 1000 if "finish_time" in about else np.inf
        color, color_s = _timed(folder / "color", COLOR_SUFFIXES, stop_s)
        depth, depth_s = _timed(folder / "depth", (".png",))
        calibration, notes = _calibration(episode, serial, about)
        success = {"success": float(about["rating"]) > 1} if "rating" in about else {}
        known = Metadata(depth_unit_m=0.00025 if "f" in serial else 0.001, **success)
        return Streams(
            color_stream(color, color_s),
            depth_stream(depth, depth_s),
            state=_state([folder, episode]),
            known=(*calibration, ("the custom of RH20T", known)),
            registered=True,
            notes=notes,
        )


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


def _about(file: Path) -> dict[str, Any]:
    """What ``metadata.json`` says that matters here."""
    if not file.is_file():
        return {}
    try:
        values = json.loads(file.read_text())
        return {k: values[k] for k in ("finish_time", "rating", "calib") if values.get(k) is not None}
    except (OSError, ValueError, AttributeError) as error:
        raise DataError(f"{file}: not valid JSON ({error})") from error


def _timed(folder: Path, suffixes: Sequence[str], stop_s: float = np.inf) -> tuple[list[Path], np.ndarray]:
    """Files whose names are milliseconds, and these in seconds."""
    files = list_images(folder, suffixes)
    strangers = [f.name for f in files if not f.stem.isdigit()]
    if strangers:
        raise DataError(f"{folder}: '{strangers[0]}' is not named by its time in milliseconds, as RH20T's files are")
    kept = [f for f in files if int(f.stem) / 1000 <= stop_s]
    return kept, np.array([int(f.stem) / 1000 for f in kept])


def _state(folders: list[Path]) -> tuple[SampleStream, ...]:
    """Pose of the tool (position and quaternion) and command of the gripper, where they were recorded."""
    found = []
    for name in STATE:
        folder = next((f / name for f in folders if (f / name).is_dir()), None)
        files, time_s = ([], np.empty(0)) if folder is None else _timed(folder, (".npy",))
        if files:
            found.append(SampleStream(name, time_s, _rows(files)))
    return tuple(found)


def _rows(files: list[Path]) -> np.ndarray:
    """The arrays of files as rows of one width."""
    rows: list[np.ndarray] = []
    for file in files:
        try:
            row = np.atleast_1d(np.load(file)).astype(np.float32)
        except (OSError, ValueError, EOFError) as error:
            raise DataError(f"{file}: cannot be read ({error})") from error
        if row.ndim != 1 or (rows and row.shape != rows[0].shape) or not np.isfinite(row).all():
            expected = f"{len(rows[0])} finite numbers as in the others" if rows else "finite numbers"
            raise DataError(f"{file}: holds an array {row.shape}, expected {expected}")
        rows.append(row)
    return np.stack(rows)


def _calibration(
    episode: Path, serial: str, about: dict[str, Any]
) -> tuple[tuple[tuple[str, Metadata], ...], tuple[str, ...]]:
    """Intrinsics and pose of a camera; the world is the calibration marker."""
    stamp = episode / "timestamp.txt"
    name = stamp.read_text().split()[0] if stamp.is_file() and stamp.read_text().split() else about.get("calib")
    if name is None:
        return (), ()
    folder = next((f for p in list(episode.parents)[:3] if (f := p / "calib" / str(name)).is_dir()), None)
    if folder is None:
        return (), (f"its calibration calib/{name} is not beside it",)
    values: dict[str, Any] = {}
    K = load_pickled_mapping(folder / "intrinsics.npy").get(serial)
    if K is not None:
        values["intrinsics"] = Intrinsics.from_matrix(np.asarray(K))
    T_cam_marker = load_pickled_mapping(folder / "extrinsics.npy").get(serial)
    if T_cam_marker is not None:
        T = inverse(np.asarray(T_cam_marker, float).reshape(4, 4))
        T[3] = 0, 0, 0, 1
        values["T_world_cam"] = T.tolist()
    note = "the world is the marker of the calibration" if T_cam_marker is not None else "its pose is not calibrated"
    return ((f"calib/{name}", Metadata(**values)),), (note,)
