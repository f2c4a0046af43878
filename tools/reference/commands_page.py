"""The page of every command: what ``--help`` says of it."""

import inspect
import textwrap
from collections.abc import Iterator

import click
from as_markdown import as_code, one_line

from flowlab.cli import cli

_INTRO = """\
# Every command

What `flowlab COMMAND --help` says, on one page. It is made by `make reference`. What a command is called in
Python, lists, exit codes and the rest that all commands have in common are in the
[reference](reference.md#from-the-command-line), keys of `--set` in [every setting](settings.md).
"""


def commands_page() -> str:
    """The page, as Markdown."""
    context = click.Context(cli, info_name="flowlab")
    parts = [part for name in cli.list_commands(context) for part in _command(name, context)]
    return "\n".join([_INTRO, *parts])


def _command(name: str, parent: click.Context) -> Iterator[str]:
    """A command, and those below it."""
    command = parent.command.get_command(parent, name)  # type: ignore[attr-defined]
    context = click.Context(command, info_name=name, parent=parent)
    yield f"## {context.command_path}\n"
    yield f"```text\n{context.command_path} {' '.join(command.collect_usage_pieces(context))}\n```\n"
    yield from _paragraphs(inspect.cleandoc(command.help or ""))
    records = [p.get_help_record(context) for p in command.params if isinstance(p, click.Option)]
    if rows := [f"| {as_code(r[0])} | {one_line(r[1])} |" for r in records if r]:
        yield "\n".join(["| option | |", "|---|---|", *rows, ""])
    if isinstance(command, click.Group):
        for below in command.list_commands(context):
            yield from _command(below, context)


def _paragraphs(text: str) -> Iterator[str]:
    """The words of a command; what click is told not to wrap is shown as what to type."""
    for paragraph in text.split("\n\n"):
        if paragraph.startswith("\b\n"):
            yield f"```bash\n{textwrap.dedent(paragraph[2:])}\n```\n"
        else:
            yield f"{one_line(paragraph)}\n"
