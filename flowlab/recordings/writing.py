"""Writing a recording as a plain folder, whole or not at all."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from jaxtyping import Bool, Float, Float32, Float64, Int8, UInt8

from flowlab.errors import DataError, UsageError
from flowlab.files import new_folder
from flowlab.geometry.camera import Camera, pose_fault
from flowlab.recordings.intrinsics import Intrinsics
from flowlab.recordings.recording_yaml import FILE_NAME, TRUE_TRACKS

_POSES = "T_world_cam.npy"
_MAX_COUNT = np.iinfo(np.uint16).max


def write_rgbd_recording(
    folder: Path | str,
    *,
    rgb: Iterable[UInt8[np.ndarray, "H W 3"]],
    depth: Iterable[Float[np.ndarray, "H W"]],
    camera: Camera,
    time_s: Float[np.ndarray, "T"],
    state: Float[np.ndarray, "T S"] | None = None,
    action: Float[np.ndarray, "T A"] | None = None,
    success: bool = True,
    task: str | None = None,
    rendered: bool = False,
    depth_unit_m: float = 0.001,
    T_world_cam: Float[np.ndarray, "T 4 4"] | None = None,
    query_px: Float32[np.ndarray, "N 2"] | None = None,
    tracks_cam: Float32[np.ndarray, "T N 3"] | None = None,
    visible: Bool[np.ndarray, "T N"] | None = None,
    role: Int8[np.ndarray, "N"] | None = None,
) -> None:
    """Write frames as a plain folder, which the reader ``plain`` reads back exactly, depth to its unit.

    Args:
        folder: Where to; it must not exist.
        rgb: The color pictures, uint8 from 0 to 255, taken one by one.
        depth: As many depth pictures [m] of floating point, seen from the same camera; 0 or not finite where there is
            no reading.
        camera: Its size is that of all pictures.
        time_s: When each was taken [s], one after the other.
        state: What the robot was at each; every row finite.
        action: What it then did.
        success: Whether the demonstration solved its task.
        task: What the robot does.
        rendered: Whether the pictures were rendered, so that equal ones are no sign of a camera that froze.
        depth_unit_m: What depth is rounded to: 0.0001 holds 6.5 m at a tenth of a millimeter.
        T_world_cam: The pose of a camera that moves, at each picture; it wins over that of ``camera``.
        query_px: Pixels (x, y) of the first frame whose true tracks are known, for ``ground_truth.npz``.
        tracks_cam: Where their points are, in the camera frame of each instant [m].
        visible: Whether the camera sees them.
        role: The :class:`~flowlab.records.Role` of what they lie on.

    Raises:
        UsageError: Pictures, times, state or action are of another type or shape, or ``depth_unit_m`` is not above 0.
        DataError: The folder exists or cannot be written, lengths or sizes differ, or a reading does not fit 16 bits.
    """
    folder = Path(folder)
    time_s = _times(time_s)
    if not (isinstance(depth_unit_m, int | float | np.number) and 0 < depth_unit_m < np.inf):
        raise UsageError(f"depth_unit_m is {depth_unit_m!r}, expected meters above 0, as in 0.001")
    if not isinstance(camera, Camera):
        raise UsageError(f"camera is {type(camera).__name__}, expected a flowlab.Camera")
    if folder.exists():
        raise DataError(f"{folder}: exists already; delete it, or write the recording elsewhere")
    truth = {"query_px": query_px, "tracks_cam": tracks_cam, "visible": visible, "role": role}
    given = {"state": state, "action": action}
    samples = {name: _rows(name, values, len(time_s)) for name, values in given.items() if values is not None}
    poses = None if T_world_cam is None else _poses(T_world_cam, len(time_s))
    known: dict[str, Any] = {name: values for name, values in truth.items() if values is not None}
    try:
        with new_folder(folder) as temporary:
            _write_pictures(folder, temporary, rgb, depth, camera, len(time_s), depth_unit_m)
            (temporary / "times.txt").write_text("".join(f"{t!r}\n" for t in time_s.tolist()))
            for name, values in samples.items():
                np.save(temporary / f"{name}.npy", values)
            if poses is not None:
                np.save(temporary / _POSES, poses)
            about = _yaml(
                camera, list(samples), float(depth_unit_m), success, task, rendered=rendered, moves=poses is not None
            )
            (temporary / FILE_NAME).write_text(about)
            if query_px is not None:
                np.savez_compressed(temporary / TRUE_TRACKS, **known)
    except OSError as error:
        raise DataError(f"{folder}: the recording cannot be written ({error.strerror or error})") from error


def _times(time_s: Any) -> Float64[np.ndarray, "T"]:
    """Times [s] that rise."""
    found = _numbers("time_s", time_s)
    if found.ndim != 1 or not len(found):
        raise UsageError(f"time_s has the shape {found.shape}, expected (T,), seconds for each of T frames")
    falls = np.flatnonzero(np.diff(found) <= 0)
    if len(falls):
        t = falls[0]
        raise UsageError(
            f"time_s goes from {found[t]:g} to {found[t + 1]:g} s at frame {t + 1}, expected times that rise"
        )
    return found


def _rows(name: str, values: Any, steps: int) -> Float32[np.ndarray, "T S"]:
    """State or action, a row for every frame."""
    found = _numbers(name, values)
    if found.ndim != 2 or len(found) != steps:
        raise UsageError(
            f"{name} has the shape {found.shape}, expected ({steps}, width), a row for each of {steps} frames"
        )
    return found.astype(np.float32)


def _numbers(name: str, values: Any) -> Float64[np.ndarray, "..."]:
    """Finite numbers."""
    try:
        found = np.asarray(values)
    except ValueError as error:
        raise UsageError(f"{name} has rows of different lengths, expected an array") from error
    if found.dtype.kind not in "iuf":
        raise UsageError(f"{name} is {found.dtype}, expected numbers")
    wrong = np.argwhere(~np.isfinite(found))
    if len(wrong):
        where = ", ".join(map(str, wrong[0]))
        raise UsageError(f"{name}[{where}] is {found[tuple(wrong[0])]}, expected a finite number")
    return found.astype(np.float64)


def _check_types(t: int, rgb: Any, depth: Any) -> None:
    """Refuse pictures whose numbers would be taken for others."""
    for name, picture in (("rgb", rgb), ("depth", depth)):
        if not isinstance(picture, np.ndarray):
            raise UsageError(f"{name} of frame {t} is {type(picture).__name__}, expected a NumPy array")
    if rgb.dtype != np.uint8:
        how = "; of floats from 0 to 1 give (rgb * 255).round().astype(np.uint8)" if rgb.dtype.kind == "f" else ""
        raise UsageError(f"rgb of frame {t} is {rgb.dtype}, expected uint8 from 0 to 255{how}")
    if depth.dtype.kind != "f":
        raise UsageError(
            f"depth of frame {t} is {depth.dtype}, expected meters as float32; of millimeters give "
            "(depth / 1000).astype(np.float32)"
        )


def _write_pictures(
    folder: Path,
    into: Path,
    rgb: Iterable[np.ndarray],
    depth: Iterable[np.ndarray],
    camera: Camera,
    steps: int,
    depth_unit_m: float,
) -> None:
    """Write every frame, as many as there are times."""
    size, t = (camera.height, camera.width), -1
    for name in ("color", "depth"):
        (into / name).mkdir()
    try:
        for t, (picture, meters) in enumerate(zip(rgb, depth, strict=True)):
            _check_types(t, picture, meters)
            if picture.shape != (*size, 3) or meters.shape != size:
                raise DataError(f"{folder}: frame {t} is {picture.shape} and {meters.shape}, the camera's is {size}")
            _write_png(into / "color" / f"{t:06d}.png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
            _write_png(into / "depth" / f"{t:06d}.png", _counts(folder, t, meters, depth_unit_m))
    except ValueError as error:
        raise DataError(f"{folder}: there are not as many depth as color pictures") from error
    if t + 1 != steps:
        raise DataError(f"{folder}: {t + 1} frames for {steps} times")


def _write_png(path: Path, picture: np.ndarray) -> None:
    """Write a PNG; a disk that is full raises an error."""
    path.write_bytes(cv2.imencode(".png", picture)[1].tobytes())  # imwrite fails without saying why


def _counts(folder: Path, t: int, meters: np.ndarray, unit_m: float) -> np.ndarray:
    """Depth [m] as 16-bit counts."""
    counts = np.rint(np.where(np.isfinite(meters) & (meters > 0), meters, 0).astype(np.float64) / unit_m)
    if counts.max(initial=0) > _MAX_COUNT:
        raise DataError(
            f"{folder}: frame {t} reads {meters[np.isfinite(meters)].max():.4g} m, and 16 bits of {unit_m} m hold "
            f"{_MAX_COUNT * unit_m:.4g} m; use a greater depth_unit_m"
        )
    return counts.astype(np.uint16)


def _poses(T_world_cam: Any, steps: int) -> Float64[np.ndarray, "T 4 4"]:
    """The pose of the camera at every picture."""
    found = _numbers("T_world_cam", T_world_cam)
    if found.shape != (steps, 4, 4):
        raise UsageError(f"T_world_cam has the shape {found.shape}, expected ({steps}, 4, 4), a pose for each frame")
    for t, T in enumerate(found):
        if fault := pose_fault(T):
            raise UsageError(f"T_world_cam[{t}] {fault}")
    return found


def _yaml(
    camera: Camera,
    files: list[str],
    depth_unit_m: float,
    success: bool,
    task: str | None,
    *,
    rendered: bool,
    moves: bool,
) -> str:
    """The content of ``recording.yaml``."""
    intrinsics = Intrinsics.from_matrix(camera.K, width=camera.width, height=camera.height)
    lines = [
        "times: times.txt",
        f"depth_unit_m: {depth_unit_m!r}",
        f"intrinsics: {intrinsics.to_yaml()}",
        f"T_world_cam_file: {_POSES}" if moves else f"T_world_cam: {np.asarray(camera.T_world_cam, float).tolist()}",
        *(f"{name}: {name}.npy" for name in files),
        *(["rendered: true"] if rendered else []),
        f"success: {str(bool(success)).lower()}",
        *([yaml.safe_dump({"task": task}).strip()] if task is not None else []),
    ]
    return "\n".join(lines) + "\n"
