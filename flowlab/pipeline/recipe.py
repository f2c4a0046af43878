"""Recipes: YAML files that say which stages make a dataset, and with which settings."""

import json
from collections import Counter
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from pydantic import Field, PrivateAttr, SerializeAsAny, ValidationError, ValidationInfo, field_validator

from flowlab.config import Settings, explain, override, read_named, set_value
from flowlab.errors import UsageError
from flowlab.pipeline.stage import Pipeline, Stage
from flowlab.registry import STAGES, names_from_file
from flowlab.text import shown
from flowlab.untrusted import parse_yaml

_EXAMPLE = "observer.points=512"


class Recipe(Settings):
    """A pipeline, its tasks, and how many episodes of each."""

    name: str
    """What the recipe is called in datasets made by it."""
    description: str = ""
    """What it makes, in a sentence."""
    tasks: tuple[str, ...] = ()
    """Tasks or groups of tasks, where the command line names none."""
    episodes: int = Field(default=10, gt=0)
    """Accepted episodes per task."""
    first_seed: int = Field(default=0, ge=0)
    """Seeds are tried in order from here."""
    stages: tuple[SerializeAsAny[Stage], ...]
    _folder: Path | None = PrivateAttr(None)

    @property
    def folder(self) -> Path | None:
        """Where the modules of its own stages may lie: the folder of its file; None for one that comes with flowlab."""
        return self._folder

    @field_validator("stages", mode="before")
    @classmethod
    def _find_stages(cls, values: Any, info: ValidationInfo) -> list[Any]:
        if not isinstance(values, list | tuple):
            raise ValueError("must be a list of stages")
        stages = [v if isinstance(v, Stage) else _make_stage(v, info.context) for v in values]
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


def load_recipe(name: "str | Recipe", overrides: Iterable[str] = ()) -> Recipe:
    """A recipe by file, by the name of one that comes with flowlab, or one that is there already.

    Args:
        name: Path of a YAML file, ``metaworld``, or a recipe. The stages that a file names by import path may lie
            beside it.
        overrides: Changes of single settings, ``key.path=value``.

    Raises:
        UsageError: There is no such recipe, or something in it, or in an override, does not fit.
    """
    if isinstance(name, Recipe):
        return parse_recipe(name.model_dump_json(), name.name, overrides, name.folder)
    path, overrides = Path(name), [*overrides]
    text = read_named("recipe", name)
    if not path.suffix:
        return parse_recipe(text, name, overrides)
    with names_from_file(but=[change.partition("=")[2] for change in overrides]):
        return parse_recipe(text, name, overrides, path.parent)


def parse_recipe(text: str, origin: str, overrides: Iterable[str] = (), folder: Path | None = None) -> Recipe:
    """A recipe from YAML.

    Args:
        text: The YAML.
        origin: What errors call it.
        overrides: Changes of single settings, ``key.path=value``.
        folder: Where the modules of its own stages may lie, see :meth:`flowlab.registry.Registry.load`.

    Raises:
        UsageError: Something in the recipe or in an override does not fit.
    """
    try:
        values = parse_yaml(text)
    except ValueError as error:
        raise UsageError(f"{origin}: not valid YAML: {error}") from error
    if not isinstance(values, dict):
        raise UsageError(f"{origin}: a recipe is a mapping with the keys {', '.join(Recipe.model_fields)}")
    for change in overrides:
        _override(values, change, folder)
    try:
        recipe = Recipe.model_validate(values, context=folder)
    except ValidationError as error:
        raise UsageError(f"{origin}: {explain(error, Recipe)}") from error
    except UsageError as error:
        raise UsageError(f"{origin}: {error}") from error
    recipe.pipeline()
    recipe._folder = folder
    return recipe


def _make_stage(values: Any, folder: Path | None) -> Stage:
    if not isinstance(values, Mapping) or not isinstance(values.get("stage"), str):
        raise UsageError(f"every stage needs a name, as in 'stage: observer'; found {shown(values)}")
    name = values["stage"]
    cls = STAGES.load(name, folder)
    try:
        return cls.model_validate(dict(values))
    except ValidationError as error:
        raise UsageError(f"stage '{name}': {explain(error, cls)}") from error


def _override(values: dict[str, Any], text: str, folder: Path | None) -> None:
    """Apply ``observer.points=512``: what comes first is a stage's name or a key of the recipe."""
    key = text.partition("=")[0]
    stages = {s["stage"]: s for s in values.get("stages") or () if isinstance(s, dict) and "stage" in s}
    meant = [name for name in stages if f"{key}.".startswith(f"{name}.")]
    if not meant:
        known = [*stages, *(k for k in Recipe.model_fields if k != "stages")]
        override(values, text, known, _EXAMPLE, kind="stage or key of this recipe")
        return
    stage = max(meant, key=len)  # a stage named by import path has dots of its own
    if key == stage:
        raise UsageError(f"--set {text}: '{stage}' is a stage; name one of its settings")
    if "=" not in text or not all(key.removeprefix(f"{stage}.").split(".")):
        raise UsageError(f"--set {text}: must look like {_EXAMPLE}")
    _state_defaults(stages[stage], folder)
    set_value(stages[stage], key.removeprefix(f"{stage}.").split("."), text)


def _state_defaults(stage: dict[str, Any], folder: Path | None) -> None:
    """Give a stage of a recipe the settings it leaves out, so that a part of a group of them can be changed."""
    with suppress(ValidationError, UsageError):  # what is wrong is told when all changes are made
        stage |= _make_stage(stage, folder).model_dump(mode="json")
