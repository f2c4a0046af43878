"""How far tracks are from the truth: in millimeters, as TAPVid-3D counts, and against their own stated error."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Float32

from flowlab.config import Settings
from flowlab.geometry.camera import Camera
from flowlab.grading.ground_truth import GroundTruth
from flowlab.records import Role

PIXELS = (1, 2, 4, 8, 16)
"""TAPVid-3D's limits, in pixels of a picture whose shorter side has 256."""
CURVE_MM = tuple(float(x) for x in np.geomspace(0.5, 500, 61))
"""Error limits of the cumulative curves."""
SIGMA_EDGES_MM = (0.0, *(float(2 ** (k / 2)) for k in range(-2, 15)), float("inf"))
"""Limits of the bins of stated error, two to an octave: 0, 0.5, 0.71, 1, ... 128, and no limit."""
MOVED_M = 0.01
"""A point has moved, at one instant, if it is farther than this from its start."""
MOVING_M = 0.02
"""Only points that get farther than this from their start, at some instant, count as moving."""
LOST_M = 0.05
"""A point is lost at the first visible instant with a larger error."""


class MetricSettings(Settings):
    """TAPVid-3D's rules by default; the others are for comparing with figures taken by other rules."""

    image_side: Literal["shorter", "width"] = "shorter"
    """Which side of the picture counts 256 pixels: ``shorter``, with the focal length sqrt(fx fy), is
    TAPVid-3D's rule; ``width`` goes with fx."""
    count_query_frame: bool = True
    """Whether TAPVid-3D's figures count the first frame, whose pixels are given. Its authors do. Errors in
    millimeters, survival and calibration never do."""


@dataclass(frozen=True, slots=True)
class Estimate:
    """Tracks as a labeling states them, in the camera frame of each instant."""

    xyz_cam: Float32[np.ndarray, "T N 3"]
    """[m]; not a number where there is no answer, which counts as a miss."""
    visible: Bool[np.ndarray, "T N"]
    sigma: Float32[np.ndarray, "T N"] | None = None
    """Stated error [m]; see :class:`flowlab.records.Quality`."""


@dataclass(frozen=True, slots=True)
class TrackErrors:
    """Distances from the truth over a group of (point, instant) pairs."""

    n: int
    """How many pairs there are."""
    answered: float
    """Share of them with an answer; median, percentile and mean are over these, the shares over all."""
    median_mm: float
    p95_mm: float
    mean_mm: float
    within_5mm: float
    within_10mm: float
    within_20mm: float
    within_40mm: float
    curve: tuple[float, ...]
    """Share within each of ``CURVE_MM``."""


@dataclass(frozen=True, slots=True)
class TapVid3D:
    """The figures of the TAPVid-3D benchmark, for points that are not rescaled to fit."""

    average_jaccard: float
    """3D-AJ: position and visibility in one."""
    apd: float
    """Share of truly visible points within the limits, on average over the limits."""
    occlusion_accuracy: float


@dataclass(frozen=True, slots=True)
class Calibration:
    """Stated errors beside true ones, over every answered pair, seen or not."""

    n: int
    within_1_sigma: float
    """Share of errors below the stated one; 0.68 is meant."""
    within_2_sigma: float
    rank_correlation: float
    """Spearman's, of stated with true errors."""
    count: tuple[int, ...]
    """Pairs in each bin of ``SIGMA_EDGES_MM``."""
    stated_mm: tuple[float, ...]
    """Median stated error of each bin; not a number where it is empty."""
    true_mm: tuple[float, ...]
    """68th percentile of the true errors of each bin: on the diagonal, if sigma is right."""


