"""Writing a recording as a plain folder, whole or not at all."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from jaxtyping import Bool, Float, Float32, Int8, UInt8

from flowlab.errors import DataError
from flowlab.files import new_folder
from flowlab.geometry.camera import Camera
from flowlab.recordings.metadata import FILE_NAME, Intrinsics

_MAX_COUNT = np.iinfo(np.uint16).max


def write_rgbd_recording(
    folder: Path,
    *,
    rgb: Iterable[UInt8[np.ndarray, "H W 3"]],
    depth: Iterable[Float[np.ndarray, "H W"]],
    camera: Camera,
    time_s: Float[np.ndarray, "T"],
    state: Float[np.ndarray, "T S"] | None = None,
    action: Float[np.ndarray, "T A"] | None = None,
    success: bool = True,
    task: str | None = None,
    depth_unit_m: float = 0.001,
    query_px: Float32[np.ndarray, "N 2"] | None = None,
    tracks_cam: Float32[np.ndarray, "T N 3"] | None = None,
    visible: Bool[np.ndarray, "T N"] | None = None,
    role: Int8[np.ndarray, "N"] | None = None,
) -> None:
    """Write frames as a plain folder, which the reader ``plain`` reads back exactly, depth to its unit.

    Args:
        folder: Where to; it must not exist.
        rgb: The color pictures, taken one by one.
        depth: As many depth pictures [m], seen from the same camera; 0 or not finite where there is no reading.
        camera: Its size is that of all pictures.
        time_s: When each was taken [s].
        state: What the robot was at each.
        action: What it then did.
        success: Whether the demonstration solved its task.
        task: What the robot does.
        depth_unit_m: What depth is rounded to: 0.0001 holds 6.5 m at a tenth of a millimeter.
        query_px: Pixels (x, y) of the first frame whose true tracks are known, for ``ground_truth.npz``.
        tracks_cam: Where their points are, in the camera frame of each instant [m].
        visible: Whether the camera sees them.
        role: The :class:`~flowlab.records.Role` of what they lie on.

    Raises:
        DataError: The folder exists or cannot be written, lengths or sizes differ, or a reading does not fit 16 bits.
    """
    if folder.exists():
        raise DataError(f"{folder}: exists already; delete it, or write the recording elsewhere")
    truth = {"query_px": query_px, "tracks_cam": tracks_cam, "visible": visible, "role": role}
    samples = {name: values for name, values in {"state": state, "action": action}.items() if values is not None}
    known: dict[str, Any] = {name: values for name, values in truth.items() if values is not None}
    try:
        with new_folder(folder) as temporary:
            _write_pictures(folder, temporary, rgb, depth, camera, len(time_s), depth_unit_m)
            (temporary / "times.txt").write_text("".join(f"{t!r}\n" for t in np.asarray(time_s, float).tolist()))
            for name, values in samples.items():
                if len(values) != len(time_s):
                    raise DataError(f"{folder}: {len(values)} rows of {name} for {len(time_s)} frames")
                np.save(temporary / f"{name}.npy", np.asarray(values, np.float32))
            (temporary / FILE_NAME).write_text(_yaml(camera, list(samples), depth_unit_m, success, task))
            if query_px is not None:
                np.savez_compressed(temporary / "ground_truth.npz", **known)
    except OSError as error:
        raise DataError(f"{folder}: the recording cannot be written ({error.strerror or error})") from error


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


def _yaml(camera: Camera, files: list[str], depth_unit_m: float, success: bool, task: str | None) -> str:
    """The content of ``recording.yaml``."""
    intrinsics = Intrinsics.from_matrix(camera.K, width=camera.width, height=camera.height)
    lines = [
        "times: times.txt",
        f"depth_unit_m: {depth_unit_m!r}",
        f"intrinsics: {intrinsics.to_yaml()}",
        f"T_world_cam: {np.asarray(camera.T_world_cam, float).tolist()}",
        *(f"{name}: {name}.npy" for name in files),
        f"success: {str(bool(success)).lower()}",
        *([yaml.safe_dump({"task": task}).strip()] if task is not None else []),
    ]
    return "\n".join(lines) + "\n"
