"""The page of every setting: of stages, trackers, policies, and of the files that people write."""

import inspect
from collections.abc import Iterable, Iterator

import yaml
from as_markdown import one_line
from field_docs import Setting, settings_of
from pydantic import BaseModel

from flowlab.actions.film_labeler import LabelActionsSettings
from flowlab.benchmark.recipe import ExperimentRecipe, PolicyVariant
from flowlab.config import read_named
from flowlab.data.training_settings import TrainSettings
from flowlab.pipeline.recipe import Recipe
from flowlab.policies.diffusion_policy import DiffusionPolicySettings
from flowlab.recordings.recording_yaml import Metadata
from flowlab.registry import EXPORTERS, POLICIES, STAGES, TRACKERS

RECIPES = {"metaworld": "extract-sim", "metaworld-dp3": "extract-sim", "real": "track-real"}
"""The recipes that come with flowlab, and the command that takes them."""

_INTRO = """\
# Every setting

Each with its type, its default and its meaning, as the code has them; the page is made by `make reference`. A setting
is changed by `--set KEY=VALUE`, once for each, where KEY is what the table shows, and VALUE is YAML:
`--set observer.points=512`, `--set 'encoder.widths=[64, 128]'`. In files of your own ([recipes](stages.md),
[profiles](training.md)) the same names are keys. What is unknown or does not fit is refused, never ignored.
"""
_BEGIN, _END = '<div class="settings" markdown>\n', "</div>\n"
"""Around the tables, which docs/style.css stacks on phones."""


def settings_page() -> str:
    """The page, as Markdown."""
    sections = [*_stages(), *_trackers(), *_training(), *_others()]
    return "\n".join([_INTRO, _BEGIN, *sections, _END])


def _stages() -> Iterator[str]:
    yield "## Making datasets\n\n`flowlab extract-sim` and `flowlab track-real`, by stage of the recipe.\n"
    recipes = {name: yaml.safe_load(read_named("recipe", name)) for name in RECIPES}
    for name in STAGES.plugins():
        users = {recipe: stage for recipe, r in recipes.items() for stage in r["stages"] if stage["stage"] == name}
        said = f"In {', '.join(f'`{u}`' for u in users) or 'recipes of your own'}."
        own = {u: {k: v for k, v in stage.items() if k != "stage"} for u, stage in users.items()}
        there = "; ".join(f"in `{u}` `{_inline(v)}`" for u, v in own.items() if v)
        yield _section(f"{name}.", STAGES.load(name), f"{said} Set otherwise: {there}." if there else said)


def _inline(values: object) -> str:
    """YAML on one line."""
    return yaml.safe_dump(values, default_flow_style=True, sort_keys=False, width=1000).strip()


def _trackers() -> Iterator[str]:
    yield "## Trackers\n\n`flowlab track-real --set track.options.KEY=VALUE`, `flowlab grade --set KEY=VALUE`.\n"
    for name in TRACKERS.plugins():
        yield _section("track.options.", TRACKERS.load(name), title=name)


def _training() -> Iterator[str]:
    yield "## Training\n\n`flowlab train --set KEY=VALUE`.\n"
    yield _section("", TrainSettings, title="Of every policy", without={"policy"})
    yield _section("", DiffusionPolicySettings, title="Of fdp, dp3 and mba", without=set(TrainSettings.model_fields))
    for name in POLICIES.plugins():
        cls = POLICIES.load(name).settings_class
        if own := set(cls.model_fields) - set(DiffusionPolicySettings.model_fields):
            yield _section("", cls, title=name, without=set(cls.model_fields) - own)


def _others() -> Iterator[str]:
    yield "## Actions of films\n\n`flowlab label-actions --set KEY=VALUE`.\n"
    yield _section("", LabelActionsSettings)
    yield "## Exporters\n\n`flowlab export --to NAME --set KEY=VALUE`.\n"
    for name in EXPORTERS.plugins():
        yield _section("", EXPORTERS.load(name), title=name)
    yield "## Files that you write\n"
    yield _section("", Metadata, "See [recordings](recordings.md).", title="recording.yaml")
    yield _section(
        "", Recipe, "See [recipes and stages](stages.md).", title="A recipe of a dataset", without={"stages"}
    )
    yield _section("", ExperimentRecipe, "See [experiments](evaluating.md).", title="A recipe of an experiment")
    yield _section("", PolicyVariant, title="One of its variants")


def _section(
    prefix: str, cls: type[BaseModel], said: str = "", title: str = "", without: Iterable[str] = ("stage",)
) -> str:
    """A heading, what the class is for, and its table."""
    rows = [s for s in settings_of(cls) if s.path.split(".")[0] not in without]
    about = one_line(inspect.cleandoc(cls.__doc__ or "").split("\n\n")[0])
    heading = f"### {title or prefix.rstrip('.')}\n\n" if title or prefix else ""
    words = f"{about} {said}".strip()
    return f"{heading}{words}\n\n{_table(rows, prefix)}" if rows else f"{heading}{words} It has no settings.\n"


def _table(rows: Iterable[Setting], prefix: str) -> str:
    lines = [f"| `{prefix}{r.path}` | {r.kind} | {r.default} | {one_line(r.meaning)} |" for r in rows]
    return "\n".join(["| setting | type | default | meaning |", "|---|---|---|---|", *lines, ""])
