"""From decoded pictures to frames: meters, one ideal camera for color and depth, and a bounded size."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Float32, Num, UInt8

from flowlab.errors import DataError
from flowlab.geometry.camera import Camera
from flowlab.limits import MAX_DEPTH_PIXELS
from flowlab.recordings.metadata import Intrinsics, Metadata
from flowlab.recordings.registration import Registration

Size = tuple[int, int]
"""Width and height [px]."""
PLAUSIBLE_M = (0.02, 100.0)
"""The median depth of a picture lies between these, or its unit is wrong [m]."""


@dataclass(frozen=True, slots=True)
class FrameProcessor:
    """Makes the color and the depth of frames from decoded pictures."""

    camera: Camera
    """Of what is given out: undistorted, and shrunk."""
    depth_unit_m: float
    factor: int
    """Source pixels per pixel given out, along each axis."""
    undistort: tuple[np.ndarray, np.ndarray] | None
    """OpenCV's maps: where to look in the distorted picture for every pixel of the ideal one."""
    registration: Registration | None
    """None where depth is seen from the color camera already."""

    def color(self, picture: UInt8[np.ndarray, "Hs Ws 3"]) -> UInt8[np.ndarray, "H W 3"]:
        """The color of a frame: a pixel is the mean of those it stands for."""
        if self.undistort is not None:
            picture = cv2.remap(picture, *self.undistort, cv2.INTER_LINEAR)
        if self.factor > 1:
            width, height = self.camera.width, self.camera.height
            whole = picture[: height * self.factor, : width * self.factor]
            picture = cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA)
        return picture

    def depth(self, counts: Num[np.ndarray, "Hs Ws"]) -> Float32[np.ndarray, "H W"]:
        """The depth of a frame [m]: never interpolated, so no value lies between a thing and what is behind it."""
        depth = to_meters(counts, self.depth_unit_m)
        if self.registration is not None:
            depth = self.registration(depth)
        elif self.undistort is not None:
            depth = cv2.remap(depth, *self.undistort, cv2.INTER_NEAREST)
        if self.factor > 1:
            first = (self.factor - 1) // 2
            depth = depth[first :: self.factor, first :: self.factor][: self.camera.height, : self.camera.width]
        return np.ascontiguousarray(depth)


def to_meters(counts: Num[np.ndarray, "H W"], unit_m: float) -> Float32[np.ndarray, "H W"]:
    """Depth [m] of a picture's counts; 0 for what is not a positive number."""
    depth = counts.astype(np.float32) * np.float32(unit_m)
    depth[~(np.isfinite(depth) & (depth > 0))] = 0
    return depth


