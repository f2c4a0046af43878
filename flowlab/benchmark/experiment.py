"""Run a whole experiment: datasets, policies, their evaluations; unit by unit, each done once."""

import json
import logging
import shutil
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from flowlab.benchmark.recipe import ExperimentRecipe, curve_trials, final_trials
from flowlab.benchmark.results import read_result, unit_path, write_result
from flowlab.benchmark.units import ExperimentUnit, plan_units, receipts_of, sampling_of, share_of_units
from flowlab.data.training_settings import TrainSettings
from flowlab.engines.base import StartEngine, engine_by_name
from flowlab.errors import DataError
from flowlab.evaluation.checkpoints import find_checkpoints
from flowlab.evaluation.episode_batches import evaluate_here
from flowlab.evaluation.results import PolicyResult
from flowlab.evaluation.training_record import describe_run
from flowlab.pipeline.extraction import extract
from flowlab.pipeline.units import JobShard
from flowlab.policies.run_config import read_run_config
from flowlab.policies.run_folder import read_resume
from flowlab.policies.trained import newest_checkpoint, read_trained, step_of
from flowlab.registry import POLICIES
from flowlab.storage.manifest import differences
from flowlab.text import counted
from flowlab.training import run

_LOG = logging.getLogger(__name__)
RUNS = "runs"
"""Folder of an experiment that holds its training runs; of a finished unit, none is needed any more."""
OnProgress = Callable[[Sequence[PolicyResult], int, int], None]
"""Told results that have just come, how many there are, and how many there will be."""


def run_experiment(
    recipe: ExperimentRecipe,
    out: Path,
    *,
    engine: str = "local",
    workers: int | None = None,
    shard: JobShard = JobShard(),
    on_progress: OnProgress | None = None,
) -> list[PolicyResult]:
    """Do what has not been done yet, and return all results that there are then.

    A unit is done once its JSON is in ``out/units``; runs and datasets are needed only until then.

    Args:
        recipe: What is compared with what.
        out: The folder of the experiment.
        engine: Name or import path of what runs the workers.
        workers: Policies trained at a time; by default one for each core that this process may use.
        shard: Which part of the units to do, where several jobs do an experiment together.
        on_progress: Told results as they come, at first those of earlier calls, if something is left to do.

    Returns:
        The result of every unit that is done, in the order of :func:`flowlab.benchmark.units.plan_units`.

    Raises:
        UsageError: A name of the recipe does not exist, or its settings do not fit each other.
        DataError: A result that is there was made with other settings.
        UnfinishedError: Units failed; the same call tries them again.
    """
    units = plan_units(recipe)
    report = on_progress or (lambda fresh, done, of: None)
    known = known_results(recipe, units, out)
    todo = [u for u in share_of_units(units, shard) if u.name not in known]
    start_engine: StartEngine[ExperimentUnit, str] = engine_by_name(engine, workers, [__name__])
    for name in known:
        _discard_run(recipe, out, name)  # a kill may have left it
    _extract(recipe, todo, out, engine, workers)
    report(list(known.values()) if todo else [], len(known), len(units))
    if todo:
        with start_engine(partial(run_unit, recipe, out)) as running:
            for name in receipts_of(running, todo, "unit"):
                known[name] = read_result(unit_path(out, name))
                report([known[name]], len(known), len(units))
    return [known[u.name] for u in units if u.name in known]


def known_results(recipe: ExperimentRecipe, units: Sequence[ExperimentUnit], out: Path) -> dict[str, PolicyResult]:
    """The results that are there, by the names of their units.

    Whatever machine made them: what counts is the settings and the episodes.

    Raises:
        DataError: One is damaged, or was made with other settings.
    """
    return {u.name: result for u in units if (result := _known_result(out, u, recipe)) is not None}


