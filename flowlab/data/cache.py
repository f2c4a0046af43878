"""Arrays of a dataset decoded into files that are mapped into memory, once for each content on this machine.

They lie in the user's cache folder, and never in that of a dataset, which somebody else may have made: what is mapped
was decoded here, from episodes whose digests were checked, and is what it was when it was written.
"""

import atexit
import functools
import logging
import os
import shutil
import tempfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field, ValidationError

from flowlab.array_files import map_array
from flowlab.checksums import with_checksum, without_checksum
from flowlab.config import PlainName, Settings, explain
from flowlab.data.source import TrainingSource
from flowlab.errors import DataError, FlowlabError
from flowlab.files import locked, remove_leftovers, temporary_path, write_json
from flowlab.records import Episode
from flowlab.untrusted import read_json
from flowlab.user_cache import user_cache

INDEX = "index.json"
"""Written last: a folder that has it is whole."""
_FORMAT = 5
_BLOCK = 16 << 20
"""Bytes that are looked at together."""
_LOG = logging.getLogger(__name__)
_Row = Annotated[int, Field(ge=0, strict=True)]
ArraysOf = Callable[[Episode], tuple[Mapping[str, np.ndarray], Mapping[str, np.ndarray]]]
"""Takes out of an episode what is cached: arrays with a row per frame, and arrays of the whole episode."""


class CachedEpisode(Settings):
    """Where an episode lies in the arrays with a row per frame."""

    task: str
    seed: int
    start: _Row
    stop: _Row


class CacheIndex(Settings):
    """``index.json`` of a decoded part of a dataset."""

    dataset: str
    """Path of what was decoded, so that what is outdated of it can be deleted."""
    episodes: tuple[CachedEpisode, ...]
    """In order of task and seed."""
    arrays: Mapping[PlainName, int]
    """CRC-32 of every file of an array, by its name."""


def cached_part(source: TrainingSource, fallback: Path | None, part: str, arrays_of: ArraysOf) -> Path:
    """A part of a dataset, decoded into the user's cache folder, or below ``fallback/cache`` where that is unwritable.

    What is there already is looked over: what is damaged is decoded anew, which a warning says. Below ``fallback``,
    which somebody else may have made, nothing is believed but what this process decoded.

    Args:
        source: The dataset or store.
        fallback: Folder that takes the cache where the user's cannot be written; None is none.
        part: Name of the part; each is decoded when it is first asked for.
        arrays_of: What the part is of an episode.

    Returns:
        The folder of the part, for :func:`open_part`.

    Raises:
        DataError: No folder can be written, or the episodes are of different widths.
    """
    content = f"{source.cache_key}-{_FORMAT}"
    if fallback is not None:
        remove_leftovers(fallback / "cache")
    problems: list[str] = []
    for cache in _places(fallback, problems):
        try:
            with _alone(cache / content) as folder:
                if not _is_sound(folder / part):
                    _decode(source, folder / part, arrays_of)
                    _remove_outdated(cache, content, _place_of(source))
            return folder / part
        except FlowlabError:  # that a shard is missing is an OSError, too
            raise
        except OSError as error:
            problems.append(f"{cache}: cannot be written ({error.strerror or error})")
    raise DataError(f"{'; '.join(problems)}; make room there, or set FLOWLAB_CACHE to a folder for decoded datasets")


def open_part(folder: Path) -> tuple[list[dict[str, Any]], dict[str, np.ndarray]]:
    """A part of a dataset, mapped into memory.

    Returns:
        The episodes in order of task and seed, as ``task``, ``seed``, ``start`` and ``stop``; and the arrays by name: a
        row per frame, the episodes one behind the other as they are stored, or a row per episode, in their order.

    Raises:
        DataError: It is damaged, or no longer there.
    """
    index = _read_index(folder)
    return [e.model_dump() for e in index.episodes], {n: map_array(folder / f"{n}.npy") for n in index.arrays}


def _places(fallback: Path | None, problems: list[str]) -> Iterator[Path]:
    """Where decoded datasets may lie, the best place first."""
    try:
        yield user_cache() / "datasets"
    except OSError as error:
        problems.append(f"the user's cache: {error.strerror}")
    if fallback is None:
        return
    if (fallback / "cache").is_symlink():  # of a stranger's run it could lead anywhere
        problems.append(f"{fallback / 'cache'}: is a link, expected a folder")
        return
    try:
        yield _of_this_process(fallback / "cache")
    except OSError as error:
        problems.append(f"{fallback / 'cache'}: cannot be written ({error.strerror or error})")


@functools.cache
def _of_this_process(folder: Path) -> Path:
    """A new folder in one where a stranger may have put things, for as long as this process runs."""
    folder.mkdir(parents=True, exist_ok=True)
    remove_leftovers(folder)
    mine = Path(tempfile.mkdtemp(prefix=temporary_path(folder / "decoded-").name, dir=folder))
    atexit.register(shutil.rmtree, mine, ignore_errors=True)
    return mine


@contextmanager
def _alone(folder: Path) -> Iterator[Path]:
    """A folder, made if it is not there, that no other process looks over or fills at the same time."""
    while True:
        folder.mkdir(parents=True, exist_ok=True)
        if folder.is_symlink():
            raise OSError(None, f"{folder.name} is a link")
        with locked(folder):
            if folder.exists():  # else somebody has just deleted it as outdated
                yield folder
                return


