"""Which recordings a dataset holds: each has a number that never changes, where simulation has a seed."""

from collections.abc import Sequence
from pathlib import Path

from flowlab.config import PlainName, Settings
from flowlab.errors import DataError, UsageError
from flowlab.text import natural_key
from flowlab.untrusted import is_there


class Recorded(Settings):
    """One recording of a dataset."""

    task: PlainName
    name: PlainName
    """Of its folder or file; with the task, what it is known by."""
    seed: int = -1
    """Its number in the dataset; -1 until it has one."""
    source: str
    """Its path when it was last seen."""


def number_recordings(known: Sequence[Recorded], found: Sequence[Recorded]) -> tuple[Recorded, ...]:
    """The known recordings as they are numbered, then the new ones of ``found`` in natural order.

    A known recording that was moved is still the same. Raises :class:`UsageError` where two would share a
    name, and :class:`DataError` where one has another task now than the dataset has it under.
    """
    table = {(r.task, r.name): r for r in known}
    task_of = {r.source: r.task for r in known}
    new: dict[tuple[str, str], Recorded] = {}
    for one in found:
        key = one.task, one.name
        if task_of.get(one.source, one.task) != one.task:
            raise DataError(
                f"{one.source}: the dataset has this recording under the task '{task_of[one.source]}', now it would "
                f"be '{one.task}'; give --task {task_of[one.source]}, or another --out"
            )
        twin = table.get(key) or new.get(key)
        if twin is None:
            new[key] = one
        elif twin.source != one.source:
            if key in new or is_there(Path(twin.source)):
                raise UsageError(
                    f"two recordings of the task '{one.task}' are called '{one.name}': {twin.source} and "
                    f"{one.source}; rename one, or give them tasks of their own with --task"
                )
            table[key] = twin.model_copy(update={"source": one.source})
    first = max((r.seed for r in known), default=-1) + 1
    fresh = sorted(new.values(), key=lambda r: (natural_key(r.task), natural_key(r.name)))
    return (*table.values(), *(r.model_copy(update={"seed": first + k}) for k, r in enumerate(fresh)))
