"""Values as they are typed, the same in all commands: lists with commas, ranges, names of plug-ins."""

import re
from collections.abc import Callable, Iterable
from typing import Any

import click
from click.shell_completion import CompletionItem

from flowlab.arguments import parse_numbers
from flowlab.errors import UsageError
from flowlab.registry import ENGINES, Registry

_COMMA = re.compile(r"(?<!\\),")
_Known = Callable[[], Iterable[str]]


class Names(click.ParamType):  # type: ignore[type-arg]
    r"""Names parted by commas; a comma that is part of a name has a backslash before it."""

    name = "names"

    def __init__(self, known: _Known = tuple) -> None:
        self._known = known

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[str, ...]:
        """The names. Refuses text that has none."""
        found = tuple(n.replace("\\,", ",").strip() for n in _COMMA.split(value) if n.strip())
        if not found:
            self.fail(f"'{value}' names nothing; write names with commas between them, as in one,two", param, ctx)
        return found

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        """What the last name of the list can become."""
        return _completions(self._known(), incomplete)


class PluginName(click.ParamType):  # type: ignore[type-arg]
    """The name of something that is installed, or its import path; what it is, is looked for where it is used."""

    name = "name"

    def __init__(self, registry: Registry[Any]) -> None:
        self.registry = registry

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        """The names that are installed."""
        return [CompletionItem(n) for n in self.registry.plugins() if n.startswith(incomplete)]


class Numbers(click.ParamType):  # type: ignore[type-arg]
    """Whole numbers parted by commas, and ranges of them, whose end is not in it: 0,1,2 or 0:3."""

    name = "numbers"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, ...]:
        """The numbers, in the order given."""
        if not isinstance(value, str):
            return tuple(value)
        try:
            return tuple(parse_numbers(value, value))
        except UsageError as error:
            self.fail(str(error), param, ctx)


class StepsOrAuto(click.IntRange):
    """A number of steps from 1 on, or ``auto``."""

    name = "steps or auto"

    def __init__(self) -> None:
        super().__init__(min=1)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The number, or the word."""
        if value == "auto":
            return value
        try:
            return super().convert(value, param, ctx)
        except click.BadParameter:
            self.fail(f"found '{value}', expected a number of steps from 1 on, or auto", param, ctx)


def flat(ctx: click.Context, param: click.Parameter, values: Iterable[Iterable[Any]]) -> tuple[Any, ...]:
    """The lists of an option that was given several times as one list, each value once."""
    return tuple(dict.fromkeys(value for part in values for value in part))


def names_option(*declarations: str, known: _Known = tuple, **more: Any) -> Any:
    """An option with a list of names, which may be repeated."""
    settings: dict[str, Any] = {"type": Names(known), "multiple": True, "callback": flat, "metavar": "NAME,..."} | more
    return click.option(*declarations, **settings)


def names_argument(name: str, known: _Known = tuple, **more: Any) -> Any:
    """Arguments that are names, or lists of names with commas."""
    return click.argument(name, nargs=-1, type=Names(known), callback=flat, **more)


def numbers_option(*declarations: str, **more: Any) -> Any:
    """An option with a list of numbers, which may be repeated."""
    settings: dict[str, Any] = {"type": Numbers(), "multiple": True, "callback": flat, "metavar": "N,A:B,..."} | more
    return click.option(*declarations, **settings)


def engine_option(command: Any) -> Any:
    """``--engine``: where work units are done."""
    about = "Where it is done; 'flowlab plugins' lists engines."
    return click.option("--engine", type=PluginName(ENGINES), default="local", show_default=True, help=about)(command)


def tasks_and_groups() -> list[str]:
    """What a list of simulated tasks can name."""
    from flowlab.sim.tasks import GROUPS, TASKS

    return [*TASKS, *GROUPS]


def groups() -> list[str]:
    """The groups of simulated tasks."""
    from flowlab.sim.tasks import GROUPS

    return list(GROUPS)


def installed(registry: Registry[Any]) -> _Known:
    """The names in a registry, found when they are asked for."""
    return lambda: registry.plugins()


def _completions(known: Iterable[str], incomplete: str) -> list[CompletionItem]:
    before, comma, last = incomplete.rpartition(",")
    typed = {n.strip() for n in before.split(",")}
    return [CompletionItem(f"{before}{comma}{n}") for n in known if n.startswith(last) and n not in typed]
