"""The recipe of an experiment: what is compared with what, and how long."""

from collections.abc import Sequence
from typing import Any

from pydantic import Field, PositiveFloat, PositiveInt, ValidationError, model_validator

from flowlab.config import Settings, explain, read_named
from flowlab.errors import UsageError, unknown_name
from flowlab.evaluation.trials import Trial, list_trials
from flowlab.registry import POLICIES, names_from_file
from flowlab.sim.tasks import tasks_named
from flowlab.untrusted import parse_yaml


class PolicyVariant(Settings):
    """A policy with other settings."""

    name: str = ""
    """What is added to the policy's name; nothing for a policy as it is, on these tasks only."""
    tasks: tuple[str, ...]
    """Tasks or groups; those that are not among the experiment's are left out."""
    set: tuple[str, ...] = ()
    """Settings of training, as for ``flowlab train --set``."""
    policy: str = "fdp"
    """Name or import path of its kind."""


class ExperimentRecipe(Settings):
    """What is compared with what, and how long."""

    name: str
    """What the experiment is called in its report."""
    description: str = ""
    """What it is for, in a sentence."""
    tasks: tuple[str, ...] = Field(min_length=1)
    """Tasks or groups."""
    policies: tuple[str, ...] = Field(min_length=1)
    """Names or import paths of what is trained."""
    demonstrations: PositiveInt
    """Trained on, of each task; one more is held out."""
    recipe: str
    """Of the datasets."""
    query_points: PositiveInt
    """In the datasets; a policy takes as many of them as its settings say."""
    profile: str
    """Of training."""
    minutes: PositiveFloat | None = None
    """Of training: CPU time of one thread, and on a GPU by the clock."""
    steps: PositiveInt | None = None
    """Of training, instead of ``minutes``: what comes out then depends on no machine's speed."""
    set: tuple[str, ...] = ()
    """Settings of training for all, as for ``flowlab train --set``."""
    seeds: tuple[int, ...]
    """Of evaluation: they decide which scenes policies meet."""
    episodes: PositiveInt
    """Of each seed."""
    curve_episodes: int = Field(ge=0)
    """Of the first seed, for every checkpoint but the last; 0 draws no learning curves."""
    variants: tuple[PolicyVariant, ...] = ()
    """Policies with other settings, or on some of the tasks only."""
    device: str = "auto"
    """Where policies are trained: ``auto``, ``cpu``, ``cuda`` or ``cuda:1``; ``auto`` is a GPU if there is one."""
    keep_runs: bool = True
    """Whether the training run of a finished unit is kept, which has some 100 MB; its result always is."""

    @model_validator(mode="after")
    def _says_how_long(self) -> "ExperimentRecipe":
        if (self.minutes is None) == (self.steps is None):
            raise ValueError("give either minutes or steps of training")
        return self


def load_experiment(name: str, **changes: Any) -> ExperimentRecipe:
    """A recipe by file, or by the name of one that comes with flowlab, with other values for some of its keys.

    Raises :class:`UsageError` naming what is missing, unknown or wrong.
    """
    try:
        values = parse_yaml(read_named("experiment", name, "bench"))
    except ValueError as error:
        raise UsageError(f"experiment {name}: not valid YAML: {error}") from error
    if not isinstance(values, dict):
        raise UsageError(f"experiment {name}: is a mapping with the keys {', '.join(ExperimentRecipe.model_fields)}")
    try:
        recipe = ExperimentRecipe.model_validate({**values, **changes})
    except ValidationError as error:
        raise UsageError(f"experiment {name}: {explain(error, ExperimentRecipe)}") from error
    with names_from_file(but=changes.get("policies", ())):
        for policy in (*recipe.policies, *(v.policy for v in recipe.variants)):
            if ":" in policy:
                POLICIES.load(policy)
    return recipe


def with_variants(recipe: ExperimentRecipe, names: Sequence[str]) -> ExperimentRecipe:
    """Only these of the variants. Raises :class:`UsageError` where the recipe has none of a name."""
    known = {v.name for v in recipe.variants}
    for name in names:
        if name not in known:
            raise unknown_name("variant of this recipe", name, known)
    return recipe.model_copy(update={"variants": tuple(v for v in recipe.variants if v.name in names)})


def expand_tasks(names: Sequence[str]) -> tuple[str, ...]:
    """The tasks of a list of tasks and groups of them. Raises :class:`UsageError` where a name does not exist."""
    return tasks_named(names)


def curve_trials(recipe: ExperimentRecipe, task: str) -> list[Trial]:
    """The episodes for every checkpoint but the last."""
    return list_trials([task], recipe.seeds[:1], recipe.curve_episodes) if recipe.curve_episodes else []


def final_trials(recipe: ExperimentRecipe, task: str) -> list[Trial]:
    """The episodes for the last checkpoint."""
    return list_trials([task], recipe.seeds, recipe.episodes)
