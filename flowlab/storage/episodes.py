"""Episodes of a dataset as a sequence: all of them, some of them, those of one task."""

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import overload

from flowlab.arguments import is_whole
from flowlab.errors import DataError, UsageError, unknown_name
from flowlab.records import Episode
from flowlab.storage.shard import Shard

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
            UsageError: The index is no number.
            DataError: Its shard is missing or damaged.
        """
        if isinstance(index, slice):
            return DatasetView(self.path, self.refs[index])
        if not is_whole(index):
            raise UsageError(
                f"{self.path}: episodes are counted from 0, as in dataset[0], and {index!r} is no number; those of a task "
                "are dataset.task('push')"
            )
        if not -len(self) <= index < len(self):
            raise IndexError(f"{self.path}: no episode {index}; there are {len(self)}, counted from 0")
        ref = self.refs[index]
        return Shard(self.path / ref.shard).episode(ref.position)

    def __iter__(self) -> Iterator[Episode]:
        """Every episode, in order."""
        name, shard = "", None
        for ref in self.refs:
            if shard is None or ref.shard != name:
                name, shard = ref.shard, Shard(self.path / ref.shard)
            yield shard.episode(ref.position)

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
        head = f"{type(self).__name__} {str(self.path)!r}: {len(self)} episodes, {frames} frames"
        return f"{head}, {len(count)} tasks ({tasks}{more})\n  arrays: {self._arrays()}"

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