def run_unit(recipe: ExperimentRecipe, out: Path, unit: ExperimentUnit) -> str:
    """A worker's part: train, evaluate, keep the result, and say its name."""
    folder = out / RUNS / unit.name
    _train(out / unit.dataset, folder, unit.settings, recipe.device)
    *earlier, last = find_checkpoints(folder)
    early = curve_trials(recipe, unit.task)
    evaluations = [evaluate_here(checkpoint, early) for checkpoint in earlier if early]
    evaluations.append(evaluate_here(last, final_trials(recipe, unit.task)))
    result = describe_run(folder, evaluations)
    renamed = {"name": unit.name, "label": unit.label, "tasks": (unit.task,)}
    write_result(unit_path(out, unit.name), result.model_copy(update=renamed))
    _discard_run(recipe, out, unit.name)
    return unit.name


def _discard_run(recipe: ExperimentRecipe, out: Path, name: str) -> None:
    """Delete the run of a unit that is done, where the recipe keeps none; not what somebody linked to."""
    folder = out / RUNS / name
    if recipe.keep_runs or not folder.is_dir():
        return
    if folder.is_symlink():
        _LOG.warning("flowlab: %s: is a link, so the run it leads to stays; delete it if you need it no more", folder)
        return
    shutil.rmtree(folder)


def _train(data: Path, folder: Path, settings: TrainSettings, device: str) -> None:
    """Train to the end, from wherever an earlier try has come to."""
    POLICIES.load(settings.policy)  # the experiment names it, not only the run
    if not _finished(folder):
        run.run(run.begin_run(data, folder, settings, run.ComputeSettings(device=device)), lambda _: None)
    else:
        _check_same(json.loads(read_trained(folder).policy.settings.model_dump_json()), settings, folder)


def _finished(folder: Path) -> bool:
    """Whether a run has come to its last step; not where a kill left its resume file behind its last weights."""
    try:
        steps = read_run_config(folder).steps
        if step_of(newest_checkpoint(folder)) < steps:
            return False
    except DataError:
        return False
    with suppress(DataError):  # finished runs are kept without it, too
        return read_resume(folder)[0] >= steps
    return True


def _extract(
    recipe: ExperimentRecipe, todo: Sequence[ExperimentUnit], out: Path, engine: str, workers: int | None
) -> None:
    """Make the datasets that units need: a moment's work beside training."""
    for folder, unit in {u.dataset: u for u in todo}.items():
        changes = [
            f"episodes={recipe.demonstrations + 1}",
            f"queries.points={recipe.query_points}",
            f"queries.sampling={sampling_of(unit.settings)}",
        ]
        extract([unit.task], out / folder, recipe=recipe.recipe, settings=changes, engine=engine, workers=workers)


def _known_result(out: Path, unit: ExperimentUnit, recipe: ExperimentRecipe) -> PolicyResult | None:
    """The result of a unit, if it is there already, with all episodes that are asked for."""
    path = unit_path(out, unit.name)
    if not path.exists():
        return None
    result = read_result(path)
    _check_same(result.training.settings, unit.settings, path)
    early, final = set(curve_trials(recipe, unit.task)), set(final_trials(recipe, unit.task))
    *earlier, last = [{o.trial for o in e.outcomes} for e in result.evaluations]
    if last == final and (not early or all(tried == early for tried in earlier)):
        return result
    if _finished(out / RUNS / unit.name):
        return None  # what is missing can be tried still
    raise DataError(
        f"{path}: has {counted(len(last), 'episode')}, and other ones than the recipe's "
        f"({recipe.episodes} of each of the seeds "
        f"{', '.join(map(str, recipe.seeds))}, {recipe.curve_episodes} at earlier checkpoints), and the run that could "
        f"try them is gone; ask for those that it has, choose another --out, or delete it to make it anew"
    )


def _check_same(found: Mapping[str, Any], recipe: TrainSettings, where: Path) -> None:
    """Refuse to mix what was made with other settings."""
    if lines := list(differences(found, json.loads(recipe.model_dump_json()), "settings", owners=("it", "the recipe"))):
        raise DataError(
            f"{where}: was made with other settings; choose another --out, or delete it to make it anew:\n  "
            + "\n  ".join(lines)
        )
