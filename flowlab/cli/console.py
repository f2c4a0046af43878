"""What the commands print: text from files is never markup, nor an escape of the terminal, nor a further line."""

import json
import math
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Self

import click
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from flowlab.cli.heartbeat import PULSE, be_quiet, is_quiet
from flowlab.text import counted, one_line

if TYPE_CHECKING:
    from flowlab.pipeline.scheduling import ExtractionProgress
    from flowlab.report.tables import Table as ReportTable
    from flowlab.training.trainer import TrainingProgress

_PLAIN: Any = {"markup": False, "emoji": False, "highlight": False}
_console = Console(stderr=True, **_PLAIN)
_SECONDS_BETWEEN_LINES = 10.0


def echo(*lines: str) -> None:
    """Results: lines on standard output."""
    for line in lines:
        click.echo(one_line(line))


def say(line: str) -> None:
    """For people: a line of progress, on standard error; nothing where quiet was asked for."""
    if not is_quiet():
        warn(line)


def warn(line: str) -> None:
    """For people: what is to be known of a result, on standard error, even where quiet was asked for."""
    PULSE.said(line)
    show(line)


def show(line: str) -> None:
    """A line on standard error."""
    _console.print(one_line(line), soft_wrap=True)


def json_option(command: Any) -> Any:
    """``--json``: what the command has to say is one JSON document on standard output. On an error there is none."""
    return click.option(
        "--json", "as_json", is_flag=True, callback=_quiet_too, help="Print the result as JSON, and no progress."
    )(command)


def quiet_option(command: Any) -> Any:
    """``--quiet``: results and warnings, but nothing of how far the command is."""
    return click.option(
        "-q", "--quiet", is_flag=True, expose_value=False, callback=_quiet_too, help="Say nothing of progress."
    )(command)


def _quiet_too(context: click.Context, option: click.Parameter, given: bool) -> bool:
    if given:
        be_quiet(context)
    return given


def print_table(columns: Sequence[str], rows: Sequence[Sequence[object]], title: str | None = None) -> None:
    """A table on standard output; numbers align right."""
    table = Table(title=title and one_line(title), title_justify="left")
    for k, name in enumerate(columns):
        numeric = all(isinstance(row[k], int | float) for row in rows)
        table.add_column(one_line(name), justify="right" if numeric else "left")
    for row in rows:
        table.add_row(
            *(
                f"{v:,.4g}" if isinstance(v, float) else f"{v:,}" if isinstance(v, int) else one_line(str(v))
                for v in row
            )
        )
    Console(**_PLAIN).print(table)


def print_tables(tables: Sequence["ReportTable"]) -> None:
    """Several of them, each with its title."""
    for table in tables:
        print_table(table.columns, table.rows, table.title)


def print_json(values: Any) -> None:
    """One JSON document on standard output; what is no finite number is null, as JSON has none."""
    click.echo(json.dumps(_finite(values), indent=1, allow_nan=False))


def _finite(values: Any) -> Any:
    """Nested values, null in place of numbers that are not finite."""
    if isinstance(values, dict):
        return {name: _finite(value) for name, value in values.items()}
    if isinstance(values, list | tuple):
        return [_finite(value) for value in values]
    return None if isinstance(values, float) and not math.isfinite(values) else values


EPISODES_LINE = "{what}: {done} of {episodes}, {spent:.0f} s{left}"
STEPS_LINE = "step {done} of {total}: {note}{left}"
"""What a line of progress says, elsewhere than on a terminal."""


class ProgressBar:
    """What is done and time left: a bar on a terminal, a plain line now and then elsewhere."""

    def __init__(self, line: str = EPISODES_LINE) -> None:
        self._quiet, self._line = is_quiet(), line
        self._bar = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            TextColumn("{task.fields[note]}", markup=False),
            console=_console,
            speed_estimate_period=300,
            disable=self._quiet or not _console.is_terminal,
        )
        self._task = self._bar.add_task("starting", total=None, note="")
        self._start = self._last_line = time.monotonic()
        self._done_at_start: int | None = None
        self._shown = 0, 0

    def __enter__(self) -> Self:
        self._bar.start()
        PULSE.bars += not self._bar.disable
        return self

    def __exit__(self, *failure: object) -> None:
        self._bar.stop()
        PULSE.bars -= not self._bar.disable

    def update(self, done: int, total: int, what: str, note: str = "") -> None:
        """Show that ``done`` of ``total`` are there, and what else there is to say of them.

        Where fewer are there than before, or another number is wanted, other work has begun: its time is counted anew.
        """
        what, note = one_line(what), one_line(note)
        now = time.monotonic()
        if self._done_at_start is None:
            self._done_at_start = done
        elif done < self._shown[0] or total != self._shown[1]:
            self._done_at_start, self._start = done, now
            self._bar.reset(self._task)
        self._shown = done, total
        self._bar.update(self._task, completed=done, total=total, description=what, note=note)
        due = now - self._last_line > _SECONDS_BETWEEN_LINES or done == total
        if not self._quiet and not _console.is_terminal and due:
            fresh, spent = done - self._done_at_start, now - self._start
            left = f", {spent / fresh * (total - done):.0f} s left" if fresh else ""
            of = {"done": done, "total": total, "episodes": counted(total, "episode")}
            say(self._line.format(what=what, spent=spent, left=left, note=note, **of))
            self._last_line = now


def show_training(bar: ProgressBar, progress: "TrainingProgress") -> None:
    """Show how far a training run is."""
    note = f"{progress.samples_per_s:,.0f} windows/s, loss {progress.loss:.4f}"
    if progress.validation:
        note += f", held out: action {progress.validation['action_l1']:.4f}"
    bar.update(progress.step, progress.steps, "training", note)


def show_extraction(bar: ProgressBar, progress: "ExtractionProgress", doing: str, count_rejects: bool = False) -> None:
    """Show how far a dataset is; of recordings, what was rejected is done, too."""
    done = progress.accepted + (progress.rejected if count_rejects else 0)
    bar.update(done, progress.wanted, f"{doing} ({progress.rejected} rejected)" if progress.rejected else doing)
