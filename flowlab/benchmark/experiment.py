"""A whole experiment from one recipe: datasets, policies, their evaluations; unit by unit, each done once."""

import json
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import yaml
from pydantic import Field, PositiveFloat, PositiveInt, ValidationError

from flowlab.benchmark.collect import describe_training
from flowlab.benchmark.results import UNITS, PolicyResult, read_result, write_result
from flowlab.config import Settings, explain, read_named
from flowlab.data.settings import TrainSettings
from flowlab.engines.local import LocalEngine, StartEngine
from flowlab.errors import DataError, UnfinishedError, UsageError, unknown_name
from flowlab.evaluation.evaluate import CheckpointRef, find_checkpoints, run_missing
from flowlab.evaluation.trials import Trial, trials
from flowlab.pipeline.extraction import extract
from flowlab.pipeline.recipe import load_recipe
from flowlab.policies.checkpoint import RUN, newest_checkpoint, read_run_config, read_trained, step_of
from flowlab.policies.settings import AnyTrainSettings, load_settings
from flowlab.registry import POLICIES
from flowlab.sim.tasks import GROUPS, select_tasks
from flowlab.storage.manifest import differences
from flowlab.training import run

RUNS, DATA = "runs", "data"
"""Folders of an experiment beside that of its results, of which alone a finished unit has need."""


class PolicyVariant(Settings):
    """A policy with other settings."""

    name: str
    """What is added to the policy's name."""
    tasks: tuple[str, ...]
    """Tasks or groups; those that are not among the experiment's are left out."""
    set: tuple[str, ...]
    """Settings of training, as for ``flowlab train --set``."""
    policy: str = "fdp"


class ExperimentRecipe(Settings):
    """What is compared with what, and how long."""

    name: str
    description: str = ""
    tasks: tuple[str, ...] = Field(min_length=1)
    """Tasks or groups."""
    policies: tuple[str, ...] = Field(min_length=1)
    demonstrations: PositiveInt
    """Trained on, of each task; one more is held out."""
    recipe: str
    """Of the datasets."""
    query_points: PositiveInt
    """In the datasets; policies take as many as they want of them."""
    profile: str
    """Of training."""
    minutes: PositiveFloat
    """Of training: CPU time of one thread, and on a GPU by the clock."""
    set: tuple[str, ...] = ()
    """Settings of training for all, as for ``flowlab train --set``."""
    seeds: tuple[int, ...]
    episodes: PositiveInt
    """Of each seed."""
    curve_episodes: int = Field(ge=0)
    """Of the first seed, for every checkpoint but the last; 0 draws no learning curves."""
    variants: tuple[PolicyVariant, ...] = ()
    device: str = "auto"


class ExperimentUnit(Settings):
    """One policy: what a worker trains and evaluates."""

    name: str
    label: str
    task: str
    dataset: str
    """Folder below the experiment's."""
    settings: AnyTrainSettings


def load_experiment(name: str, **changes: Any) -> ExperimentRecipe:
    """A recipe by file, or by the name of one that comes with flowlab, with other values for some of its keys.

    Raises :class:`UsageError` naming what is missing, unknown or wrong.
    """
    try:
        values = yaml.safe_load(read_named("experiment", name, "bench"))
    except yaml.YAMLError as error:
        raise UsageError(f"experiment {name}: not valid YAML: {error}") from error
    if not isinstance(values, dict):
        raise UsageError(f"experiment {name}: is a mapping with the keys {', '.join(ExperimentRecipe.model_fields)}")
    try:
        return ExperimentRecipe.model_validate({**values, **changes})
    except ValidationError as error:
        raise UsageError(f"experiment {name}: {explain(error, ExperimentRecipe)}") from error


def with_variants(recipe: ExperimentRecipe, names: Sequence[str]) -> ExperimentRecipe:
    """Only these of the variants."""
    known = {v.name: v for v in recipe.variants}
    for name in names:
        if name not in known:
            raise unknown_name("variant of this recipe", name, known)
    return recipe.model_copy(update={"variants": tuple(known[name] for name in names)})


def plan_units(recipe: ExperimentRecipe) -> list[ExperimentUnit]:
    """Every unit, the policies' own before the variants. Raises :class:`UsageError` where a name does not exist or
    stands for two, and where settings do not fit each other."""
    _wanted(recipe, recipe.tasks[0])
    for name in recipe.policies:
        if name not in POLICIES.plugins():
            raise unknown_name("policy", name, POLICIES.plugins())
    tasks = _tasks(recipe.tasks)
    units = [_unit(recipe, task, policy) for task in tasks for policy in recipe.policies]
    for variant in recipe.variants:
        units += [_unit(recipe, t, variant.policy, variant) for t in _tasks(variant.tasks) if t in tasks]
    for name, times in Counter(u.name for u in units).items():
        if times > 1:
            raise UsageError(f"experiment {recipe.name}: {times} units are called {name}; give every variant a name")
    return units


def run_experiment(
    recipe: ExperimentRecipe,
    out: Path,
    workers: int,
    report: Callable[[Sequence[PolicyResult], int], None] = lambda done, of: None,
) -> list[PolicyResult]:
    """Do what has not been done yet, and return all results.

    A unit is done once its JSON is in ``out/units``; runs and datasets are needed only until then. ``report`` is told
    the results so far, and how many there will be. Raises :class:`DataError` where a result that is there was made
    with other settings, and :class:`UnfinishedError` where units failed.
    """
    units = plan_units(recipe)
    known = {u.name: _known(out, u, recipe) for u in units}
    todo = [u for u in units if known[u.name] is None]
    _extract(recipe, todo, out, workers)

    def results() -> list[PolicyResult]:
        return [r for u in units if (r := known[u.name]) is not None]

    report(results(), len(units))
    failures = []
    start: StartEngine[ExperimentUnit, str] = partial(LocalEngine, workers=workers, imports=[__name__])
    with start(partial(do_unit, recipe, out)) as engine:
        for unit in todo:
            engine.submit(unit)
        for _ in todo:
            ended = engine.next_result()
            if ended.receipt is None:
                failures.append(f"{ended.unit.name}: {ended.failure.strip().splitlines()[-1]}")
                continue
            known[ended.receipt] = read_result(_place(out, ended.receipt))
            report(results(), len(units))
    if failures:
        raise UnfinishedError(f"{len(failures)} units failed, the first {failures[0]}; the same command tries again")
    return results()


