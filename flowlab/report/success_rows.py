"""Policies side by side in the page's table of success."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import fmean

from flowlab.benchmark.ordering import ALL
from flowlab.benchmark.statistics import Proportion, mean_limits
from flowlab.benchmark.success import GroupSuccess
from flowlab.benchmark.summary import Summary
from flowlab.text import counted


@dataclass(frozen=True, slots=True)
class SuccessCell:
    """A policy's success in a row of the page's table."""

    share: float
    """Of a group, the mean over its tasks."""
    low: float
    """95 % limits, as far as the episodes tell."""
    high: float
    note: str
    best: bool = False
    """Highest of the row, among those of the same tasks."""


@dataclass(frozen=True, slots=True)
class SuccessRow:
    """A task, or the group that the tasks above it belong to."""

    name: str
    sums_up: bool
    cells: tuple[SuccessCell | None, ...]
    """By policy."""
    expert: SuccessCell | None
    """MetaWorld's own; of a group where all the tasks of the row have it."""


def success_rows(summary: Summary) -> list[SuccessRow]:
    """Policies side by side: every task, after them their group where they are several, in the end all."""
    rows = []
    each = episodes_each(summary)
    for group in dict.fromkeys(g.group for g in summary.groups):
        of_group = {g.label: g for g in summary.groups if g.group == group}
        tasks = list(dict.fromkeys(x.task for x in summary.successes if x.group == group))
        for task in tasks:
            on_task = {x.label: x.success for x in summary.successes if x.task == task}
            cells = {x: _task_cell(s, each) for x, s in on_task.items()}
            rows.append(_row(summary, task, False, cells, set(cells), _expert_cell(summary, [task], each)))
        if len(tasks) > 1 or (group == ALL and len(summary.tasks) > 1):
            most = max((g.tasks for g in of_group.values()), key=len)
            cells = {x: _group_cell(g) for x, g in of_group.items()}
            comparable = {x for x, g in of_group.items() if g.tasks == most}
            rows.append(_row(summary, group, True, cells, comparable, _expert_cell(summary, most, each)))
    return rows


def _task_cell(success: Proportion, each: int | None) -> SuccessCell:
    """A share; ``each`` are the episodes that all others have, which need not be repeated."""
    return SuccessCell(success.share, success.low, success.high, "" if success.n == each else f"n {success.n}")


def _group_cell(group: GroupSuccess) -> SuccessCell:
    """The mean of a group's tasks."""
    return SuccessCell(
        group.task_mean, group.mean_low, group.mean_high, f"{len(group.tasks)} of {counted(group.of, 'task')}"
    )


def _expert_cell(summary: Summary, tasks: Sequence[str], each: int | None) -> SuccessCell | None:
    """The expert of a task, or the mean over several that all have theirs."""
    found = [e.success for e in summary.experts if e.task in tasks]
    if len(found) != len(tasks):
        return None
    if len(found) == 1:
        return _task_cell(found[0], each)
    low, high = mean_limits(found)
    return SuccessCell(fmean(s.share for s in found), low, high, f"{counted(len(found), 'task')}")


def episodes_each(summary: Summary) -> int | None:
    """Episodes of each task and policy, if they are as many everywhere."""
    counts = {x.success.n for x in summary.successes}
    return counts.pop() if len(counts) == 1 else None


def _row(
    summary: Summary,
    name: str,
    sums_up: bool,
    cells: Mapping[str, SuccessCell],
    comparable: set[str],
    expert: SuccessCell | None,
) -> SuccessRow:
    """A row in which the best of the comparable ones is marked, if they are not all the same."""
    found = {cells[label].share for label in comparable}
    top = max(found) if len(found) > 1 else None
    marked = {x: replace(c, best=x in comparable and c.share == top) for x, c in cells.items()}
    return SuccessRow(name, sums_up, tuple(marked.get(label) for label in summary.labels), expert)
