"""Grading: recordings whose truth is known, labeled without it, and compared with it."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from flowlab.errors import DataError
from flowlab.grading import ground_truth
from flowlab.grading.calibration import Calibration, calibrate
from flowlab.grading.ground_truth import GroundTruth, unusable_queries
from flowlab.grading.metrics import (
    EstimatedTracks,
    TrackMetrics,
    average,
    errors_m,
    measure,
)
from flowlab.grading.origin import Origin, origin_of
from flowlab.grading.tapvid import MetricSettings
from flowlab.recordings.recording import RecordingSettings, open_recording
from flowlab.records import Clip
from flowlab.text import counted
from flowlab.tracking.base import Tracker
from flowlab.tracking.chunking import ChunkSettings
from flowlab.tracking.labeling import label_clip
from flowlab.tracking.lifting import LiftSettings

_FULL_SIZE_PX = 1 << 20
"""Wider than any picture, so that none is shrunk: the truth's pixels are those of the files."""


@dataclass(frozen=True, slots=True)
class RecordingGrade:
    """One recording, labeled by one tracker."""

    recording: str
    origin: Origin
    size: tuple[int, int]
    """Width and height of its pictures [px]."""
    frames: int
    queries: int
    unusable_queries: int
    """Left out of the simulated recording because of ``UNUSABLE_M``."""
    cpu_s: float
    """CPU time of labeling, all threads together."""
    estimate: EstimatedTracks
    truth: GroundTruth
    metrics: TrackMetrics

    @classmethod
    def of(
        cls,
        recording: Path,
        truth: GroundTruth,
        estimate: EstimatedTracks,
        size: tuple[int, int],
        cpu_s: float,
        metrics: TrackMetrics,
    ) -> "RecordingGrade":
        """The grade of a recording's folder, with what the folder says of itself."""
        return cls(
            recording=recording.name,
            origin=origin_of(recording),
            size=size,
            frames=len(truth.tracks_cam),
            queries=len(truth.query_px),
            unusable_queries=unusable_queries(recording),
            cpu_s=cpu_s,
            estimate=estimate,
            truth=truth,
            metrics=metrics,
        )

    @property
    def scene(self) -> str:
        """The family of procedural scenes or the task that it is of, and the camera that was asked for; empty for a
        recording of somebody's own."""
        return ", ".join(filter(None, (self.origin.scene, self.origin.camera)))

    @property
    def ms_per_frame(self) -> float:
        """CPU time per frame [ms]."""
        return self.cpu_s / self.frames * 1e3

    def to_json(self) -> dict[str, Any]:
        """The figures, without the tracks, as JSON values."""
        made = {"recording": self.recording, **asdict(self.origin), "size": list(self.size)}
        facts = {name: getattr(self, name) for name in ("frames", "queries", "unusable_queries")}
        times = {"cpu_s": round(self.cpu_s, 3), "ms_per_frame": round(self.ms_per_frame, 2)}
        return {**made, **facts, **times, "metrics": self.metrics.to_json()}


@dataclass(frozen=True, slots=True)
class TrackerGrade:
    """All recordings, labeled by one tracker."""

    tracker: Mapping[str, Any]
    """What :meth:`flowlab.tracking.base.Tracker.describe` says."""
    rows: tuple[RecordingGrade, ...]
    mean: TrackMetrics
    """Over the recordings, each counting the same; the calibration is of all their points together."""

    @property
    def name(self) -> str:
        """The tracker's."""
        return str(self.tracker["tracker"])

    @property
    def ms_per_frame(self) -> float:
        """CPU time per frame over all recordings [ms]."""
        return sum(row.cpu_s for row in self.rows) / sum(row.frames for row in self.rows) * 1e3

    def by_scene(self) -> dict[str, TrackMetrics]:
        """The mean over the recordings of each family of scenes, or task; of what is neither, nothing."""
        names = dict.fromkeys(row.scene for row in self.rows if row.scene)
        groups = {name: [row for row in self.rows if row.scene == name] for name in names}
        return {name: average([r.metrics for r in rows], _calibration(rows)) for name, rows in groups.items()}

    def to_json(self) -> dict[str, Any]:
        """All figures as JSON values."""
        return {
            **self.tracker,
            "ms_per_frame": round(self.ms_per_frame, 2),
            "mean": self.mean.to_json(),
            "scenes": {name: mean.to_json() for name, mean in self.by_scene().items()},
            "recordings": [row.to_json() for row in self.rows],
        }


