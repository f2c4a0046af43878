"""Fill a dataset by a recipe: run planned units on an engine, and keep the books."""

import errno
import logging
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path

from flowlab.engines.base import Engine, StartEngine, UnitResult, engine_by_name
from flowlab.errors import DataError, FlowlabError, MissingFileError, UnfinishedError
from flowlab.pipeline.recipe import Recipe
from flowlab.pipeline.scheduling import ExtractionProgress, UnitScheduler
from flowlab.pipeline.units import JobShard, WorkUnit
from flowlab.pipeline.worker import run_unit
from flowlab.storage.dataset import Dataset, begin, summarize
from flowlab.storage.manifest import Manifest
from flowlab.storage.receipts import Receipt, read_receipts
from flowlab.storage.repair import forget_damaged
from flowlab.text import counted

_LOG = logging.getLogger(__name__)
_SECONDS_BETWEEN_SUMMARIES = 5.0
_AHEAD = 4
"""So many units for each worker are under way, or the plan is asked for more."""


def engine_for(recipe: Recipe, engine: str, workers: int | None) -> StartEngine[WorkUnit, Receipt]:
    """What makes an engine for the units of a recipe. Raises :class:`UsageError` where there is none of that name."""
    stages = [type(s).__module__ for s in recipe.stages if ":" not in s.stage]
    return engine_by_name(engine, workers, ["flowlab.pipeline.worker", *dict.fromkeys(stages)])


def fill(
    recipe: Recipe,
    manifest: Manifest,
    plan_for: Callable[[Manifest], UnitScheduler],
    folder: Path,
    *,
    start_engine: StartEngine[WorkUnit, Receipt],
    share: JobShard,
    report: Callable[[ExtractionProgress], None],
    repair: bool = False,
) -> Dataset:
    """Run a plan, made for the manifest as it is on disk, until there is nothing left of it, and keep the books.

    Units whose receipt is damaged or whose shard is gone are made again; with ``repair`` every shard is read, and those
    that are damaged are made again, too.

    Raises :class:`UnfinishedError` where units failed, and :class:`FlowlabError` where going on is useless;
    the dataset is whole in either case.
    """

    def work_for(manifest: Manifest) -> Callable[[WorkUnit], Receipt]:
        return partial(run_unit, recipe.model_dump_json(), recipe.folder, manifest.settings_digest, folder)

    return fill_by(
        work_for, manifest, plan_for, folder, start_engine=start_engine, share=share, report=report, repair=repair
    )


def fill_by(
    work_for: Callable[[Manifest], Callable[[WorkUnit], Receipt]],
    manifest: Manifest,
    plan_for: Callable[[Manifest], UnitScheduler],
    folder: Path,
    *,
    start_engine: StartEngine[WorkUnit, Receipt],
    share: JobShard,
    report: Callable[[ExtractionProgress], None],
    repair: bool = False,
) -> Dataset:
    """The same, where a unit is done by what ``work_for`` gives for the manifest as it is on disk."""
    log = folder / "failures.log"
    try:
        manifest = begin(folder, manifest)
        for problem in forget_damaged(folder, thorough=repair):
            _LOG.warning("flowlab: %s; the unit is to be made again", problem)
        log.unlink(missing_ok=True)
    except MissingFileError:
        raise
    except OSError as error:
        raise _storage_error(folder, error) from error
    try:
        with start_engine(work_for(manifest)) as engine:
            failures = run_all(engine, plan_for(manifest), folder, share, report)
        dataset = summarize(folder)
    except MissingFileError:
        raise
    except OSError as error:
        raise _storage_error(folder, error) from error
    except BaseException:
        with suppress(OSError, DataError):  # what ended the run is what the user must hear of
            summarize(folder)
        raise
    if failures:
        log.write_text("\n\n".join(f"{f.unit.name}\n{f.failure}" for f in failures))
        last = failures[0].failure.strip().split("\n")[-1]
        raise UnfinishedError(
            f"{counted(len(failures), 'unit')} failed, the first ({failures[0].unit.name}) with: {last}. "
            f"All are in {log}; the same command tries them again"
        )
    return dataset


def run_all(
    engine: Engine[WorkUnit, Receipt],
    plan: UnitScheduler,
    folder: Path,
    share: JobShard,
    report: Callable[[ExtractionProgress], None],
) -> list[UnitResult[WorkUnit, Receipt]]:
    """Submit units and collect outcomes until nothing is left that this run could do; returns the failures.

    The plan is asked again only when what it gave before is nearly done, and the books are summed up the less often the
    longer that takes: both look at all that there is, and a run of many units would do little else.
    """
    receipts = _receipts_by_unit(folder)
    under_way: dict[str, WorkUnit] = {}
    failures: list[UnitResult[WorkUnit, Receipt]] = []
    tell = _Seldom(lambda: report(plan.progress(receipts.values())), least_seconds=0.0)
    sum_up = _Seldom(lambda: summarize(folder), least_seconds=_SECONDS_BETWEEN_SUMMARIES)
    while True:
        if len(under_way) < _AHEAD * engine.workers:
            taken = [*under_way.values(), *(f.unit for f in failures)]
            for unit in plan.next_units(receipts.values(), taken, share):
                under_way[unit.name] = unit
                engine.submit(unit)
        tell(at_once=not under_way)
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
            _check_shared(folder, outcome.unit)
            receipts[outcome.unit.name] = outcome.receipt
        sum_up()


class _Seldom:
    """Does something whose cost grows with what there is, so seldom that it takes a twentieth of the time at most."""

    def __init__(self, work: Callable[[], object], least_seconds: float) -> None:
        self._work, self._least = work, least_seconds
        self._next = time.monotonic() + least_seconds

    def __call__(self, at_once: bool = False) -> None:
        """Do it if it is time to, or ``at_once``."""
        start = time.monotonic()
        if at_once or start >= self._next:
            self._work()
            end = time.monotonic()
            self._next = end + max(self._least, 20 * (end - start))


def _check_shared(folder: Path, unit: WorkUnit) -> None:
    """Refuse a folder that workers on other machines do not share with this one: nothing they make would be found."""
    if not (folder / "receipts" / f"{unit.name}.json").exists():
        raise DataError(
            f"{folder}: a worker says that it made {unit.name}, but its receipt is not here; --out must be a folder "
            f"that all machines of the engine share, at the same path"
        )


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
