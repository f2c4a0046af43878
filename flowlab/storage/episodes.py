"""Episodes of a dataset as a sequence: all of them, some of them, those of one task."""

import operator
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, overload

from flowlab.errors import DataError, UsageError, unknown_name
from flowlab.records import Episode
from flowlab.storage.receipts import Receipt
from flowlab.storage.shard import REPAIR, Shard, episode_digest
from flowlab.text import counted, shown

_TASKS_SHOWN = 6


@dataclass(frozen=True, slots=True)
class EpisodeRef:
    """Where an episode lies in a dataset."""

    task: str
    seed: int
    frames: int
    shard: str
    """Path below the dataset."""
    position: int
    """Index within the shard."""
    digest: str
    """SHA-256 of its content, see :func:`~flowlab.storage.shard.episode_digest`."""


def unit_refs(receipt: Receipt) -> list[EpisodeRef]:
    """Where the episodes of a unit lie, in the order of its shard."""
    told = zip(receipt.accepted, receipt.frames, receipt.digests, strict=True)
    return [EpisodeRef(receipt.task, s, n, receipt.shard, k, digest) for k, (s, n, digest) in enumerate(told)]


def unit_shard(folder: Path, receipt: Receipt) -> Shard:
    """The shard of a unit. Raises :class:`DataError` where it holds other episodes than its receipt says."""
    shard = Shard(folder / receipt.shard)
    held = [(int(s), r.stop - r.start) for s, r in zip(shard.array("meta/seed"), shard.rows(), strict=False)]
    told = list(zip(receipt.accepted, receipt.frames, strict=True))
    if held != told:
        raise DataError(f"{shard.path}: holds (seed, frames) {shown(held)}, its receipt says {shown(told)}; {REPAIR}")
    return shard


def checked(folder: Path, ref: EpisodeRef, episode: Episode) -> Episode:
    """An episode that was read. Raises :class:`DataError` where it is not what its receipt says."""
    if episode_digest(episode) != ref.digest:
        raise DataError(
            f"{folder / ref.shard}: {ref.task} seed {ref.seed}: content differs from what its receipt says; {REPAIR}"
        )
    return episode


class EpisodeSequence(Sequence[Episode], ABC):
    """Episodes on disk, in order of task and seed, each read when it is asked for."""

    @property
    @abstractmethod
    def path(self) -> Path:
        """Folder of the dataset."""

    @property
    @abstractmethod
    def refs(self) -> Sequence[EpisodeRef]:
        """Where the episodes lie."""

    def __len__(self) -> int:
        return len(self.refs)

    @overload
    def __getitem__(self, index: int) -> Episode: ...
    @overload
    def __getitem__(self, index: slice) -> "DatasetView": ...
    def __getitem__(self, index: int | slice) -> "Episode | DatasetView":
        """One episode, or those of a slice; as in a list, negative numbers count from the end.

        Raises:
            IndexError: There is no such episode.
            UsageError: The index is no number and no slice.
            DataError: Its shard is missing or damaged.
        """
        if isinstance(index, slice):
            return DatasetView(self.path, self.refs[index])
        index = self._position(index)
        if not -len(self) <= index < len(self):
            raise IndexError(f"{self.path}: no episode {index}; there are {len(self)}, counted from 0")
        ref = self.refs[index]
        return checked(self.path, ref, Shard(self.path / ref.shard).episode(ref.position))

    def __iter__(self) -> Iterator[Episode]:
        """Every episode, in order."""
        name, shard = "", None
        for ref in self.refs:
            if shard is None or ref.shard != name:
                name, shard = ref.shard, Shard(self.path / ref.shard)
            yield checked(self.path, ref, shard.episode(ref.position))

    def __contains__(self, episode: object) -> bool:
        """Whether an episode of the same task and seed is here. Raises :class:`UsageError` for what is no episode."""
        return self.count(episode) > 0

    def count(self, value: object) -> int:
        """How many episodes are of the same task and seed as one. Raises :class:`UsageError` as ``in`` does."""
        task, seed = self._identity(value)
        return sum((ref.task, ref.seed) == (task, seed) for ref in self.refs)

    def index(self, value: object, start: int = 0, stop: int | None = None) -> int:
        """The position of the episode of the same task and seed, from 0.

        Raises:
            ValueError: There is none, as for a list.
            UsageError: The value is no episode.
        """
        task, seed = self._identity(value)
        for k in range(*slice(start, stop).indices(len(self))):
            if (self.refs[k].task, self.refs[k].seed) == (task, seed):
                return k
        raise ValueError(f"{self.path}: no episode of {task} has the seed {seed}")

    def _position(self, index: Any) -> int:
        """An index as a number, which NumPy's are, too."""
        if hasattr(index, "__index__"):
            return operator.index(index)
        how = f"episodes of one task are dataset.task({index!r})" if isinstance(index, str) else "as in dataset[2]"
        raise UsageError(f"{self.path}: episodes are numbered, and found a {type(index).__name__}; {how}")

    def _identity(self, value: object) -> tuple[str, int]:
        """What tells an episode from all others of a dataset."""
        if not isinstance(value, Episode):
            raise UsageError(f"{self.path}: holds episodes, and found a {type(value).__name__}; tasks are in .tasks")
        return value.task, value.seed

    @property
    def tasks(self) -> tuple[str, ...]:
        """Names of the tasks that there are episodes of."""
        return tuple(dict.fromkeys(ref.task for ref in self.refs))

    def task(self, name: str) -> "DatasetView":
        """The episodes of one task. Raises :class:`UsageError` where there are none of it."""
        if name not in self.tasks:
            raise unknown_name(f"task in {self.path}", name, self.tasks)
        return DatasetView(self.path, [ref for ref in self.refs if ref.task == name])

    def __repr__(self) -> str:
        count = Counter(ref.task for ref in self.refs)
        tasks = ", ".join(f"{task} {n}" for task, n in list(count.items())[:_TASKS_SHOWN])
        more = ", ..." if len(count) > _TASKS_SHOWN else ""
        frames = sum(ref.frames for ref in self.refs)
        head = f"{type(self).__name__} {str(self.path)!r}: {counted(len(self), 'episode')}, {counted(frames, 'frame')}"
        return f"{head}, {counted(len(count), 'task')} ({tasks}{more})\n  arrays: {self._arrays()}"

    def _arrays(self) -> str:
        """Names of the arrays that the first episode has, with the shape of a row."""
        if not self.refs:
            return "none yet"
        try:
            described = Shard(self.path / self.refs[0].shard).describe()
        except DataError as error:
            return f"unreadable ({error})"
        rows = [(a.path.removeprefix("data/"), a.shape[1:]) for a in described if a.path.startswith("data/")]
        return ", ".join(f"{name}[{', '.join(map(str, shape))}]" if shape else name for name, shape in rows)


class DatasetView(EpisodeSequence):
    """Some episodes of a dataset."""

    def __init__(self, path: Path, refs: Sequence[EpisodeRef]) -> None:
        self._path, self._refs = path, refs

    @property
    def path(self) -> Path:
        """Folder of the dataset."""
        return self._path

    @property
    def refs(self) -> Sequence[EpisodeRef]:
        """Where the episodes lie."""
        return self._refs
