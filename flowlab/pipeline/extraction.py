"""Fill a dataset by a recipe: plan units, run them on an engine, keep the books."""

import errno
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from flowlab.engines.base import Engine, StartEngine, UnitResult
from flowlab.errors import FlowlabError, MissingFileError, UnfinishedError
from flowlab.pipeline.recipe import Recipe
from flowlab.pipeline.scheduling import ExtractionProgress, SeedScheduler, UnitScheduler
from flowlab.pipeline.stage import EpisodeRequest, Rejected
from flowlab.pipeline.units import JobShard, WorkUnit
from flowlab.pipeline.worker import run_unit
from flowlab.storage.dataset import Dataset, begin, summarize
from flowlab.storage.manifest import Manifest, Receipt, read_receipts
from flowlab.storage.schema import SCHEMA

__all__ = ["ExtractionProgress", "estimate", "extract", "fill", "manifest_for", "run_all"]

_SECONDS_BETWEEN_SUMMARIES = 5.0


def manifest_for(recipe: Recipe, tasks: tuple[str, ...]) -> Manifest:
    """The manifest of the dataset a recipe makes."""
    provenance = recipe.pipeline().provenance(tasks[0])
    if not provenance.is_simulated:
        raise FlowlabError(f"recipe {recipe.name}: extract-sim needs a stage that simulates at the start, as 'expert'")
    return Manifest(
        recipe=recipe.name,
        settings=recipe.settings(),
        provenance=provenance,
        first_seed=recipe.first_seed,
        requested=dict.fromkeys(tasks, recipe.episodes),
    )


def extract(
    recipe: Recipe,
    tasks: tuple[str, ...],
    folder: Path,
    *,
    start_engine: StartEngine[WorkUnit, Receipt],
    share: JobShard = JobShard(),
    report: Callable[[ExtractionProgress], None] = lambda _: None,
) -> Dataset:
    """Fill ``folder`` until every task has its episodes; what an earlier run did is kept.

    ``start_engine`` makes an engine for the function that does a unit, as
    ``partial(LocalEngine, workers=4)`` does.

    See :func:`fill` for what is raised.
    """
    plan = SeedScheduler(dict.fromkeys(tasks, recipe.episodes), recipe.first_seed)
    manifest = manifest_for(recipe, tasks)
    return fill(recipe, manifest, lambda _: plan, folder, start_engine=start_engine, share=share, report=report)


def fill(
    recipe: Recipe,
    manifest: Manifest,
    plan_for: Callable[[Manifest], UnitScheduler],
    folder: Path,
    *,
    start_engine: StartEngine[WorkUnit, Receipt],
    share: JobShard,
    report: Callable[[ExtractionProgress], None],
) -> Dataset:
    """Run a plan, made for the manifest as it is on disk, until there is nothing left of it, and keep the books.

    Raises :class:`UnfinishedError` where units failed, and :class:`FlowlabError` where going on is useless;
    the dataset is whole in either case.
    """
    log = folder / "failures.log"
    try:
        manifest = begin(folder, manifest)
        log.unlink(missing_ok=True)
    except MissingFileError:
        raise
    except OSError as error:
        raise _storage_error(folder, error) from error
    work = partial(run_unit, recipe.model_dump_json(), recipe.folder, manifest.settings_digest, folder)
    try:
        with start_engine(work) as engine:
            failures = run_all(engine, plan_for(manifest), folder, share, report)
        dataset = summarize(folder)
    except MissingFileError:
        raise
    except OSError as error:
        raise _storage_error(folder, error) from error
    except BaseException:
        with suppress(OSError):  # what ended the run is what the user must hear of
            summarize(folder)
        raise
    if failures:
        log.write_text("\n\n".join(f"{f.unit.name}\n{f.failure}" for f in failures))
        last = failures[0].failure.strip().split("\n")[-1]
        raise UnfinishedError(
            f"{len(failures)} units failed, the first ({failures[0].unit.name}) with: {last}. "
            f"All are in {log}; the same command tries them again"
        )
    return dataset


def estimate(recipe: Recipe, tasks: tuple[str, ...], folder: Path, workers: int) -> dict[str, Any]:
    """What :func:`extract` would do, timed on the first seed of the first task; nothing is written."""
    pipeline = recipe.pipeline()
    request = EpisodeRequest(task=tasks[0], seed=recipe.first_seed)
    try:
        pipeline.run(request)  # compiles and loads
        start = time.process_time()
        episode = pipeline.run(request)
    except Rejected as rejected:
        raise FlowlabError(
            f"{request.task} seed {request.seed} is rejected at {rejected.stage} ({rejected}): no estimate"
        ) from rejected
    seconds = time.process_time() - start
    have = Counter(task for r in read_receipts(folder) for task in [r.task] * len(r.accepted))
    todo = sum(max(recipe.episodes - have[t], 0) for t in tasks)
    frame_bytes = sum(v.nbytes for s in SCHEMA if s.per_step and (v := s.of(episode)) is not None)
    return {
        "tasks": len(tasks),
        "episodes_wanted": recipe.episodes * len(tasks),
        "episodes_to_do": todo,
        "frames_per_episode": f"{len(episode)} ({request.task} seed {request.seed})",
        "cpu_s_per_episode": round(seconds, 3),
        "workers": workers,
        "estimated_minutes": round(todo * seconds / workers / 60, 2),
        "estimated_megabytes": round(todo * frame_bytes / 1e6, 1),
        "out": str(folder),
    }


def run_all(
    engine: Engine[WorkUnit, Receipt],
    plan: UnitScheduler,
    folder: Path,
    share: JobShard,
    report: Callable[[ExtractionProgress], None],
) -> list[UnitResult[WorkUnit, Receipt]]:
    """Submit units and collect outcomes until nothing is left that this run could do; returns the failures."""
    receipts = _receipts_by_unit(folder)
    under_way: dict[str, WorkUnit] = {}
    failures: list[UnitResult[WorkUnit, Receipt]] = []
    next_summary = time.monotonic() + _SECONDS_BETWEEN_SUMMARIES
    while True:
        taken = [*under_way.values(), *(f.unit for f in failures)]
        for unit in plan.next_units(receipts.values(), taken, share):
            under_way[unit.name] = unit
            engine.submit(unit)
        report(plan.progress(receipts.values()))
        if not under_way:
            seen, receipts = receipts.keys(), _receipts_by_unit(folder)
            if receipts.keys() == seen:  # otherwise jobs beside this one went on: is there more to do now?
                return failures
            continue
        outcome = engine.next_result()
        del under_way[outcome.unit.name]
        if outcome.receipt is None:
            failures.append(outcome)
        else:
            receipts[outcome.unit.name] = outcome.receipt
        if time.monotonic() > next_summary:
            start = time.monotonic()
            summarize(folder)
            next_summary = time.monotonic() + max(_SECONDS_BETWEEN_SUMMARIES, 20 * (time.monotonic() - start))


def _receipts_by_unit(folder: Path) -> dict[str, Receipt]:
    return {r.unit: r for r in read_receipts(folder)}


def _storage_error(folder: Path, error: OSError) -> FlowlabError:
    """The sentence for a disk that will not take more."""
    causes = {
        errno.ENOSPC: "no space is left on its disk; free some",
        errno.EDQUOT: "your disk quota is used up; free some space",
        errno.EACCES: "writing is not permitted; change its permissions",
        errno.EROFS: "it is on a read-only disk; move it",
    }
    cause = causes.get(error.errno or 0, f"{error.strerror or error}; see to it")
    return FlowlabError(
        f"{folder}: {cause}, then run the same command again: what was finished is kept, and it does the rest"
    )