def grade_tracker(
    recordings: Sequence[Path],
    tracker: Tracker,
    chunks: ChunkSettings,
    lifting: LiftSettings,
    metrics: MetricSettings = MetricSettings(),
    report: Callable[[RecordingGrade], None] = lambda _: None,
) -> TrackerGrade:
    """Label recordings whose truth is known by one tracker, and compare.

    Args:
        recordings: Folders with a ``ground_truth.npz``.
        tracker: Who follows the points.
        chunks: How a clip is cut for it.
        lifting: How its tracks become 3D.
        metrics: By which rules errors are counted.
        report: Is told of each recording as it is done.

    Raises:
        DataError: A recording cannot be read, or its truth is missing or of other pictures.
    """
    rows = []
    for recording in recordings:
        rows.append(grade_recording(recording, tracker, chunks, lifting, metrics))
        report(rows[-1])
    return summarize_rows(tracker, rows)


def summarize_rows(tracker: Tracker, rows: Sequence[RecordingGrade]) -> TrackerGrade:
    """The grades of a tracker, with their mean."""
    return TrackerGrade(tracker.describe(), tuple(rows), average([r.metrics for r in rows], _calibration(rows)))


def grade_recording(
    recording: Path,
    tracker: Tracker,
    chunks: ChunkSettings,
    lifting: LiftSettings,
    metrics: MetricSettings = MetricSettings(),
) -> RecordingGrade:
    """Label the true tracks' query pixels, given nothing but the pictures, and compare; see :func:`grade_tracker`."""
    truth = ground_truth.read(recording)
    clip = read_clip(recording)
    _check_same(recording, clip, truth)
    start = time.process_time()
    estimate = label_blind(clip, truth.query_px, tracker, chunks, lifting)
    cpu_s = time.process_time() - start
    size, figures = (clip.camera.width, clip.camera.height), measure(estimate, truth, clip.camera, metrics)
    return RecordingGrade.of(recording, truth, estimate, size, cpu_s, figures)


def read_clip(recording: Path) -> Clip:
    """All pictures of a recording, at full size. One bad picture rejects it: rows must stay those of the truth."""
    settings = RecordingSettings(bad_frames="reject", max_width=_FULL_SIZE_PX)
    opened = open_recording(recording, settings, task=recording.name, seed=0)
    frames = [opened.frame(t) for t in range(len(opened))]
    rgb = np.stack([f.rgb for f in frames if f.rgb is not None])
    return Clip(rgb, np.stack([f.depth for f in frames]), opened.camera, opened.T_world_cam)


def label_blind(
    clip: Clip,
    query_px: Float32[np.ndarray, "N 2"],
    tracker: Tracker,
    chunks: ChunkSettings,
    lifting: LiftSettings,
) -> EstimatedTracks:
    """The labeling's answer for pixels of the first frame, in the camera frame."""
    _, tracks = label_clip(clip, query_px, tracker, chunks, lifting)
    xyz_cam = clip.to_camera(tracks.xyz_world.astype(np.float64)).astype(np.float32)
    return EstimatedTracks(xyz_cam, tracks.visible, None if tracks.quality is None else tracks.quality.sigma)


def _check_same(recording: Path, clip: Clip, truth: GroundTruth) -> None:
    """Refuse truth that cannot be of these pictures."""
    if len(truth.tracks_cam) != len(clip):
        raise DataError(
            f"{recording / ground_truth.FILE_NAME}: 'tracks_cam' has {counted(len(truth.tracks_cam), 'frame')}, and "
            f"the recording {len(clip)}; give the truth of every frame, or take out the frames without"
        )
    outside = (truth.query_px < -0.5) | (truth.query_px > np.array([clip.camera.width, clip.camera.height]) - 0.5)
    if outside.any():
        x, y = truth.query_px[outside.any(1)][0]
        raise DataError(
            f"{recording / ground_truth.FILE_NAME}: 'query_px' has ({x:g}, {y:g}), outside the picture of "
            f"{clip.camera.width} x {clip.camera.height}; pixels are (x, y), counted from 0"
        )


def _calibration(rows: Sequence[RecordingGrade]) -> Calibration | None:
    """Of the points of all recordings together."""
    stated = [(errors_m(r.estimate, r.truth), r.estimate.sigma) for r in rows if r.estimate.sigma is not None]
    if not stated:
        return None
    error, sigma = (np.concatenate([of_row[1:].ravel() for of_row in column]) for column in zip(*stated, strict=True))
    return calibrate(error, sigma)
