"""Recordings graded by workers: each is made if it is not there, labeled by every tracker, and compared."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from flowlab.engines.base import StartEngine, engine_by_name
from flowlab.errors import DataError, FlowlabError
from flowlab.files import remove_leftovers, temporary_path, told_when_unwritable
from flowlab.grading import ground_truth
from flowlab.grading.grade import RecordingGrade, TrackerGrade, grade_recording, summarize_rows
from flowlab.grading.metrics import EstimatedTracks, TrackMetrics
from flowlab.text import counted
from flowlab.tracking.base import Tracker
from flowlab.tracking.chunking import ChunkSettings
from flowlab.tracking.lifting import LiftSettings


@dataclass(frozen=True, slots=True)
class GradedRecording:
    """A recording that may have to be made before it can be graded."""

    folder: Path
    make: Callable[[Path], bool] | None = None
    """Makes it where it is not there with the same settings, and says whether it did; None for one's own."""


@dataclass(frozen=True, slots=True)
class GradingUnit:
    """What a worker does at a time: one recording, for all trackers."""

    recording: GradedRecording
    trackers: tuple[Tracker, ...]
    chunks: ChunkSettings
    tracks: Path
    """Prefix of the files that the labels are kept in until the whole run is summed up."""

    def tracks_of(self, tracker: int) -> Path:
        """The file of one tracker's labels."""
        return self.tracks.with_name(f"{self.tracks.name}-{tracker}.npz")


@dataclass(frozen=True, slots=True)
class GradingReceipt:
    """What a worker tells of its unit: figures, and no arrays."""

    made: bool
    size: tuple[int, int]
    """Width and height of the pictures [px]."""
    cpu_s: tuple[float, ...]
    metrics: tuple[TrackMetrics, ...]
    """Of every tracker, as are the CPU times."""


def grade_on_engine(
    recordings: Sequence[GradedRecording],
    trackers: Sequence[Tracker],
    chunks: ChunkSettings,
    out: Path,
    *,
    engine: str,
    workers: int | None,
    on_progress: Callable[[str], None],
) -> list[TrackerGrade]:
    """Grade recordings by every tracker, several recordings at a time.

    Args:
        recordings: What to grade.
        trackers: Who labels.
        chunks: How a recording is cut for trackers that take it in parts.
        out: Folder that all workers share, which exists; labels lie in a folder below it while the run lasts, and
            what dead runs left there is deleted.
        engine: Name or import path of what runs the workers.
        workers: Recordings at a time; None for what the engine takes by default.
        on_progress: Is told in words what is done.

    Returns:
        The grades of each tracker, recordings in the order given.

    Raises:
        DataError: A recording cannot be read or made, or its truth is not known.
        FlowlabError: A worker failed.
    """
    start: StartEngine[GradingUnit, GradingReceipt] = engine_by_name(engine, workers, [__name__])
    remove_leftovers(out)
    with TemporaryDirectory(prefix=temporary_path(out / "tracks-").name, dir=out) as kept:
        places = [Path(kept).resolve() / str(k) for k in range(len(recordings))]
        units = [GradingUnit(r, tuple(trackers), chunks, p) for r, p in zip(recordings, places, strict=True)]
        rows: dict[Path, list[RecordingGrade]] = {}
        with start(run_grading_unit) as running:
            for ended in running.results_of(units):
                if ended.receipt is None:
                    raise FlowlabError(
                        f"{ended.unit.recording.folder}: could not be graded ({ended.reason}); no report was written"
                    )
                rows[ended.unit.tracks] = _rows(ended.unit, ended.receipt)
                on_progress(_said(ended.unit, ended.receipt, len(rows[ended.unit.tracks][0].estimate.xyz_cam)))
    return [summarize_rows(t, [rows[p][k] for p in places]) for k, t in enumerate(trackers)]


def run_grading_unit(unit: GradingUnit) -> GradingReceipt:
    """A worker's part: make the recording if need be, label it by every tracker, and keep the labels."""
    folder, make = unit.recording.folder, unit.recording.make
    with told_when_unwritable(folder, "choose another --out"):
        made = make is not None and make(folder)
    rows = [grade_recording(folder, tracker, unit.chunks, LiftSettings()) for tracker in unit.trackers]
    for k, row in enumerate(rows):
        with told_when_unwritable(unit.tracks, "make room, or choose another --out"):
            row.estimate.save(unit.tracks_of(k))
    return GradingReceipt(made, rows[0].size, tuple(r.cpu_s for r in rows), tuple(r.metrics for r in rows))


def _rows(unit: GradingUnit, receipt: GradingReceipt) -> list[RecordingGrade]:
    """A unit's grades, of every tracker, with the labels that the worker kept."""
    folder = unit.recording.folder
    if not unit.tracks_of(0).exists():
        raise DataError(
            f"{unit.tracks.parent.parent}: a worker says that it graded {folder}, but its labels are not here; --out "
            f"must be a folder that all machines of the engine share, at the same path"
        )
    truth = ground_truth.read(folder)
    return [
        RecordingGrade.of(folder, truth, EstimatedTracks.load(unit.tracks_of(k)), receipt.size, cpu_s, metrics)
        for k, (cpu_s, metrics) in enumerate(zip(receipt.cpu_s, receipt.metrics, strict=True))
    ]


def _said(unit: GradingUnit, receipt: GradingReceipt, frames: int) -> str:
    """What became of a unit, in words."""
    folder = unit.recording.folder
    made = "" if unit.recording.make is None else f"{'recorded' if receipt.made else 'there already'}, "
    times = ", ".join(f"{t.name} {s:.1f} s" for t, s in zip(unit.trackers, receipt.cpu_s, strict=True))
    return f"{folder}: {made}{counted(frames, 'frame')}; CPU time: {times}"
