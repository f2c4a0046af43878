"""Recipes: YAML files that say which stages make a dataset, and with which settings."""

import importlib
import json
from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any

import yaml
from pydantic import Field, SerializeAsAny, ValidationError, field_validator

from flowlab.config import Settings, explain, read_named, set_value
from flowlab.errors import UsageError, unknown_name
from flowlab.pipeline.stage import Pipeline, Stage

_STAGES = {
    "expert": "flowlab.pipeline.stages.simulation:ExpertStage",
    "recording": "flowlab.pipeline.stages.recording:RecordingStage",
    "observer": "flowlab.pipeline.stages.shared:ObserverStage",
    "queries": "flowlab.pipeline.stages.shared:QueriesStage",
    "rigid-flow": "flowlab.pipeline.stages.simulation:RigidFlowStage",
    "track": "flowlab.pipeline.stages.recording:TrackStage",
    "lift": "flowlab.pipeline.stages.recording:LiftStage",
    "quality": "flowlab.pipeline.stages.recording:QualityStage",
    "accept": "flowlab.pipeline.stages.shared:AcceptStage",
    "write": "flowlab.pipeline.stages.shared:WriteStage",
}
"""Imported only when a recipe names them: simulation needs no trackers, and recordings no simulator."""


class Recipe(Settings):
    """A pipeline, its tasks, and how many episodes of each."""

    name: str
    description: str = ""
    tasks: tuple[str, ...] = ()
    """Tasks or groups of tasks, where the command line names none."""
    episodes: int = Field(default=10, gt=0)
    """Accepted episodes per task."""
    first_seed: int = Field(default=0, ge=0)
    """Seeds are tried in order from here."""
    stages: tuple[SerializeAsAny[Stage], ...]

    @field_validator("stages", mode="before")
    @classmethod
    def _find_stages(cls, values: Any) -> list[Any]:
        if not isinstance(values, list | tuple):
            raise ValueError("must be a list of stages")
        stages = [v if isinstance(v, Stage) else _make_stage(v) for v in values]
        for name, times in Counter(s.stage for s in stages).items():
            if times > 1:
                raise UsageError(f"stage '{name}' appears {times} times; settings are kept by name, so once is all")
        return stages

    def pipeline(self) -> Pipeline:
        """The stages, joined and checked."""
        return Pipeline(self.stages)

    def settings(self) -> dict[str, Any]:
        """Every setting of every stage, by stage name, as JSON values."""
        values: dict[str, Any] = json.loads(self.model_dump_json())
        return {s["stage"]: {k: v for k, v in s.items() if k != "stage"} for s in values["stages"]}


def load_recipe(name: str, overrides: Iterable[str] = ()) -> Recipe:
    """A recipe by file or by the name of one that comes with flowlab, with ``key.path=value`` overrides."""
    text = read_named("recipe", name)
    return parse_recipe(text, name, overrides)


def parse_recipe(text: str, origin: str, overrides: Iterable[str] = ()) -> Recipe:
    """A recipe from YAML; ``origin`` is what errors call it."""
    try:
        values = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise UsageError(f"{origin}: not valid YAML: {error}") from error
    if not isinstance(values, dict):
        raise UsageError(f"{origin}: a recipe is a mapping with the keys {', '.join(Recipe.model_fields)}")
    for override in overrides:
        _override(values, override)
    try:
        recipe = Recipe.model_validate(values)
    except ValidationError as error:
        raise UsageError(f"{origin}: {explain(error, Recipe)}") from error
    except UsageError as error:
        raise UsageError(f"{origin}: {error}") from error
    recipe.pipeline()
    return recipe


def _make_stage(values: Any) -> Stage:
    if not isinstance(values, Mapping) or not isinstance(values.get("stage"), str):
        raise UsageError(f"every stage needs a name, as in 'stage: observer'; found {values!r}")
    name = values["stage"]
    if ":" not in name and name not in _STAGES:
        raise unknown_name("stage", name, _STAGES)
    cls = _own_stage(name) if ":" in name else _load(_STAGES[name])
    try:
        return cls.model_validate(dict(values))
    except ValidationError as error:
        raise UsageError(f"stage '{name}': {explain(error, cls)}") from error


def _own_stage(name: str) -> type[Stage]:
    try:
        cls = _load(name)
    except Exception as error:  # whatever somebody's module does
        raise UsageError(f"stage '{name}': cannot be imported ({error})") from error
    if not (isinstance(cls, type) and issubclass(cls, Stage)):
        raise UsageError(f"stage '{name}': is not a subclass of flowlab.pipeline.stage.Stage")
    return cls


def _load(place: str) -> type[Stage]:
    module, _, attribute = place.partition(":")
    cls: type[Stage] = getattr(importlib.import_module(module), attribute)
    return cls


def _override(values: dict[str, Any], text: str) -> None:
    """Apply ``observer.points=512``: the first part is a stage's name or a key of the recipe."""
    key, equals, _ = text.partition("=")
    stages = {s["stage"]: s for s in values.get("stages") or () if isinstance(s, dict) and "stage" in s}
    # A stage named by import path has dots of its own.
    whole = next((name for name in stages if key.startswith(f"{name}.")), None)
    first, *rest = key.split(".") if whole is None else [whole, *key.removeprefix(f"{whole}.").split(".")]
    if not equals or not all([first, *rest]):
        raise UsageError(f"--set {text}: must look like observer.points=512")
    known = [*stages, *(k for k in Recipe.model_fields if k != "stages")]
    if first not in known:
        raise unknown_name("stage or key of this recipe", first, known)
    if first in stages and not rest:
        raise UsageError(f"--set {text}: '{first}' is a stage; name one of its settings")
    target, path = (stages[first], rest) if first in stages else (values, [first, *rest])
    set_value(target, path, text)
