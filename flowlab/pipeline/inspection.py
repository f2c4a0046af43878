"""What labeling recordings would take: what is recognized of them, and how long it lasts. Nothing is written."""

import time
from collections.abc import Iterator, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from flowlab.engines.base import core_count
from flowlab.errors import DataError
from flowlab.perception.observer import Box
from flowlab.pipeline.labeling import recording_stage
from flowlab.pipeline.recipe import Recipe
from flowlab.pipeline.stage import EpisodeRequest, Rejected
from flowlab.pipeline.stages.observe import ObserverStage
from flowlab.pipeline.stages.quality import QualityStage
from flowlab.pipeline.stages.recording import TrackStage
from flowlab.recordings.description import RecordingDescription, describe_parsed
from flowlab.recordings.parsing import parse_recording
from flowlab.recordings.preview import RecordingPreview, preview_recording
from flowlab.recordings.recording import Recording
from flowlab.storage.recorded import Recorded
from flowlab.text import counted
from flowlab.tracking.base import make_tracker

_TRIAL_FRAMES = 33
"""As many frames are labeled to tell what all will cost."""


@dataclass(frozen=True, slots=True)
class InspectedRecording:
    """A recording, and what is recognized of it."""

    recorded: Recorded
    description: RecordingDescription | None
    """None where nothing could be recognized."""
    problem: str | None
    """Why it cannot be labeled as it is; None where it can."""
    preview: RecordingPreview | None = None
    """What can be shown of it; None where that was not asked for."""


def inspect_recordings(
    recipe: Recipe, recordings: Sequence[Recorded], *, previews: bool = False
) -> Iterator[InspectedRecording]:
    """What is recognized of every recording, one after the other, and if asked what can be shown of it."""
    settings = recording_stage(recipe)
    for recorded in recordings:
        path, source = Path(recorded.source), None
        try:
            source = parse_recording(path, settings)
            found = describe_parsed(source, settings)
            one = InspectedRecording(recorded, found, found.problem)
        except DataError as error:
            one = InspectedRecording(recorded, None, str(error))
        yield replace(one, preview=preview_recording(path, settings, source)) if previews else one


def workspace(recipe: Recipe, task: str) -> Box | None:
    """The box in which points of a task are kept; None where the recipe has no observer."""
    observer = next((s for s in recipe.stages if isinstance(s, ObserverStage)), None)
    return None if observer is None else observer.crop_for(task)


def frame_count(inspected: Sequence[InspectedRecording]) -> int:
    """Frames of those recordings that have no problem."""
    return sum(x.description.rows for x in inspected if x.description is not None and x.problem is None)


@dataclass(frozen=True, slots=True)
class LabelingEstimate:
    """How long labeling what can be labeled takes."""

    frames: int
    cpu_ms_per_frame: float | None
    """None where no recording can be labeled."""
    workers: int
    estimated_minutes: float | None
    estimate: str
    """How that was found, or why not."""


def estimate_labeling(
    recipe: Recipe, inspected: Sequence[InspectedRecording], workers: int | None = None
) -> LabelingEstimate:
    """How long labeling those recordings that have no problem takes, by the first frames of one of them."""
    cost = estimate_cost(recipe, [x.recorded for x in inspected])
    frames = frame_count(inspected)
    seconds, workers = cost.cpu_s_per_frame, workers or core_count()
    return LabelingEstimate(
        frames=frames,
        cpu_ms_per_frame=None if seconds is None else round(1e3 * seconds, 1),
        workers=workers,
        estimated_minutes=None if seconds is None else round(frames * seconds / workers / 60, 2),
        estimate=cost.basis,
    )


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
            return _measure(recipe, one)
        except Rejected as rejected:
            failure = failure or str(rejected)
    return CostEstimate(None, f"no recording can be labeled: {failure}")


def _measure(recipe: Recipe, one: Recorded) -> CostEstimate:
    request = EpisodeRequest(task=one.task, seed=one.seed, source=one.source)
    start = time.process_time()
    whole = recording_stage(recipe).process(request)
    opening = (time.process_time() - start) / len(whole)
    frames, seconds = min(len(whole), _TRIAL_FRAMES), 0.0
    for n in (4, frames):  # the first compiles and loads
        seconds = sum(_seconds(recipe, _beginning(whole, n), len(whole)))
    return CostEstimate(
        opening + seconds / frames, f"measured on the first {counted(frames, 'frame')} of {one.task}/{one.name}"
    )


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
