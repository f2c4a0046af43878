"""Policies side by side in the page's table of success."""

from collections.abc import Mapping
from dataclasses import dataclass

from flowlab.benchmark.ordering import ALL
from flowlab.benchmark.statistics import Proportion
from flowlab.benchmark.summary import Summary


@dataclass(frozen=True, slots=True)
class SuccessCell:
    """A policy's success in a row of the page's table."""

    share: float
    """Of a group, the mean over its tasks."""
    episodes: Proportion
    note: str
    best: bool
    """Highest of the row, among those of the same tasks."""


@dataclass(frozen=True, slots=True)
class SuccessRow:
    """A task, or the group that the tasks above it belong to."""

    name: str
    sums_up: bool
    cells: tuple[SuccessCell | None, ...]
    """By policy."""


def success_rows(summary: Summary) -> list[SuccessRow]:
    """Policies side by side: every task, after them their group where they are several, in the end all."""
    rows = []
    for group in dict.fromkeys(g.group for g in summary.groups):
        of_group = {g.label: g for g in summary.groups if g.group == group}
        tasks = list(dict.fromkeys(x.task for x in summary.successes if x.group == group))
        for task in tasks:
            on_task = {x.label: x.success for x in summary.successes if x.task == task}
            shares = {x: (s.share, s, "" if episodes_each(summary) else f"n {s.n}") for x, s in on_task.items()}
            rows.append(_row(summary, task, False, shares, set(shares)))
        if len(tasks) > 1 or (group == ALL and len(summary.tasks) > 1):
            most = max((g.tasks for g in of_group.values()), key=len)
            shares = {x: (g.task_mean, g.success, f"{len(g.tasks)} of {g.of} tasks") for x, g in of_group.items()}
            rows.append(_row(summary, group, True, shares, {x for x, g in of_group.items() if g.tasks == most}))
    return rows


def episodes_each(summary: Summary) -> int | None:
    """Episodes of each task and policy, if they are as many everywhere."""
    counts = {x.success.n for x in summary.successes}
    return counts.pop() if len(counts) == 1 else None


def _row(
    summary: Summary,
    name: str,
    sums_up: bool,
    shares: Mapping[str, tuple[float, Proportion, str]],
    comparable: set[str],
) -> SuccessRow:
    """A row in which the best of the comparable ones is marked, if they are not all the same."""
    found = {shares[label][0] for label in comparable}
    top = max(found) if len(found) > 1 else None
    cells = {
        x: SuccessCell(share, of, note, x in comparable and share == top) for x, (share, of, note) in shares.items()
    }
    return SuccessRow(name, sums_up, tuple(cells.get(label) for label in summary.labels))
