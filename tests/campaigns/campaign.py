"""What every campaign has in common: its options, its table, what it keeps of findings, and when it stops."""

import re
import shutil
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import click
from rich.console import Console
from rich.table import Table


def options(count: int) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """The options of a campaign."""

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        for option in (
            click.option("--seed", default=0, show_default=True, help="Of the first trial; the next have the next."),
            click.option("--count", default=count, show_default=True, help="Trials."),
            click.option("--budget", type=float, default=float("inf"), help="Stop after so many seconds."),
            click.option("--only", multiple=True, help="Only these scenes, kinds or cases; may be repeated."),
            click.option("--keep", type=click.Path(path_type=Path), default=Path("campaigns"), show_default=True,
                         help="Where findings are kept."),
        ):  # fmt: skip
            function = option(function)
        return click.command()(function)

    return decorate


class Campaign:
    """Counts outcomes, and keeps what went wrong.

    Args:
        name: Of the campaign.
        outcomes: Columns of its table.
        good: Those that are no findings.
        keep: Folder for what is kept of findings.
    """

    def __init__(self, name: str, outcomes: Sequence[str], good: Sequence[str], keep: Path) -> None:
        self.name, self._outcomes, self._good, self._keep = name, tuple(outcomes), set(good), keep.absolute()
        self._counts: dict[str, Counter[str]] = {}
        self._kept: Counter[str] = Counter()
        self.findings: list[str] = []
        self._start = time.monotonic()
        self.folder = Path(tempfile.mkdtemp(prefix=f"flowlab-{name}-"))

    def trials(self, seed: int, count: int, budget: float) -> Iterator[int]:
        """Seeds, until there were enough or time is up."""
        for k in range(count):
            if time.monotonic() - self._start > budget:
                return
            yield seed + k

    def add(self, row: str, outcome: str, about: str = "", folder: Path | None = None) -> None:
        """Count an outcome; of a finding, the first few folders of each row are kept."""
        self._counts.setdefault(row, Counter())[outcome] += 1
        if outcome in self._good:
            return
        self.findings.append(f"{row}: {outcome}: {about}")
        click.echo(self.findings[-1], err=True)
        if folder is not None and self._kept[row] < 3:
            self._kept[row] += 1
            name = re.sub(r"[^\w.-]+", "-", row)
            target = self._keep / self.name / f"{name}-{len(self.findings)}"
            shutil.rmtree(target, ignore_errors=True)
            shutil.copytree(folder, target, symlinks=True, ignore_dangling_symlinks=True)
            (target.parent / f"{target.name}.txt").write_text(about + "\n")

    def finish(self, *columns: str) -> None:
        """Print the table; exit 1 if there was any finding."""
        table = Table(title=f"{self.name}: {' '.join(sys.argv[1:])}", title_justify="left")
        shown = [o for o in self._outcomes if o in self._good or any(c[o] for c in self._counts.values())]
        shown = list(columns) or shown
        for name in ("", "trials", *shown):
            table.add_column(name, justify="left" if not name else "right")
        for row, counts in [*self._counts.items(), ("all", sum(self._counts.values(), Counter()))]:
            table.add_row(row, str(sum(counts.values())), *(str(counts[o]) for o in shown))
        Console().print(table)
        click.echo(f"{len(self.findings)} findings, {time.monotonic() - self._start:.0f} s")
        shutil.rmtree(self.folder, ignore_errors=True)
        sys.exit(bool(self.findings))
