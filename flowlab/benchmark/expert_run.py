"""Let MetaWorld's own experts try the episodes of an experiment, task by task, each episode once."""

import time
from collections.abc import Callable
from functools import partial
from importlib.metadata import version
from pathlib import Path

from flowlab.benchmark.expert_results import ExpertResult, expert_path, merge_experts, read_expert, write_expert
from flowlab.benchmark.recipe import ExperimentRecipe, expand_tasks, final_trials
from flowlab.benchmark.units import receipts_of
from flowlab.config import Settings
from flowlab.engines.base import StartEngine, engine_by_name
from flowlab.evaluation.expert_rollout import roll_out_expert
from flowlab.evaluation.trials import Trial
from flowlab.files import locked
from flowlab.pipeline.units import JobShard

_SIMULATOR = ("metaworld", "mujoco")


class ExpertUnit(Settings):
    """What a worker lets an expert try."""

    name: str
    """The task."""
    trials: tuple[Trial, ...]


def run_experts(
    recipe: ExperimentRecipe,
    out: Path,
    *,
    engine: str = "local",
    workers: int | None = None,
    shard: JobShard = JobShard(),
    on_result: Callable[[ExpertResult], None] = lambda _: None,
) -> list[ExpertResult]:
    """Let experts try every episode of a recipe that has no result yet, and return all results of its tasks.

    Args:
        recipe: Whose tasks, seeds and episodes are tried.
        out: The folder of the experiment.
        engine: Name or import path of what runs the workers.
        workers: Tasks at a time; by default one for each core that this process may use.
        shard: Which part of the tasks to do.
        on_result: Told each task's result as it comes.

    Raises:
        DataError: A result that is there is damaged.
        UnfinishedError: Tasks failed; the same call tries them again.
    """
    todo = missing_trials(recipe, out, shard)
    start: StartEngine[ExpertUnit, str] = engine_by_name(engine, workers, [__name__])
    if todo:
        with start(partial(run_expert_unit, out)) as running:
            for task in receipts_of(running, todo, "task"):
                on_result(read_expert(expert_path(out, task)))
    paths = [expert_path(out, task) for task in expand_tasks(recipe.tasks)]
    return [read_expert(path) for path in paths if path.exists()]


def missing_trials(recipe: ExperimentRecipe, out: Path, shard: JobShard = JobShard()) -> list[ExpertUnit]:
    """What a job has still to try, task by task."""
    units = []
    for task in expand_tasks(recipe.tasks)[shard.index :: shard.count]:
        path = expert_path(out, task)
        known = {o.trial for o in read_expert(path).outcomes} if path.exists() else set()
        if missing := tuple(t for t in final_trials(recipe, task) if t not in known):
            units.append(ExpertUnit(name=task, trials=missing))
    return units


def run_expert_unit(out: Path, unit: ExpertUnit) -> str:
    """A worker's part: try the episodes, add them to those that are there, and say which task it was."""
    began = time.process_time()
    outcomes = tuple(roll_out_expert(unit.trials))
    result = ExpertResult(
        task=unit.name,
        cpu_s=round(time.process_time() - began, 1),
        versions={name: version(name) for name in _SIMULATOR},
        outcomes=outcomes,
    )
    path = expert_path(out, unit.name)
    path.parent.mkdir(parents=True, exist_ok=True)
    with locked(path.parent):
        write_expert(path, merge_experts([*([read_expert(path)] if path.exists() else []), result], path))
    return unit.name
