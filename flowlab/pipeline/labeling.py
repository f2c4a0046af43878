"""Datasets of recordings: their points are followed through the pictures."""

import json
import logging
import os
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from flowlab.arguments import check_path, check_paths, check_settings
from flowlab.engines.base import StartEngine
from flowlab.errors import DataError, FlowlabError, UsageError
from flowlab.pipeline.filling import engine_for, fill
from flowlab.pipeline.recipe import Recipe, load_recipe
from flowlab.pipeline.scheduling import ExtractionProgress, RecordingScheduler
from flowlab.pipeline.stages.recording import RecordingStage
from flowlab.pipeline.units import JobShard, WorkUnit
from flowlab.recordings.base import DatasetReader, choose_reader
from flowlab.recordings.identity import difference, identity
from flowlab.recordings.parsing import files_of_metadata
from flowlab.recordings.parts import split_path
from flowlab.recordings.recording import RecordingSettings, find_recordings
from flowlab.recordings.recording_yaml import load_metadata
from flowlab.storage.dataset import Dataset
from flowlab.storage.manifest import Manifest
from flowlab.storage.receipts import Receipt, read_receipts
from flowlab.storage.recorded import Recorded, number_recordings
from flowlab.text import file_name, is_plain_name, shown

_LOG = logging.getLogger(__name__)


def label(
    paths: Iterable[Path | str] | Path | str,
    out: Path | str,
    *,
    task: str | None = None,
    tracker: str | None = None,
    calibration: Path | str | None = None,
    weights: Path | str | None = None,
    recipe: str | Recipe = "real",
    settings: Iterable[str] = (),
    engine: str = "local",
    workers: int | None = None,
    shard: JobShard | str = JobShard(),
    repair: bool = False,
    on_progress: Callable[[ExtractionProgress], None] | None = None,
) -> Dataset:
    """Make a dataset of RGB-D recordings with estimated tracks, as ``flowlab track-real`` does.

    Args:
        paths: Recordings, or folders with recordings below; or one of them.
        out: Folder of the dataset. One that was made with the same settings is continued or extended.
        task: Task of all of them; None for what they say themselves, or the name of the folder they are in.
        tracker: Name of a tracker; None for the recipe's.
        calibration: YAML file with calibration for all of them.
        weights: File with the weights of a learned tracker.
        recipe: Name of a recipe that comes with flowlab, path of a YAML file, or a recipe.
        settings: Changes of single settings, ``queries.points=200``.
        engine: Where it is done: the name of an engine.
        workers: Processes; None for one for each core.
        shard: The part to do, for jobs that fill one dataset together: ``0/4``.
        repair: Read all that is there, and make again what is damaged.
        on_progress: Called whenever a recording is done.

    Returns:
        The dataset, complete but for what other shards do. What was rejected is in ``rejects``.

    Raises:
        UsageError: A path, a name, a setting or the recipe does not fit.
        DataError: The folder holds a dataset that was made with other settings.
        UnfinishedError: Some units failed; the dataset is whole, and the same call does the rest.
    """
    chosen = labeling_recipe(recipe, settings, tracker=tracker, calibration=calibration, weights=weights)
    return label_recordings(
        chosen,
        find_jobs(chosen, check_paths(paths, "paths"), task),
        check_path(out, "out"),
        start_engine=engine_for(chosen, engine, workers),
        share=JobShard.parse(shard) if isinstance(shard, str) else shard,
        report=on_progress or (lambda _: None),
        repair=repair,
    )


def labeling_recipe(
    recipe: str | Recipe,
    settings: Iterable[str] = (),
    *,
    tracker: str | None = None,
    calibration: Path | str | None = None,
    weights: Path | str | None = None,
) -> Recipe:
    """The recipe that :func:`label` goes by, given its arguments."""
    short = {"track.tracker": tracker, "track.options.weights": weights, "recording.calibration": calibration}
    changes = [f"{key}={json.dumps(str(value))}" for key, value in short.items() if value is not None]
    return load_recipe(recipe, [*check_settings(settings), *changes])