def do_unit(recipe: ExperimentRecipe, out: Path, unit: ExperimentUnit) -> str:
    """A worker's part: train, evaluate, keep the result, and say its name."""
    folder = out / RUNS / unit.name
    _train(out / unit.dataset, folder, unit.settings, recipe.device)
    *earlier, last = find_checkpoints(folder)
    some, whole = _wanted(recipe, unit.task)
    wanted: list[tuple[CheckpointRef, Any]] = [*((s, some) for s in earlier if some), (last, whole)]
    for subject, of_subject in wanted:
        run_missing(subject, of_subject)
    result = PolicyResult(
        name=unit.name,
        label=unit.label,
        tasks=(unit.task,),
        training=describe_training(folder),
        evaluations=tuple(subject.evaluation(of_subject) for subject, of_subject in wanted),
    )
    write_result(_place(out, unit.name), result)
    return unit.name


def _train(data: Path, folder: Path, settings: TrainSettings, device: str) -> None:
    """Train to the end, from wherever an earlier try has come to."""
    if not (folder / RUN).exists():
        trainer = run.prepare_run(data, folder, settings, run.ComputeSettings(device=device))
    else:
        _check_same(read_trained(folder).policy.settings, settings, folder)
        if _finished(folder):
            return
        trainer = run.resume_run(folder)
    run.run(trainer, lambda _: None)


def _finished(folder: Path) -> bool:
    try:
        return step_of(newest_checkpoint(folder)) >= read_run_config(folder).steps
    except DataError:
        return False


def _extract(recipe: ExperimentRecipe, todo: Sequence[ExperimentUnit], out: Path, workers: int) -> None:
    """Make the datasets that units need: a moment's work beside training."""
    engine = partial(LocalEngine, workers=workers)
    for folder, unit in {u.dataset: u for u in todo}.items():
        flow = unit.settings.needs.flow
        sampling = "scene" if flow is None else flow.sampling
        changes = [
            f"episodes={recipe.demonstrations + 1}",
            f"queries.points={recipe.query_points}",
            f"queries.sampling={sampling}",
        ]
        extract(load_recipe(recipe.recipe, changes), (unit.task,), out / folder, start_engine=engine)


def _unit(recipe: ExperimentRecipe, task: str, policy: str, variant: PolicyVariant | None = None) -> ExperimentUnit:
    label = policy if variant is None else f"{policy}-{variant.name}"
    changes = [
        f"data.demonstrations={recipe.demonstrations}",
        "data.held_out=1",
        f"run.minutes={recipe.minutes}",
        "run.steps=null",
        *recipe.set,
        *(variant.set if variant else ()),
    ]
    settings = load_settings(recipe.profile, policy, changes)
    flow = settings.needs.flow
    sampling = "scene" if flow is None else flow.sampling
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


def _tasks(names: Sequence[str]) -> tuple[str, ...]:
    return select_tasks([n for n in names if n not in GROUPS], [n for n in names if n in GROUPS])


def _place(out: Path, name: str) -> Path:
    return out / UNITS / f"{name}.json"


def _wanted(recipe: ExperimentRecipe, task: str) -> tuple[list[Trial], list[Trial]]:
    """The episodes for every checkpoint but the last, and those for the last."""
    some = trials([task], recipe.seeds[:1], recipe.curve_episodes) if recipe.curve_episodes else []
    return some, trials([task], recipe.seeds, recipe.episodes)


def _known(out: Path, unit: ExperimentUnit, recipe: ExperimentRecipe) -> PolicyResult | None:
    """The result of a unit, if it is there already, with all episodes that are wanted."""
    path = _place(out, unit.name)
    if not path.exists():
        return None
    result = read_result(path)
    _check_same(result.training.settings, unit.settings, path)
    some, whole = _wanted(recipe, unit.task)
    *earlier, last = [{o.trial for o in e.outcomes} for e in result.evaluations]
    if last == set(whole) and (not some or all(tried == set(some) for tried in earlier)):
        return result
    if _finished(out / RUNS / unit.name):
        return None  # what is missing can be tried still
    raise DataError(
        f"{path}: has {len(last)} episodes, and other ones than the recipe's ({recipe.episodes} of each of the seeds "
        f"{', '.join(map(str, recipe.seeds))}, {recipe.curve_episodes} at earlier checkpoints), and the run that could "
        f"try them is gone; ask for those that it has, choose another --out, or delete it to make it anew"
    )


def _check_same(found: Any, wanted: TrainSettings, where: Path) -> None:
    """Refuse to mix what was made with other settings."""
    mine = json.loads(wanted.model_dump_json())
    theirs = found if isinstance(found, dict) else json.loads(found.model_dump_json())
    if lines := list(differences(theirs, mine, "settings")):
        raise DataError(
            f"{where}: was made with other settings; choose another --out, or delete it to make it anew:\n  "
            + "\n  ".join(line.replace("the dataset has", "it has").replace("this run", "the recipe") for line in lines)
        )