def make_frame_processor(
    path: Path,
    metadata: Metadata,
    color: Size,
    depth: Size,
    *,
    registered: bool | None,
    max_width: int,
    write_to: str,
    median_counts: float,
) -> FrameProcessor:
    """What turns the pictures of a recording into frames.

    Args:
        path: The recording, for messages.
        metadata: What is known of its cameras.
        color: Size of its color pictures.
        depth: Size of its depth pictures.
        registered: Whether depth is seen from the color camera; None where nothing says so.
        max_width: Wider pictures are shrunk by a whole factor [px].
        write_to: The file that the user is to write into what is missing.
        median_counts: A typical depth reading, to tell a wrong unit by.

    Raises:
        DataError: Calibration is missing or cannot be; the message has the lines to write.
    """
    intrinsics = _intrinsics(path, metadata, color, write_to)
    unit = _unit(path, metadata, median_counts, write_to)
    K = intrinsics.K
    registration = _registration(path, metadata, color, depth, K, registered=registered, write_to=write_to)
    factor = -(-color[0] // max_width)
    size = color[0] // factor, color[1] // factor
    T_world_cam = np.eye(4) if metadata.T_world_cam is None else np.array(metadata.T_world_cam)
    maps = None
    if intrinsics.is_distorted:
        maps = cv2.initUndistortRectifyMap(K, np.array(intrinsics.distortion), np.eye(3), K, color, cv2.CV_32FC1)
    shrunk = Camera(*size, shrink_intrinsics(K, factor), T_world_cam)
    return FrameProcessor(shrunk, unit, factor, maps, registration)


def shrink_intrinsics(K: Float[np.ndarray, "3 3"], factor: int) -> Float[np.ndarray, "3 3"]:
    """Intrinsics of a picture whose pixel (i, j) is the mean of ``factor`` x ``factor`` pixels of another.

    The center of a block of pixels is ``(factor - 1) / 2`` to the right of the center of its first.
    """
    K = K.copy()
    K[:2, 2] -= (factor - 1) / 2
    K[:2] /= factor
    return K


def _intrinsics(path: Path, metadata: Metadata, size: Size, write_to: str) -> Intrinsics:
    """The intrinsics of the color camera, where they can be those of pictures of this size."""
    given = metadata.intrinsics
    if given is None:
        raise DataError(
            f"{path}: the intrinsics of the color camera are not known; write into {write_to}: "
            f"'intrinsics: {{width: {size[0]}, height: {size[1]}, fx: ..., fy: ..., cx: ..., cy: ...}}'"
        )
    of = (given.width or size[0], given.height or size[1])
    scaled = _scaled(given, of, size).to_yaml()
    if of != size:
        raise DataError(
            f"{path}: the intrinsics are for pictures of {of[0]}x{of[1]}, but these have {size[0]}x{size[1]}; "
            f"if they were shrunk as a whole, write into {write_to}: 'intrinsics: {scaled}'"
        )
    if given.width is None and not (0.2 < given.cx / size[0] < 0.8 and 0.2 < given.cy / size[1] < 0.8):
        raise DataError(
            f"{path}: the principal point ({given.cx:g}, {given.cy:g}) is far from the middle of pictures of "
            f"{size[0]}x{size[1]}, so the intrinsics may be for another size; write into {write_to} those of these "
            f"pictures, with their size: 'intrinsics: {scaled}'"
        )
    return given


def _scaled(given: Intrinsics, of: Size, size: Size) -> Intrinsics:
    """Intrinsics of the same pictures in another size."""
    x, y = size[0] / of[0], size[1] / of[1]
    return given.model_copy(
        update={
            "width": size[0],
            "height": size[1],
            "fx": round(given.fx * x, 6),
            "fy": round(given.fy * y, 6),
            "cx": round((given.cx + 0.5) * x - 0.5, 6),
            "cy": round((given.cy + 0.5) * y - 0.5, 6),
        }
    )


def _unit(path: Path, metadata: Metadata, median_counts: float, write_to: str) -> float:
    """The unit of depth, where it makes a scene of plausible size."""
    unit = metadata.depth_unit_m
    likely = next((u for u in (1.0, 0.001, 0.0001) if PLAUSIBLE_M[0] < median_counts * u < 20), 0.001)
    hint = f"'depth_unit_m: {likely}' would make that {median_counts * likely:.3g} m"
    if unit is None:
        raise DataError(
            f"{path}: the unit of depth is not known; the median reading is {median_counts:g} counts: write into "
            f"{write_to} what one count is in meters ({hint})"
        )
    if not PLAUSIBLE_M[0] < median_counts * unit < PLAUSIBLE_M[1]:
        raise DataError(
            f"{path}: with depth_unit_m {unit:g} the median reading of {median_counts:g} counts is "
            f"{median_counts * unit:.3g} m, which cannot be; correct it in {write_to} ({hint})"
        )
    return unit


def _registration(
    path: Path, metadata: Metadata, color: Size, depth: Size, K: np.ndarray, *, registered: bool | None, write_to: str
) -> Registration | None:
    """What moves depth to the color camera; None where it is seen from there."""
    camera, T = metadata.depth_intrinsics, metadata.T_color_depth
    apart = camera is not None or T is not None or registered is False
    if not apart and color == depth:
        return None
    lines = []
    if camera is None:
        size = f"width: {depth[0]}, height: {depth[1]}"
        lines.append(f"'depth_intrinsics: {{{size}, fx: ..., fy: ..., cx: ..., cy: ...}}'")
    if T is None:
        lines.append("'T_color_depth: [[r, r, r, x], [r, r, r, y], [r, r, r, z], [0, 0, 0, 1]]'")
    if camera is None or T is None:
        why = "is not registered to color" if apart else "has another size than color"
        raise DataError(
            f"{path}: depth ({depth[0]}x{depth[1]}) {why} ({color[0]}x{color[1]}); to have it registered, write "
            f"into {write_to} {' and '.join(lines)} (the pose of the depth camera in the color camera, meters)"
        )
    of = (camera.width or depth[0], camera.height or depth[1])
    if of != depth:
        raise DataError(
            f"{path}: depth_intrinsics are for pictures of {of[0]}x{of[1]}, but these have {depth[0]}x{depth[1]}; "
            f"correct them in {write_to}"
        )
    if depth[0] * depth[1] > MAX_DEPTH_PIXELS:
        raise DataError(
            f"{path}: depth pictures of {depth[0]}x{depth[1]} pixels cannot be registered, expected at most "
            f"{MAX_DEPTH_PIXELS:,} pixels; shrink them"
        )
    return Registration.make(camera, depth, np.array(T), K, color)
