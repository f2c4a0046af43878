"""The order in which policies and tasks stand in tables, and the groups of tasks they are summed over."""

from collections import Counter
from collections.abc import Iterable, Sequence

from flowlab.benchmark.paper import MAIN
from flowlab.errors import DataError
from flowlab.evaluation.results import PolicyResult
from flowlab.sim.tasks import TASKS
from flowlab.text import natural_key

ALL = "all"
"""The group of all tasks."""
_PAPER_LABELS = [row.label for row in MAIN.rows if row.percent]


def result_order(result: PolicyResult) -> tuple[object, ...]:
    """What to sort results by: label, then task, then name."""
    return *label_order(result.label), [task_order(t) for t in result.tasks], result.name


def label_order(label: str) -> tuple[int, list[str | int]]:
    """What to sort labels by: the paper's in its order, each with its variants after it, 50 before 200; others last."""
    kind = label.partition("-")[0]
    place = _PAPER_LABELS.index(kind) if kind in _PAPER_LABELS else len(_PAPER_LABELS)
    return place, natural_key(label)


def task_order(task: str) -> tuple[int, str]:
    """What to sort tasks by: difficulty, then name."""
    return list(TASKS).index(task) if task in TASKS else len(TASKS), task


def sort_tasks(tasks: Iterable[str]) -> tuple[str, ...]:
    """By difficulty, then by name."""
    return tuple(sorted(tasks, key=task_order))


def group_of(task: str) -> str:
    """A task's difficulty."""
    return TASKS[task].difficulty if task in TASKS else "other"


def scopes_of(tasks: Sequence[str]) -> dict[str, list[str]]:
    """What numbers are given over: all tasks, those of each difficulty that has some, and each alone."""
    groups: dict[str, list[str]] = {}
    for task in tasks:
        groups.setdefault(group_of(task), []).append(task)
    return {ALL: list(tasks), **groups, **{t: [t] for t in tasks}}


def disambiguate(results: Sequence[PolicyResult]) -> list[PolicyResult]:
    """The results, each with a label of its own among those that tried the same tasks.

    Raises:
        DataError: Two results of one label and one task have the same name too.
    """
    met = Counter(key for r in results for key in _labeled_tasks(r))
    apart = [
        r.model_copy(update={"label": r.name}) if any(met[key] > 1 for key in _labeled_tasks(r)) else r for r in results
    ]
    for (label, task), count in Counter(key for r in apart for key in _labeled_tasks(r)).items():
        if count > 1:
            raise DataError(f"{count} results on {task} are all called {label}; rename all but one of them")
    return apart


def _labeled_tasks(result: PolicyResult) -> set[tuple[str, str]]:
    """Every task that a result has episodes of, with the result's label."""
    return {(result.label, o.task) for e in result.evaluations for o in e.outcomes}
