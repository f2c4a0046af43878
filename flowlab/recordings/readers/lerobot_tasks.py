"""What is done in an episode of a LeRobot dataset: as its entry says, or its steps by the numbers of tasks."""

from collections.abc import Iterator

import numpy as np

from flowlab.errors import DataError
from flowlab.recordings.readers.lerobot_episodes import LeRobotEpisode
from flowlab.recordings.readers.lerobot_process import ask
from flowlab.recordings.verdicts import Check, Verdict
from flowlab.text import cut

COLUMN = "task_index"


def rows_of(one: LeRobotEpisode) -> tuple[int, int]:
    """The first row of an episode in its table, and the one after its last.

    Raises:
        DataError: The table has none of them, other rows between them, or another number than the episode has steps.
    """
    index = ask(one.data, "columns", ["episode_index"]).get("episode_index")
    if index is None:
        if one.info.is_v3:
            raise DataError(f"{one.data}: has no column episode_index, so it does not say which rows are whose")
        index = np.full(ask(one.data, "count"), one.index)
    rows = np.flatnonzero(index.reshape(-1) == one.index)
    if len(rows) != one.length:
        raise DataError(
            f"{one.data}: has {len(rows):,} rows of {one.where.name}, and meta/ says it has {one.length:,} steps"
        )
    if rows[-1] - rows[0] + 1 != len(rows):
        raise DataError(f"{one.data}: has rows of other episodes between those of {one.where.name}")
    return int(rows[0]), int(rows[-1]) + 1


def tasks_of(one: LeRobotEpisode) -> tuple[str, ...]:
    """What is done in an episode, in words, in the order of its steps.

    Its entry in ``meta/`` says it; where that names nothing, the steps do, by the numbers of the dataset's tasks. None
    where neither does, unless the dataset has a single task.
    """
    return one.tasks or _by_steps(one) or one.only_task


def task_checks(one: LeRobotEpisode) -> Iterator[Check]:
    """What is said where an episode has several tasks, none that is named, or other ones by its steps."""
    tasks, by_steps = tasks_of(one), _by_steps(one)
    if len(tasks) > 1:
        says = f"has {len(tasks)}, of which the first is taken: {cut('; '.join(tasks))}"
        yield Check("task", Verdict.ASSUMED, says)
    elif one.tasks and by_steps and not set(by_steps) & set(one.tasks):
        says = f"meta/ says {cut(one.tasks[0])}, which is taken, and {COLUMN} of the steps {cut(by_steps[0])}"
        yield Check("task", Verdict.DOUBTFUL, says)
    elif nameless := [] if one.tasks else sorted(set(_numbers(one)) - set(one.task_words)):
        says = f"{COLUMN} of the steps is {nameless[0]}, which meta/tasks does not name"
        yield Check("task", Verdict.ASSUMED, says)


def _by_steps(one: LeRobotEpisode) -> tuple[str, ...]:
    """The words of the tasks that the steps number."""
    return tuple(dict.fromkeys(one.task_words[k] for k in _numbers(one) if k in one.task_words))


def _numbers(one: LeRobotEpisode) -> list[int]:
    """The distinct numbers of tasks of the steps, in their order; none where the table has no such column."""
    if not one.task_words or COLUMN not in ask(one.data, "names"):
        return []
    first, last = rows_of(one)
    values = ask(one.data, "columns", [COLUMN], first, last - first)[COLUMN]
    if values.dtype.kind not in "iu":
        raise DataError(f"{one.data}: {COLUMN} holds {values.dtype}, expected whole numbers")
    return list(dict.fromkeys(values.reshape(-1).tolist()))
