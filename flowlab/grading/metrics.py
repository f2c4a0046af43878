"""How far tracks are from the truth: in millimeters, as TAPVid-3D counts, and against their own stated error."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32

from flowlab.array_files import load_arrays
from flowlab.geometry.camera import Camera
from flowlab.geometry.moving import MOVING_IN_RECORDING_M
from flowlab.grading.calibration import Calibration, calibrate, confidently_wrong
from flowlab.grading.ground_truth import GroundTruth
from flowlab.grading.tapvid import MetricSettings, TapVid3D, tapvid
from flowlab.records import Role

CURVE_MM = tuple(float(x) for x in np.geomspace(0.5, 500, 61))
"""Error limits of the cumulative curves."""
MOVED_M = 0.01
"""A point has moved, at one instant, if it is farther than this from its start."""
LOST_M = 0.05
"""A point is lost at the first visible instant with a larger error."""


@dataclass(frozen=True, slots=True)
class EstimatedTracks:
    """Tracks as a labeling states them, in the camera frame of each instant."""

    xyz_cam: Float32[np.ndarray, "T N 3"]
    """[m]; not a number where there is no answer, which counts as a miss."""
    visible: Bool[np.ndarray, "T N"]
    sigma: Float32[np.ndarray, "T N"] | None = None
    """Stated error [m]; see :class:`flowlab.records.Quality`."""

    def save(self, path: Path) -> None:
        """Write the tracks into an ``.npz`` file."""
        arrays = {"xyz_cam": self.xyz_cam, "visible": self.visible}
        np.savez(path, **(arrays if self.sigma is None else arrays | {"sigma": self.sigma}))  # type: ignore[arg-type]

    @classmethod
    def load(cls, path: Path) -> "EstimatedTracks":
        """What :meth:`save` wrote."""
        return cls(**load_arrays(path))


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
    confidently_wrong: float | None
    """Share of positions in sight, or said to be, that are far off and do not say so; see
    :func:`~flowlab.grading.calibration.confidently_wrong`. None where no sigma is stated."""
    calibration: Calibration | None
    """None where no sigma is stated."""

    def to_json(self) -> dict[str, Any]:
        """The figures as JSON values; what is not a number becomes null, what is absent is left out."""
        values = _json(self)
        assert isinstance(values, dict)
        return values


def measure(
    estimate: EstimatedTracks, truth: GroundTruth, camera: Camera, settings: MetricSettings | None = None
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
        confidently_wrong=None
        if estimate.sigma is None
        else confidently_wrong(error[1:], estimate.sigma[1:], (truth.visible | estimate.visible)[1:]),
        calibration=None if estimate.sigma is None else calibrate(error[1:], estimate.sigma[1:]),
    )


def errors_m(estimate: EstimatedTracks, truth: GroundTruth) -> Float[np.ndarray, "T N"]:
    """Distance of every estimate from the truth [m]; not a number where there is no answer."""
    return np.linalg.norm(estimate.xyz_cam.astype(np.float64) - truth.tracks_cam, axis=-1)


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
    away = truth.displacement_m()
    moving = away.max(0) > MOVING_IN_RECORDING_M
    return moving, moving & (away > MOVED_M)


def _summary(error_m: Float[np.ndarray, "K"]) -> TrackErrors | None:
    """The figures of a group of errors; None where there is none."""
    if len(error_m) == 0:
        return None
    error = error_m * 1e3
    known = error[np.isfinite(error)]
    median, p95, mean = (np.median(known), np.percentile(known, 95), known.mean()) if len(known) else [np.nan] * 3

    def within(limit_mm: float | int) -> float:
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
    """The figures of the frames that count."""
    first = 0 if settings.count_query_frame else 1
    z = truth.tracks_cam[first:, :, 2].astype(np.float64)
    return tapvid(error_m[first:], stated_visible[first:], truth.visible[first:], z, camera, settings)


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
    """A value as JSON has it."""
    if isinstance(value, float):
        return round(value, 6) if np.isfinite(value) else None
    if isinstance(value, tuple):
        return [_json(v) for v in value]
    if isinstance(value, int):
        return value
    return {f.name: _json(v) for f in fields(value) if (v := getattr(value, f.name)) is not None}
