"""Fill a dataset from recordings, or say what that would take."""

import os
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from flowlab.engines.base import StartEngine
from flowlab.errors import DataError, UsageError
from flowlab.pipeline.extraction import fill
from flowlab.pipeline.recipe import Recipe
from flowlab.pipeline.scheduling import ExtractionProgress, RecordingScheduler
from flowlab.pipeline.stage import EpisodeRequest, Rejected
from flowlab.pipeline.stages.recording import QualityStage, RecordingStage, TrackStage
from flowlab.pipeline.units import JobShard, WorkUnit
from flowlab.recordings.metadata import FILE_NAME, combine, load_metadata
from flowlab.recordings.recording import Recording, RecordingDescription, RecordingSettings, describe, find_recordings
from flowlab.storage.dataset import Dataset
from flowlab.storage.manifest import Manifest, Receipt, read_receipts
from flowlab.storage.recorded import Recorded, number_recordings
from flowlab.tracking.base import make_tracker

_TRIAL_FRAMES = 33
"""As many frames are labeled to tell what all will cost."""


def find_jobs(recipe: Recipe, paths: Sequence[Path], task: str | None = None) -> tuple[Recorded, ...]:
    """Every recording at or below the paths, numbered as a new dataset would number them.

    Its task is ``task``, else what its ``recording.yaml`` or the calibration file says, else the name of the folder
    that holds it.
    """
    settings = recording_stage(recipe)
    found = []
    for path in find_recordings(paths, settings.reader):
        place = Path(os.path.abspath(path))
        name = task or _task_said(place, settings) or place.parent.name
        if not name or "/" in name or name.startswith("."):
            raise UsageError(f"{path}: '{name}' cannot be the name of a task; give one with --task")
        found.append(Recorded(task=name, name=place.name, source=str(place)))
    return number_recordings((), found)


def recording_stage(recipe: Recipe) -> RecordingStage:
    """The stage that opens recordings, which the recipe must begin with."""
    first = recipe.stages[0] if recipe.stages else None
    if not isinstance(first, RecordingStage):
        raise UsageError(f"recipe {recipe.name}: track-real needs a 'recording' stage at the start")
    return first


def _task_said(path: Path, settings: RecordingSettings) -> str | None:
    beside = [path / FILE_NAME] if path.is_dir() else [path.with_suffix(".yaml"), path.parent / FILE_NAME]
    files = [*([settings.calibration] if settings.calibration else []), *(f for f in beside if f.is_file())]
    return combine((str(f), load_metadata(f)) for f in files)[0].task


def label_recordings(
    recipe: Recipe,
    recordings: Sequence[Recorded],
    folder: Path,
    *,
    start_engine: StartEngine[WorkUnit, Receipt],
    share: JobShard = JobShard(),
    report: Callable[[ExtractionProgress], None] = lambda _: None,
) -> Dataset:
    """Label recordings into ``folder``; what an earlier run did is kept, but what it could not open is tried again.

    See :func:`flowlab.pipeline.extraction.fill` for what is raised.
    """
    manifest = Manifest(
        recipe=recipe.name,
        settings=recipe.settings(),
        provenance=recipe.pipeline().provenance(recordings[0].task if recordings else ""),
        first_seed=0,
        requested=dict(Counter(r.task for r in recordings)),
        recordings=tuple(recordings),
    )
    asked = {(r.task, r.name) for r in recordings}

    def plan_for(manifest: Manifest) -> RecordingScheduler:
        mine = [r for r in manifest.recordings if (r.task, r.name) in asked]
        _forget_unopened(folder, {r.seed for r in mine if r.seed % share.count == share.index})
        return RecordingScheduler(mine)

    return fill(recipe, manifest, plan_for, folder, start_engine=start_engine, share=share, report=report)


def _forget_unopened(folder: Path, seeds: set[int]) -> None:
    """Remove the receipts of recordings that could not be opened: their users were told how to mend them."""
    for receipt in read_receipts(folder):
        if receipt.rejects and seeds.issuperset(receipt.seeds) and all(x.retry for x in receipt.rejects):
            (folder / "receipts" / f"{receipt.unit}.json").unlink(missing_ok=True)


@dataclass(frozen=True, slots=True)
class CostEstimate:
    """What labeling costs."""

    cpu_s_per_frame: float | None
    """None where no recording could be labeled."""
    basis: str
    """How that was found, or why not."""


def estimate_cost(recipe: Recipe, recordings: Sequence[Recorded]) -> CostEstimate:
    """Label the first frames of the first recording that can be labeled, and keep nothing."""
    failure = ""
    for one in recordings:
        try:
            return _forecast(recipe, one)
        except Rejected as rejected:
            failure = failure or str(rejected)
    return CostEstimate(None, f"no recording can be labeled: {failure}")


def _forecast(recipe: Recipe, one: Recorded) -> CostEstimate:
    request = EpisodeRequest(task=one.task, seed=one.seed, source=one.source)
    start = time.process_time()
    whole = recording_stage(recipe).process(request)
    opening = (time.process_time() - start) / len(whole)
    frames, seconds = min(len(whole), _TRIAL_FRAMES), 0.0
    for n in (4, frames):  # the first compiles and loads
        seconds = sum(_seconds(recipe, _beginning(whole, n), len(whole)))
    return CostEstimate(opening + seconds / frames, f"measured on the first {frames} frames of {one.task}/{one.name}")


def _beginning(whole: Recording, n: int) -> Recording:
    rows = {name: getattr(whole, name)[:n] for name in ("time_s", "state", "action", "success")}
    return replace(whole, **rows)


def _seconds(recipe: Recipe, short: Recording, whole: int) -> Iterator[float]:
    """CPU time of every stage but the first and the last, as its frames would take it in a recording of ``whole``."""
    record: Any = short
    for stage in recipe.stages[1:-1]:
        start = time.process_time()
        with suppress(Rejected) if isinstance(stage, QualityStage) else nullcontext():
            record = stage.process(record)
        again = _coverage(stage, whole) / _coverage(stage, len(short)) if isinstance(stage, TrackStage) else 1.0
        yield (time.process_time() - start) * again


def _coverage(stage: TrackStage, steps: int) -> float:
    """How many times a frame is looked at, on average: about once for every chunk that holds it."""
    if not make_tracker(stage.tracker, stage.options).chunked:
        return 1.0
    length, stride = stage.chunks.length, stage.chunks.stride
    return sum(min(length, steps - start) for start in range(0, steps - 1, stride)) / steps


def inspect_recording(recipe: Recipe, recorded: Recorded) -> RecordingDescription | DataError:
    """What is recognized of a recording, or why nothing is."""
    try:
        return describe(Path(recorded.source), recording_stage(recipe))
    except DataError as error:
        return error