@dataclass(frozen=True, slots=True)
class TrackMetrics:
    """How good the tracks of a recording are. A group of which there is nothing is None."""

    all: TrackErrors | None
    """Truly visible points."""
    moving: TrackErrors | None
    """Truly visible, and away from where they started. None without roles."""
    object: TrackErrors | None
    """Those of them that lie on an object."""
    occluded: TrackErrors | None
    """Away from where they started, and truly out of sight."""
    survival: float
    """How far into the recording a point gets before it is lost, as a share, on average over the points."""
    survival_moving: float | None
    tapvid: TapVid3D
    calibration: Calibration | None
    """None where no sigma is stated."""

    def to_json(self) -> dict[str, Any]:
        """The figures as JSON values; what is not a number becomes null, what is absent is left out."""
        values = _json(self)
        assert isinstance(values, dict)
        return values


def measure(
    estimate: Estimate, truth: GroundTruth, camera: Camera, settings: MetricSettings | None = None
) -> TrackMetrics:
    """Compare tracks with the truth. Of the camera only its intrinsics and size are used."""
    error = errors_m(estimate, truth)
    moving, moved = _motion(truth)
    later = np.arange(len(error))[:, None] > 0
    seen = truth.visible & later
    on_object = np.zeros(error.shape[1], bool) if truth.role is None else truth.role == Role.OBJECT
    survived = _survival(error, truth.visible)
    return TrackMetrics(
        all=_summary(error[seen]),
        moving=_summary(error[seen & moved]),
        object=_summary(error[seen & moved & on_object]),
        occluded=_summary(error[~truth.visible & moved]),
        survival=float(survived.mean()),
        survival_moving=float(survived[moving].mean()) if moving.any() else None,
        tapvid=_tapvid(error, estimate.visible, truth, camera, settings or MetricSettings()),
        calibration=None if estimate.sigma is None else calibrate(error[1:], estimate.sigma[1:]),
    )


def errors_m(estimate: Estimate, truth: GroundTruth) -> Float[np.ndarray, "T N"]:
    """Distance of every estimate from the truth [m]; not a number where there is no answer."""
    return np.linalg.norm(estimate.xyz_cam.astype(np.float64) - truth.tracks_cam, axis=-1)


def calibrate(error_m: Float[np.ndarray, "*batch"], sigma_m: Float[np.ndarray, "*batch"]) -> Calibration | None:
    """What stated errors are worth; pairs without an answer are left out. None where none remains."""
    known = np.isfinite(error_m) & np.isfinite(sigma_m)
    error, sigma = error_m[known] * 1e3, sigma_m[known] * 1e3
    if len(error) == 0:
        return None
    which = np.digitize(sigma, SIGMA_EDGES_MM[1:-1])
    bins = [which == k for k in range(len(SIGMA_EDGES_MM) - 1)]
    return Calibration(
        n=len(error),
        within_1_sigma=float((error < sigma).mean()),
        within_2_sigma=float((error < 2 * sigma).mean()),
        rank_correlation=rank_correlation(sigma, error),
        count=tuple(int(b.sum()) for b in bins),
        stated_mm=tuple(float(np.median(sigma[b])) if b.any() else np.nan for b in bins),
        true_mm=tuple(float(np.percentile(error[b], 68)) if b.any() else np.nan for b in bins),
    )


def rank_correlation(a: Float[np.ndarray, "K"], b: Float[np.ndarray, "K"]) -> float:
    """Spearman's; ties share their mean rank. Not a number where one of the two is constant."""
    x, y = _ranks(a), _ranks(b)
    x, y = x - x.mean(), y - y.mean()
    spread = np.sqrt((x**2).sum() * (y**2).sum())
    return float((x * y).sum() / spread) if spread > 0 else float("nan")


def average(metrics: Sequence[TrackMetrics], calibration: Calibration | None = None) -> TrackMetrics:
    """The mean over recordings, each counting the same, as TAPVid's benchmarks do; counts are added up.

    A group is averaged over the recordings that have it. Reliability is no mean: give the ``calibration``
    of all pairs together.
    """
    groups = {
        f.name: _mean([getattr(m, f.name) for m in metrics]) for f in fields(TrackMetrics) if f.name != "calibration"
    }
    return TrackMetrics(**groups, calibration=calibration)


