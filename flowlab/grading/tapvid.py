"""The figures of the TAPVid-3D benchmark."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

from flowlab.config import Settings
from flowlab.geometry.camera import Camera

PIXELS = (1, 2, 4, 8, 16)
"""TAPVid-3D's limits, in pixels of a picture whose shorter side has 256."""


class MetricSettings(Settings):
    """TAPVid-3D's rules by default; the others are for comparing with figures taken by other rules."""

    image_side: Literal["shorter", "width"] = "shorter"
    """Which side of the picture counts 256 pixels: ``shorter``, with the focal length sqrt(fx fy), is
    TAPVid-3D's rule; ``width`` goes with fx."""
    count_query_frame: bool = True
    """Whether TAPVid-3D's figures count the first frame, whose pixels are given. Its authors do. Errors in
    millimeters, survival and calibration never do."""


@dataclass(frozen=True, slots=True)
class TapVid3D:
    """The figures of the TAPVid-3D benchmark, for points that are not rescaled to fit."""

    average_jaccard: float
    """3D-AJ: position and visibility in one."""
    apd: float
    """Share of truly visible points within the limits, on average over the limits."""
    occlusion_accuracy: float


def tapvid(
    error: Float[np.ndarray, "*batch"],
    stated: Bool[np.ndarray, "*batch"],
    visible: Bool[np.ndarray, "*batch"],
    z: Float[np.ndarray, "*batch"],
    camera: Camera,
    settings: MetricSettings | None = None,
) -> TapVid3D:
    """TAPVid-3D's figures for (point, instant) pairs: error [m], stated and true visibility, true z-depth [m]."""
    pixel_m = z / _focal_px(camera, settings or MetricSettings())
    apd, jaccard = [], []
    for pixels in PIXELS:
        within = error < pixels * pixel_m
        hits, false = (within & visible & stated).sum(), (stated & ~(visible & within)).sum()
        apd.append(_share(int((within & visible).sum()), int(visible.sum())))
        jaccard.append(_share(int(hits), int(visible.sum() + false)))
    return TapVid3D(float(np.mean(jaccard)), float(np.mean(apd)), _share(int((stated == visible).sum()), visible.size))


def _focal_px(camera: Camera, settings: MetricSettings) -> float:
    """Focal length in a picture whose decisive side has 256 pixels."""
    fx, fy = camera.K[0, 0], camera.K[1, 1]
    if settings.image_side == "width":
        return float(fx * 256 / camera.width)
    return float(np.sqrt(fx * fy) * 256 / min(camera.width, camera.height))


def _share(part: int | np.integer, whole: int | np.integer) -> float:
    """A share; not a number of nothing."""
    return float(part / whole) if whole else float("nan")
