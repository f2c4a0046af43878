"""From decoded pictures to frames: meters, one ideal camera for color and depth, and a bounded size."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Float32, Num, UInt8

from flowlab.errors import DataError
from flowlab.geometry.camera import Camera
from flowlab.limits import MAX_DEPTH_PIXELS
from flowlab.recordings.camera_check import check_camera
from flowlab.recordings.depth_unit_check import likely_unit
from flowlab.recordings.intrinsics import Intrinsics
from flowlab.recordings.lens import undistortion_maps
from flowlab.recordings.recording_yaml import Metadata
from flowlab.recordings.registration import Registration
from flowlab.recordings.verdicts import Verdict

Size = tuple[int, int]
"""Width and height [px]."""


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
    lens = intrinsics.lens
    maps = None if lens is None else undistortion_maps(lens, K, intrinsics.distortion, color)
    return FrameProcessor(Camera(*size, shrink_intrinsics(K, factor), T_world_cam), unit, factor, maps, registration)


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
    refused = [c.says for c in check_camera("intrinsics", given, size, write_to) if c.verdict is Verdict.REFUSED]
    if refused:
        raise DataError(f"{path}: {'; '.join(refused)}")
    return given


def _unit(path: Path, metadata: Metadata, median_counts: float, write_to: str) -> float:
    """The unit of depth, where it makes a scene of plausible size."""
    unit = metadata.depth_unit_m
    if unit is None:
        raise DataError(
            f"{path}: the unit of depth is not known; the median reading is {median_counts:g} counts: write into "
            f"{write_to} what one count is in meters ({likely_unit(median_counts)})"
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
    refused = [
        c.says for c in check_camera("depth_intrinsics", camera, depth, write_to) if c.verdict is Verdict.REFUSED
    ]
    if refused:
        raise DataError(f"{path}: {'; '.join(refused)}")
    if depth[0] * depth[1] > MAX_DEPTH_PIXELS:
        raise DataError(
            f"{path}: depth pictures of {depth[0]}x{depth[1]} pixels cannot be registered, expected at most "
            f"{MAX_DEPTH_PIXELS:,} pixels; shrink them"
        )
    return Registration.make(camera, depth, np.array(T), K, color)