def _motion(truth: GroundTruth) -> tuple[Bool[np.ndarray, "N"], Bool[np.ndarray, "T N"]]:
    """Which points move at all, and when they are away from where they started."""
    if truth.role is None:
        return np.zeros(truth.visible.shape[1], bool), np.zeros(truth.visible.shape, bool)
    away = np.linalg.norm(truth.tracks_cam.astype(np.float64) - truth.tracks_cam[:1], axis=-1)
    moving = away.max(0) > MOVING_M
    return moving, moving & (away > MOVED_M)


def _summary(error_m: Float[np.ndarray, "K"]) -> TrackErrors | None:
    if len(error_m) == 0:
        return None
    error = error_m * 1e3
    known = error[np.isfinite(error)]
    median, p95, mean = (np.median(known), np.percentile(known, 95), known.mean()) if len(known) else [np.nan] * 3

    def within(limit_mm: float) -> float:
        return float((error < limit_mm).mean())  # what is not a number is within nothing

    return TrackErrors(
        n=len(error),
        answered=len(known) / len(error),
        median_mm=float(median),
        p95_mm=float(p95),
        mean_mm=float(mean),
        within_5mm=within(5),
        within_10mm=within(10),
        within_20mm=within(20),
        within_40mm=within(40),
        curve=tuple(within(limit) for limit in CURVE_MM),
    )


def _survival(error_m: Float[np.ndarray, "T N"], visible: Bool[np.ndarray, "T N"]) -> Float[np.ndarray, "N"]:
    """Share of the frames after the first that come before the point is lost."""
    lost = (visible & ~(error_m < LOST_M))[1:]
    if len(lost) == 0:
        return np.ones(lost.shape[1])
    return np.where(lost.any(0), lost.argmax(0), len(lost)) / len(lost)


def _tapvid(
    error_m: Float[np.ndarray, "T N"],
    stated_visible: Bool[np.ndarray, "T N"],
    truth: GroundTruth,
    camera: Camera,
    settings: MetricSettings,
) -> TapVid3D:
    first = 0 if settings.count_query_frame else 1
    z = truth.tracks_cam[first:, :, 2].astype(np.float64)
    return tapvid(error_m[first:], stated_visible[first:], truth.visible[first:], z, camera, settings)


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
        apd.append(_share((within & visible).sum(), visible.sum()))
        jaccard.append(_share(hits, visible.sum() + false))
    return TapVid3D(float(np.mean(jaccard)), float(np.mean(apd)), _share((stated == visible).sum(), visible.size))


def _focal_px(camera: Camera, settings: MetricSettings) -> float:
    """Focal length in a picture whose decisive side has 256 pixels."""
    fx, fy = camera.K[0, 0], camera.K[1, 1]
    if settings.image_side == "width":
        return float(fx * 256 / camera.width)
    return float(np.sqrt(fx * fy) * 256 / min(camera.width, camera.height))


def _share(part: int, whole: int) -> float:
    return float(part / whole) if whole else float("nan")


def _ranks(values: Float[np.ndarray, "K"]) -> Float[np.ndarray, "K"]:
    _, place, count = np.unique(values, return_inverse=True, return_counts=True)
    return (np.cumsum(count) - (count - 1) / 2)[place]


def _mean(values: Sequence[Any]) -> Any:
    """The mean of like values, field by field; counts are added, and what is absent or no number is left out."""
    values = [v for v in values if v is not None]
    if not values:
        return None
    first = values[0]
    if isinstance(first, int):
        return sum(values)
    if isinstance(first, float):
        known = [v for v in values if not np.isnan(v)]
        return float(np.mean(known)) if known else float("nan")
    if isinstance(first, tuple):
        return tuple(_mean(column) for column in zip(*values, strict=True))
    return type(first)(**{f.name: _mean([getattr(v, f.name) for v in values]) for f in fields(first)})


def _json(value: Any) -> Any:
    if isinstance(value, float):
        return round(value, 6) if np.isfinite(value) else None
    if isinstance(value, tuple):
        return [_json(v) for v in value]
    if isinstance(value, int):
        return value
    return {f.name: _json(v) for f in fields(value) if (v := getattr(value, f.name)) is not None}
