"""The units of an experiment: each one policy on one task, with all its settings."""

import json
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any

from flowlab.benchmark.recipe import ExperimentRecipe, PolicyVariant, expand_tasks, final_trials
from flowlab.config import Settings
from flowlab.data.training_settings import TrainSettings
from flowlab.engines.base import Engine, core_count
from flowlab.errors import UnfinishedError, UsageError, unknown_name
from flowlab.pipeline.units import JobShard
from flowlab.policies.profiles import AnyTrainSettings, load_settings
from flowlab.registry import POLICIES
from flowlab.text import counted

DATA = "data"
"""Folder of an experiment that holds its datasets."""


class ExperimentUnit(Settings):
    """One policy: what a worker trains and evaluates."""

    name: str
    label: str
    task: str
    dataset: str
    """Folder below the experiment's."""
    settings: AnyTrainSettings


def plan_units(recipe: ExperimentRecipe) -> list[ExperimentUnit]:
    """Every unit, the policies' own before the variants.

    Raises:
        UsageError: A name does not exist or stands for two, or settings do not fit each other.
    """
    final_trials(recipe, recipe.tasks[0])  # seeds and episodes must exist
    for name in recipe.policies:
        if ":" not in name and name not in POLICIES.plugins():
            raise unknown_name("policy", name, POLICIES.plugins())
    tasks = expand_tasks(recipe.tasks)
    units = [_unit(recipe, task, policy) for task in tasks for policy in recipe.policies]
    for variant in recipe.variants:
        units += [_unit(recipe, t, variant.policy, variant) for t in expand_tasks(variant.tasks) if t in tasks]
    for name, times in Counter(u.name for u in units).items():
        if times > 1:
            raise UsageError(f"experiment {recipe.name}: {times} units are called {name}; give every variant a name")
    return units


def receipts_of(engine: Engine[Any, str], units: Sequence[Any], what: str) -> Iterator[str]:
    """Have an engine do units that have names, and hand back their receipts as they come.

    Raises :class:`UnfinishedError` in the end where some failed; ``what`` is what one of them is.
    """
    failures = []
    for ended in engine.results_of(units):
        if ended.receipt is None:
            failures.append(f"{ended.unit.name}: {ended.reason}")
        else:
            yield ended.receipt
    if failures:
        failed = counted(len(failures), what)
        raise UnfinishedError(f"{failed} failed, the first {failures[0]}; the same command tries again")


def plan_cost(recipe: ExperimentRecipe, units: int, workers: int | None = None) -> str:
    """A sentence on how long training will take; where only its steps are known, on how many there are."""
    policies = counted(units, "policy", "policies")
    if recipe.minutes is None:
        tried = counted(len(set(recipe.seeds)) * recipe.episodes, "episode")
        return f"{policies}, {recipe.steps} steps of training and {tried} each"
    workers = workers or core_count()
    hours = units * recipe.minutes / 60
    return (
        f"{policies}, {recipe.minutes:g} minutes of training each: {hours:.1f} hours of one core, "
        f"{hours / workers:.1f} on {workers}"
    )


def share_of_units(units: Sequence[ExperimentUnit], shard: JobShard) -> list[ExperimentUnit]:
    """A job's part of the units: those of every ``count``-th dataset, so that no two jobs make the same one."""
    datasets = list(dict.fromkeys(u.dataset for u in units))[shard.index :: shard.count]
    return [u for u in units if u.dataset in datasets]


def _unit(recipe: ExperimentRecipe, task: str, policy: str, variant: PolicyVariant | None = None) -> ExperimentUnit:
    """One policy on one task, with the settings of the recipe and of its variant."""
    label = f"{policy}-{variant.name}" if variant and variant.name else policy
    changes = [
        f"data.demonstrations={recipe.demonstrations}",
        "data.held_out=1",
        f"run.minutes={json.dumps(recipe.minutes)}",
        f"run.steps={json.dumps(recipe.steps)}",
        *recipe.set,
        *(variant.set if variant else ()),
    ]
    settings = load_settings(recipe.profile, policy, changes)
    flow, sampling = settings.needs.flow, sampling_of(settings)
    if flow is not None and flow.points > recipe.query_points:
        raise UsageError(
            f"experiment {recipe.name}: {task}-{label} wants {flow.points} query points, and the datasets get "
            f"{recipe.query_points}; raise query_points"
        )
    return ExperimentUnit(
        name=f"{task}-{label}",
        label=label,
        task=task,
        dataset=f"{DATA}/{task}" + ("" if sampling == "scene" else f"-{sampling}"),
        settings=settings,
    )


def sampling_of(settings: TrainSettings) -> str:
    """Which query points the dataset of a policy gets; a policy that follows none takes what there is for others."""
    flow = settings.needs.flow
    return "scene" if flow is None else flow.sampling