def find_jobs(recipe: Recipe, paths: Sequence[Path], task: str | None = None) -> tuple[Recorded, ...]:
    """Every recording at or below the paths, numbered as a new dataset would number them.

    Its task is ``task``, else what its ``recording.yaml`` or the calibration file says, else what a dataset says that
    it is an episode of, else the name of the folder that holds it, or of the file without its ending.
    """
    settings = recording_stage(recipe)
    found = []
    for path in find_recordings(paths, settings.reader, settings):
        place = Path(os.path.abspath(path))
        name = task or _task_said(place, settings) or _task_told(place, settings) or _task_by_place(place)
        if not is_plain_name(name):
            raise UsageError(f"{path}: {shown(name)} cannot be the name of a task; give one with --task")
        if not is_plain_name(place.name):
            raise UsageError(f"{path}: {shown(place.name)} cannot be the name of a recording; rename it")
        content = ""
        with suppress(FlowlabError):  # opening it will say what is wrong, of it alone
            content = identity(place, settings)
        found.append(Recorded(task=name, name=place.name, source=str(place), content=content))
    return number_recordings((), found)


def recording_stage(recipe: Recipe) -> RecordingStage:
    """The stage that opens recordings, which the recipe must begin with."""
    first = recipe.stages[0] if recipe.stages else None
    if not isinstance(first, RecordingStage):
        raise UsageError(f"recipe {recipe.name}: track-real needs a 'recording' stage at the start")
    return first


def _task_by_place(path: Path) -> str:
    """What holds a recording: its folder, or the file that it is a part of."""
    place, part = split_path(path)
    if not part:
        return place.parent.name
    return place.name if place.is_dir() else place.stem


def _task_told(path: Path, settings: RecordingSettings) -> str | None:
    """What a dataset says is done in an episode of it, as a name."""
    with suppress(FlowlabError):  # opening it will say what is wrong, of it alone
        reader = choose_reader(path, settings.reader)
        told = reader.task(path) if isinstance(reader, DatasetReader) else None
        return file_name(told) if told else None
    return None


def _task_said(path: Path, settings: RecordingSettings) -> str | None:
    """What the task is called by the calibration file, or by a recording's own."""
    said = [load_metadata(settings.calibration).task] if settings.calibration else []
    for file in filter(Path.is_file, files_of_metadata(path)):
        with suppress(DataError):  # opening it will say what is wrong, of it alone
            said.append(load_metadata(file).task)
    return next((task for task in said if task is not None), None)


def label_recordings(
    recipe: Recipe,
    recordings: Sequence[Recorded],
    folder: Path,
    *,
    start_engine: StartEngine[WorkUnit, Receipt],
    share: JobShard = JobShard(),
    report: Callable[[ExtractionProgress], None] = lambda _: None,
    repair: bool = False,
) -> Dataset:
    """Label recordings into ``folder``; what an earlier run did is kept, but what it could not open is tried again.

    See :func:`flowlab.pipeline.filling.fill` for what is raised.
    """
    manifest = Manifest(
        recipe=recipe.name,
        settings=recipe.settings(),
        provenance=recipe.pipeline().provenance(recordings[0].task if recordings else ""),
        first_seed=0,
        requested=dict(Counter(r.task for r in recordings)),
        recordings=tuple(recordings),
    )
    asked = {r.source for r in recordings}

    def plan_for(manifest: Manifest) -> RecordingScheduler:
        mine = [r for r in manifest.recordings if r.source in asked]
        _forget_outdated(folder, {r.seed: r for r in mine if r.seed % share.count == share.index})
        return RecordingScheduler(mine)

    return fill(
        recipe, manifest, plan_for, folder, start_engine=start_engine, share=share, report=report, repair=repair
    )


def _forget_outdated(folder: Path, recordings: Mapping[int, Recorded]) -> None:
    """Remove the receipts of recordings that are to be labeled again, of which the user is told.

    They have changed since; or they could not be opened, and their users were told how to mend them.
    """
    for receipt in read_receipts(folder):
        if not set(receipt.seeds) <= recordings.keys():
            continue
        changed = [
            f"{one.source}: {difference(content, one.content)} changed since it was labeled; it is labeled again"
            for seed, content in zip(receipt.seeds, receipt.contents, strict=False)
            if (one := recordings[seed]).content and content and content != one.content
        ]
        for sentence in changed:
            _LOG.warning("flowlab: %s", sentence)
        if changed or (receipt.rejects and all(x.retry for x in receipt.rejects)):
            (folder / "receipts" / f"{receipt.unit}.json").unlink(missing_ok=True)
