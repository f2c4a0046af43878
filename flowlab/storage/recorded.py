"""Which recordings a dataset holds: each has a number that never changes, where simulation has a seed."""

import os
from collections import defaultdict
from collections.abc import Hashable, Iterator, Sequence

from flowlab.config import PlainName, Settings
from flowlab.errors import DataError, UsageError
from flowlab.text import natural_key

CONTENT = "content"
"""Where an episode's extras say what its recording is known by."""


class Recorded(Settings):
    """One recording of a dataset."""

    task: PlainName
    name: PlainName
    """Of its folder or file, with a number behind it where another one of the task is called so."""
    seed: int = -1
    """Its number in the dataset; -1 until it has one."""
    source: str
    """Its path when it was last seen."""
    content: str = ""
    """What it is known by, wherever it lies: the part before a ``/`` stands for its files. Empty where an earlier
    flowlab made the dataset."""

    @property
    def files(self) -> str:
        """What its files are known by; empty where that is not known."""
        return self.content.partition("/")[0]

    def has_same_files(self, other: "Recorded") -> bool | None:
        """Whether it is the same recording by its files; None where that is not known."""
        return self.files == other.files if self.files and other.files else None


def number_recordings(known: Sequence[Recorded], found: Sequence[Recorded]) -> tuple[Recorded, ...]:
    """The known recordings as they are numbered, then the new ones of ``found`` in natural order.

    A recording is known again by its content, wherever it lies now; then by its path, where its content may have
    changed since. One that only has the name of another is a new one, with a name of its own. Where a dataset of an
    earlier flowlab does not know contents, a known name whose path is gone is taken for a recording that was moved.

    Args:
        known: Those of the dataset.
        found: Those that are there now, with a task and a name each.

    Returns:
        All of them, each with its number.

    Raises:
        UsageError: The same recording is there twice.
        DataError: A recording has another task now than the dataset has it under.
    """
    table = _Table(known, found)
    rest = [one for one in table.found.values() if not table.take_same(one)]
    rest = [one for one in rest if not table.take_moved(one)]
    rest = [one for one in rest if not table.take_changed(one)]
    first = max((r.seed for r in known), default=-1) + 1
    fresh = sorted(rest, key=lambda r: (natural_key(r.task), natural_key(r.name), natural_key(r.source)))
    for seed, one in enumerate(fresh, first):
        table.add(one, seed)
    return tuple(table.rows)


class _Table:
    """The recordings of a dataset while those that are there now are looked up in it."""

    def __init__(self, known: Sequence[Recorded], found: Sequence[Recorded]) -> None:
        self.rows: list[Recorded] = []
        self.found = {r.source: r for r in found}
        self._taken: set[int] = set()
        self._index: dict[Hashable, list[int]] = defaultdict(list)
        for row in known:
            self._append(row)

    def take_same(self, one: Recorded) -> bool:
        """Whether it lies where it lay, as it was."""
        k = next((k for k in self._free(one.task, one.source) if self.rows[k].has_same_files(one) is not False), None)
        return self._take(k, one)

    def take_moved(self, one: Recorded) -> bool:
        """Whether it is a known one that lay elsewhere: by its content, or by its name where no content is known."""
        alike = [k for k in self._free(one.task, one.name) if self.rows[k].has_same_files(one) is None]
        same = [*(self._free(one.task, one.files, "files") if one.files else ()), *alike]
        return self._take(next((k for k in same if self._is_gone(self.rows[k])), None), one)

    def take_changed(self, one: Recorded) -> bool:
        """Whether a known one lay there, so that its content has changed since."""
        task = next((self.rows[k].task for k in self._free(None, one.source)), one.task)
        if task != one.task:
            raise DataError(
                f"{one.source}: the dataset has this recording under the task '{task}', now it would be "
                f"'{one.task}'; give --task {task}, or another --out"
            )
        return self._take(next(self._free(one.task, one.source), None), one)

    def add(self, one: Recorded, seed: int) -> None:
        """Add one that is new, with a name of its own. Raises :class:`UsageError` where it is there already."""
        for twin in map(self.rows.__getitem__, self._index[one.task, one.name]):
            if twin.has_same_files(one) is not False:
                why = "with the same content" if twin.files and one.files else "which cannot be told apart"
                raise UsageError(
                    f"two recordings of the task '{one.task}' are called '{one.name}', {why}: {twin.source} and "
                    f"{one.source}; leave one out, rename one, or give them tasks of their own with --task"
                )
        number, name = 2, one.name
        while self._index.get((one.task, name)):
            number, name = number + 1, f"{one.name}-{number}"
        self._append(one.model_copy(update={"seed": seed, "name": name}))

    def _append(self, row: Recorded) -> None:
        self.rows.append(row)
        for key in ((row.task, row.source), (None, row.source), (row.task, row.name), (row.task, row.files, "files")):
            self._index[key].append(len(self.rows) - 1)

    def _free(self, *key: Hashable) -> Iterator[int]:
        """The rows by a key that are none of those found so far."""
        return (k for k in self._index.get(key, ()) if k not in self._taken)

    def _is_gone(self, row: Recorded) -> bool:
        """Whether a known recording is no longer where it lay: nothing is there, or something else."""
        there = self.found.get(row.source)
        return not os.path.lexists(row.source) if there is None else there.has_same_files(row) is False

    def _take(self, k: int | None, one: Recorded) -> bool:
        """Make a row what is there now, if there is such a row."""
        if k is None:
            return False
        self._taken.add(k)
        self.rows[k] = self.rows[k].model_copy(update={"source": one.source, "content": one.content})
        return True