def _is_sound(folder: Path) -> bool:
    """Whether a decoded part is there, as it was written; what is there and is not, is deleted."""
    if not os.path.lexists(folder):
        return False
    try:
        index = _read_index(folder)
        for name, known in index.arrays.items():
            path = folder / f"{name}.npy"
            map_array(path)
            if _checksum(path) != known:
                raise DataError(f"{path}: damaged (its checksum is another)")
        return True
    except DataError as error:
        _LOG.warning("flowlab: %s; the dataset is decoded again", error)
    if folder.is_symlink():
        folder.unlink()
    else:
        shutil.rmtree(folder)
    return False


def _read_index(folder: Path) -> CacheIndex:
    path = folder / INDEX
    values = without_checksum(read_json(path, "it can be deleted"), str(path), "it can be deleted")
    try:
        return CacheIndex.model_validate(values)
    except ValidationError as error:
        raise DataError(f"{path}: {explain(error, CacheIndex)}") from error


def _checksum(path: Path) -> int:
    """CRC-32 of a file."""
    value = 0
    with path.open("rb", buffering=0) as file:
        while block := file.read(_BLOCK):
            value = zlib.crc32(block, value)
    return value


def _remove_outdated(cache: Path, content: str, dataset: str) -> None:
    """Delete what was decoded of earlier contents of the same dataset: by our own index, and never through a link."""
    for other in cache.iterdir():
        if other.name == content or other.is_symlink() or not other.is_dir():
            continue
        with suppress(OSError):
            for part in other.iterdir():
                if not part.is_symlink() and _was_decoded_from(part, dataset):
                    shutil.rmtree(part)
            other.rmdir()  # where it is empty now


def _was_decoded_from(folder: Path, dataset: str) -> bool:
    try:
        return _read_index(folder).dataset == dataset
    except DataError:
        return False


@dataclass
class _Decoder:
    """Collects a part of a dataset, episode by episode, in a folder."""

    source: TrainingSource
    folder: Path
    arrays: dict[str, np.ndarray] = field(default_factory=dict)
    episodes: list[CachedEpisode] = field(default_factory=list)
    whole: list[Mapping[str, np.ndarray]] = field(default_factory=list)

    def add(self, e: Episode, per_frame: Mapping[str, np.ndarray], per_episode: Mapping[str, np.ndarray]) -> None:
        """The next episode."""
        start = self.episodes[-1].stop if self.episodes else 0
        stop = start + len(e)
        if stop > self.source.frames:
            raise DataError(f"{self.source.path}: holds more frames than its receipts say, {self.source.frames}")
        where, first = self._dataset_of(start), self._dataset_of(0)
        if self.episodes and (odd := sorted(self.arrays.keys() ^ per_frame.keys())):
            here = "here, and not" if odd[0] in per_frame else "not here, and"
            told = "" if where == first else f" ({here} in {first})"
            raise DataError(
                f"{where}: {e.task} seed {e.seed}: '{odd[0]}' is in some episodes only{told}; train on those that "
                "have it, or on the others"
            )
        for name, values in per_frame.items():
            if name not in self.arrays:
                shape = (self.source.frames, *values.shape[1:])
                self.arrays[name] = _create(self.folder / f"{name}.npy", values.dtype, shape)
            if values.shape[1:] != self.arrays[name].shape[1:]:
                raise DataError(
                    f"{where}: {e.task} seed {e.seed}: '{name}' is {values.shape[1:]} wide, in those before"
                    f"{'' if where == first else f', of {first},'} {self.arrays[name].shape[1:]}; train on one of them "
                    "at a time"
                )
            self.arrays[name][start:stop] = values
        self.episodes.append(CachedEpisode(task=e.task, seed=e.seed, start=start, stop=stop))
        self.whole.append(per_episode)

    def _dataset_of(self, row: int) -> Path:
        """Where the episode with a row lies."""
        for part in self.source.parts:
            if row < part.frames:
                return part.path
            row -= part.frames
        return self.source.path

    def finish(self) -> None:
        """Write what is still to be written, the index last."""
        if (found := self.episodes[-1].stop) != self.source.frames:
            raise DataError(f"{self.source.path}: holds {found} frames, its receipts say {self.source.frames}")
        order = sorted(range(len(self.episodes)), key=lambda k: (self.episodes[k].task, self.episodes[k].seed))
        for name in self.whole[0]:
            np.save(self.folder / f"{name}.npy", np.stack([self.whole[k][name] for k in order]))
        for array in self.arrays.values():
            array.flush()  # type: ignore[attr-defined]
        names = [*self.arrays, *self.whole[0]]
        index = CacheIndex(
            dataset=_place_of(self.source),
            episodes=tuple(self.episodes[k] for k in order),
            arrays={name: _checksum(self.folder / f"{name}.npy") for name in names},
        )
        write_json(self.folder / INDEX, with_checksum(index.model_dump(mode="json")))


def _place_of(source: TrainingSource) -> str:
    """Where what is decoded lies; several datasets together are none of them."""
    return ":".join(str(path.resolve()) for path in source.paths)


def _decode(source: TrainingSource, folder: Path, arrays_of: ArraysOf) -> None:
    """Make a part: whole, or not at all."""
    remove_leftovers(folder.parent)
    temporary = temporary_path(folder)
    try:
        temporary.mkdir()
        decoder = _Decoder(source, temporary)
        for episode in source.episodes():
            decoder.add(episode, *arrays_of(episode))
        decoder.finish()
        os.rename(temporary, folder)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _create(path: Path, dtype: np.dtype, shape: tuple[int, ...]) -> np.ndarray:
    """A mapped array whose space on disk is taken: without that a full disk kills the process as it writes."""
    array = np.lib.format.open_memmap(path, "w+", dtype, shape)
    with path.open("r+b") as file:
        os.posix_fallocate(file.fileno(), 0, path.stat().st_size)
    return array
