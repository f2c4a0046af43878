"""What the commands print."""

import json
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Self

import click
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

if TYPE_CHECKING:
    from flowlab.pipeline.scheduling import ExtractionProgress
    from flowlab.training.trainer import TrainingProgress

console = Console(stderr=True)
"""For people: progress and logs. Results go to standard output."""
_SECONDS_BETWEEN_LINES = 10.0


def print_table(columns: Sequence[str], rows: Sequence[Sequence[object]], title: str | None = None) -> None:
    """A table on standard output; numbers align right."""
    table = Table(title=title, title_justify="left")
    for k, name in enumerate(columns):
        numeric = all(isinstance(row[k], int | float) for row in rows)
        table.add_column(name, justify="right" if numeric else "left")
    for row in rows:
        table.add_row(
            *(f"{v:,.4g}" if isinstance(v, float) else f"{v:,}" if isinstance(v, int) else str(v) for v in row)
        )
    Console().print(table)


def print_json(values: Any) -> None:
    """One JSON document on standard output."""
    click.echo(json.dumps(values, indent=1))


class ProgressBar:
    """Episodes done and time left: a bar on a terminal, a plain line now and then elsewhere."""

    def __init__(self, quiet: bool) -> None:
        self._quiet = quiet
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            console=console,
            disable=quiet or not console.is_terminal,
        )
        self._task = self._bar.add_task("starting", total=None)
        self._start = self._last_line = time.monotonic()
        self._done_at_start: int | None = None

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(self, *failure: object) -> None:
        self._bar.stop()

    def update(self, done: int, total: int, note: str) -> None:
        """Show that ``done`` of ``total`` episodes are there."""
        self._bar.update(self._task, completed=done, total=total, description=note)
        now = time.monotonic()
        if self._done_at_start is None:
            self._done_at_start = done
        due = now - self._last_line > _SECONDS_BETWEEN_LINES or done == total
        if not self._quiet and not console.is_terminal and due:
            fresh = done - self._done_at_start
            left = f", {(now - self._start) / fresh * (total - done):.0f} s left" if fresh else ""
            console.print(f"{note}: {done} of {total} episodes, {now - self._start:.0f} s{left}", highlight=False)
            self._last_line = now


class ExtractionBar(ProgressBar):
    """How far a dataset is. ``count_rejects`` says that what was rejected is done, too, as recordings are."""

    def __init__(self, doing: str, quiet: bool, count_rejects: bool = False) -> None:
        super().__init__(quiet)
        self._doing, self._count_rejects = doing, count_rejects

    def show(self, progress: "ExtractionProgress") -> None:
        """Show how far the run is."""
        note = f"{self._doing} ({progress.rejected} rejected)" if progress.rejected else self._doing
        done = progress.accepted + (progress.rejected if self._count_rejects else 0)
        self.update(done, progress.wanted, note)


class TrainingBar:
    """Steps done, speed and time left of a training run: a bar on a terminal, a plain line now and then elsewhere."""

    def __init__(self, quiet: bool) -> None:
        self._quiet = quiet
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            TextColumn("{task.fields[note]}"),
            console=console,
            speed_estimate_period=300,
            disable=quiet or not console.is_terminal,
        )
        self._task = self._bar.add_task("training", total=None, note="")
        self._start = self._last_line = time.monotonic()
        self._first_step: int | None = None

    def __enter__(self) -> "TrainingBar":
        self._bar.start()
        return self

    def __exit__(self, *failure: object) -> None:
        self._bar.stop()

    def update(self, progress: "TrainingProgress") -> None:
        """Show how far a run is."""
        note = f"{progress.samples_per_s:,.0f} windows/s, loss {progress.loss:.4f}"
        if progress.validation:
            note += f", held out: action {progress.validation['action_l1']:.4f}"
        self._bar.update(self._task, completed=progress.step, total=progress.steps, note=note)
        now = time.monotonic()
        if self._first_step is None:
            self._first_step = progress.step
        if self._quiet or console.is_terminal:
            return
        if now - self._last_line > _SECONDS_BETWEEN_LINES or progress.step == progress.steps:
            left = (now - self._start) / max(progress.step - self._first_step, 1) * (progress.steps - progress.step)
            known = f", {left:.0f} s left" if progress.step > self._first_step else ""
            console.print(f"step {progress.step} of {progress.steps}: {note}{known}", highlight=False)
            self._last_line = now
