"""A clip in the form that the rigid-body fit works on."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, Float32, Float64, Int8, Num, UInt8

from flowlab.geometry.transforms import inverse
from flowlab.records import Clip
from flowlab.tracking.trackers.rigid_bodies import _surfaces
from flowlab.tracking.trackers.rigid_bodies.rigid_motion import RigidMotion

WIDTH = 320
"""Pictures are shrunk by a whole factor to about this width [px]: the fit gains nothing from more."""
_MIN_SIDE = 16
"""Optical flow needs so many rows and columns."""
_BLUR = 0.8
_LCN_WINDOW, _LCN_FLOOR, _LCN_LIMIT = 9, 6.0, 1.5


@dataclass(frozen=True, slots=True)
class ClipFeatures:
    """Every frame's depth and features; 20 bytes per pixel and frame."""

    K: Float64[np.ndarray, "3 3"]
    """Intrinsics [px] of the shrunk pictures."""
    factor: int
    """How much smaller than the clip's they are."""
    offset: int
    """The clip's pixel ``offset + factor * u`` is pixel u of these."""
    depth: Float32[np.ndarray, "T h w"]
    """[m], 0 where there is no reading."""
    smooth: Float32[np.ndarray, "T h w"]
    """The same with less noise, edges kept."""
    normal: Int8[np.ndarray, "T h w 3"]
    """Of the smooth surface, in 1/127; 0 where not known."""
    feature: UInt8[np.ndarray, "T h w 4"]
    """Locally normalized lightness, and CIE lightness, a and b; see :mod:`._costs` for what a count costs."""
    flow: Float32[np.ndarray, "T h w 2"]
    """Where a pixel of the frame before goes in this one [px]; 0 for the first."""
    still: RigidMotion | None = None
    """How what stands still in the world moves before a camera that moves; None where that stands still, too, or where
    nobody knows."""
    still_is_fitted: bool = False
    """Whether that was found in the pictures, and errs as every fitted motion does."""

    def __len__(self) -> int:
        return len(self.depth)

    @property
    def stillness(self) -> RigidMotion:
        """The motion of what stands still."""
        return RigidMotion.identity(len(self)) if self.still is None else self.still

    def lightness(self, t: int) -> Float32[np.ndarray, "h w"]:
        """The lightness of a frame, 0 to 255."""
        return self.feature[t, :, :, 1].astype(np.float32)

    def unproject(self, uv: Num[np.ndarray, "*n 2"], z: Num[np.ndarray, "*n"]) -> Float64[np.ndarray, "*n 3"]:
        """Points [m] in the camera frame at pixels of these pictures and z-depths [m]."""
        x = (uv - self.K[:2, 2]) / [self.K[0, 0], self.K[1, 1]] * z[..., None]
        return np.concatenate([x, z[..., None]], -1)

    def project(self, xyz_cam: Float[np.ndarray, "*n 3"]) -> Float64[np.ndarray, "*n 2"]:
        """Pixels of points in the camera frame."""
        z = np.maximum(xyz_cam[..., 2:], 1e-6)
        return xyz_cam[..., :2] / z * [self.K[0, 0], self.K[1, 1]] + self.K[:2, 2]

    def from_clip_pixels(self, uv: Num[np.ndarray, "*n 2"]) -> Num[np.ndarray, "*n 2"]:
        """Pixels of the clip as pixels of these pictures."""
        return (uv - self.offset) / self.factor

    @property
    def clip_size(self) -> int:
        """The longer side [px] of the clip's pictures, but for what shrinking cut off."""
        return self.factor * max(self.depth.shape[1:])

    def to_clip_pixels(self, uv: Num[np.ndarray, "*n 2"]) -> Num[np.ndarray, "*n 2"]:
        """The inverse of :meth:`from_clip_pixels`."""
        return uv * self.factor + self.offset


def extract_features(clip: Clip, max_depth: float) -> ClipFeatures:
    """The frames of a clip, made ready for the fit.

    Args:
        clip: The pictures; they are shrunk by a whole factor where they are much wider than ``WIDTH``.
        max_depth: Depth beyond this [m] counts as missing.
    """
    factor = _factor(clip)
    offset = (factor - 1) // 2
    K = clip.camera.K.astype(float).copy()
    K[:2, 2] -= offset
    K[:2] /= factor
    depth = clip.depth[:, offset::factor, offset::factor].copy()
    depth[depth > max_depth] = 0
    smooth = np.empty_like(depth)
    normal = np.empty((*depth.shape, 3), np.int8)
    feature = np.empty((*depth.shape, 4), np.uint8)
    for k in range(len(depth)):
        smooth[k] = _surfaces.smooth_depth(depth[k])
        normal[k] = _surfaces.surface_normals(smooth[k], K)
        feature[k] = _feature(clip.rgb[k], factor, offset)
    flow = np.zeros((*depth.shape, 2), np.float32)
    dense: Any = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    for k in range(1, len(depth)):
        flow[k] = dense.calc(feature[k - 1, :, :, 1].copy(), feature[k, :, :, 1].copy(), None)
    still = None
    if clip.T_world_cam is not None:
        T_cam_first = inverse(clip.T_world_cam) @ clip.T_world_cam[0]
        still = RigidMotion(T_cam_first[:, :3, :3].copy(), T_cam_first[:, :3, 3].copy())
    return ClipFeatures(K, factor, offset, depth, smooth, normal, feature, flow, still)


def large_enough(clip: Clip) -> bool:
    """Whether there is optical flow between its pictures: OpenCV ends the process at some that have few rows."""
    return min(clip.depth.shape[1:]) // _factor(clip) >= _MIN_SIDE


def _factor(clip: Clip) -> int:
    """By how much its pictures are shrunk."""
    return max(1, round(clip.camera.width / WIDTH))


def _feature(rgb: np.ndarray, factor: int, offset: int) -> np.ndarray:
    """The feature picture (h, w, 4) of a color picture."""
    if factor > 1:
        rgb = cv2.GaussianBlur(rgb, (0, 0), 0.5 * factor)[offset::factor, offset::factor]
    smooth = cv2.GaussianBlur(rgb, (0, 0), _BLUR)
    lab = cv2.cvtColor(smooth, cv2.COLOR_RGB2LAB)
    gray = cv2.cvtColor(smooth, cv2.COLOR_RGB2GRAY).astype(np.float32)
    window = (_LCN_WINDOW, _LCN_WINDOW)
    mean = cv2.blur(gray, window)
    deviation = np.sqrt(np.maximum(cv2.blur(gray * gray, window) - mean * mean, 0))
    normalized = np.clip((gray - mean) / (deviation + _LCN_FLOOR), -_LCN_LIMIT, _LCN_LIMIT)
    counts = np.rint((normalized + _LCN_LIMIT) * (255 / (2 * _LCN_LIMIT))).astype(np.uint8)
    return np.dstack([counts, lab])
