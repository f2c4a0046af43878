"""Arrays of a dataset decoded into files that are mapped into memory, once for each content of the dataset."""

import os
import re
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from flowlab.data.source import TrainingSource
from flowlab.errors import DataError
from flowlab.files import locked, remove_leftovers, temporary_path, write_json
from flowlab.records import Episode
from flowlab.untrusted import read_json

INDEX = "index.json"
"""Written last: a folder that has it is whole."""
_FORMAT = 3
_FORM = re.compile(r"[0-9a-f]{16}-\d+(-\w+)?")
"""What folders of decoded arrays are called, of this format and of earlier ones."""
_MARKS = (INDEX, "corpus.json")
ArraysOf = Callable[[Episode], tuple[Mapping[str, np.ndarray], Mapping[str, np.ndarray]]]
"""Takes out of an episode what is cached: arrays with a row per frame, and arrays of the whole episode."""


def cached_part(source: TrainingSource, fallback: Path, part: str, arrays_of: ArraysOf) -> Path:
    """A part of a dataset, decoded into ``cache`` below it, or into that of ``fallback`` where it cannot be written.

    Args:
        source: The dataset or store.
        fallback: Folder that takes the cache where the dataset's own cannot be written.
        part: Name of the part; each is decoded when it is first asked for.
        arrays_of: What the part is of an episode.

    Returns:
        The folder of the part, for :func:`open_part`.

    Raises:
        DataError: Neither folder can be written, or the episodes are of different widths.
    """
    content = f"{source.fingerprint}-{_FORMAT}"
    candidates = [parent / "cache" / f"{content}-{part}" for parent in (source.path, fallback)]
    for folder in candidates:
        if (folder / INDEX).exists():
            return folder
    writable = next((c for c in candidates if _is_writable(c.parent)), None)
    if writable is None:
        raise DataError(f"{fallback}: cannot be written; choose another --out, or in Python another cache")
    with locked(writable.parent):
        if not (writable / INDEX).exists():
            remove_leftovers(writable.parent)
            temporary = temporary_path(writable)
            try:
                _decode(source, temporary, arrays_of)
                if writable == candidates[0]:  # of a folder of one's own, another dataset's arrays are not ours
                    _remove_outdated(writable.parent, content)
                shutil.rmtree(writable, ignore_errors=True)
                os.replace(temporary, writable)
            except OSError as error:
                raise DataError(f"{writable}: cannot be written ({error.strerror}); make room there") from error
            finally:
                shutil.rmtree(temporary, ignore_errors=True)
    return writable


def open_part(folder: Path) -> tuple[list[dict[str, Any]], dict[str, np.ndarray]]:
    """A part of a dataset, mapped into memory.

    Returns:
        The episodes in order of task and seed, as ``task``, ``seed``, ``start`` and ``stop``; and the arrays by name: a
        row per frame, the episodes one behind the other as they are stored, or a row per episode, in their order.
    """
    index = read_json(folder / INDEX)
    return index["episodes"], {name: np.load(folder / f"{name}.npy", mmap_mode="r") for name in index["arrays"]}


def _remove_outdated(cache: Path, content: str) -> None:
    """Delete what was decoded of an earlier content of the dataset: folders of our form and mark, and nothing else."""
    for other in cache.iterdir():
        ours = _FORM.fullmatch(other.name) and any((other / mark).is_file() for mark in _MARKS)
        if ours and not other.is_symlink() and not other.name.startswith(content):
            shutil.rmtree(other, ignore_errors=True)


def _is_writable(folder: Path) -> bool:
    """Whether folders can be made here; a link could lead anywhere, so one is not followed."""
    if folder.is_symlink():
        return False
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return False
    return os.access(folder, os.W_OK)


@dataclass
class _Decoder:
    """Collects a part of a dataset, episode by episode, in a folder."""

    source: TrainingSource
    folder: Path
    arrays: dict[str, np.ndarray] = field(default_factory=dict)
    episodes: list[dict[str, Any]] = field(default_factory=list)
    whole: list[Mapping[str, np.ndarray]] = field(default_factory=list)

    def add(self, e: Episode, per_frame: Mapping[str, np.ndarray], per_episode: Mapping[str, np.ndarray]) -> None:
        """The next episode."""
        start = self.episodes[-1]["stop"] if self.episodes else 0
        stop = start + len(e)
        if self.episodes and (odd := sorted(self.arrays.keys() ^ per_frame.keys())):
            raise DataError(
                f"{self.source.path}: {e.task} seed {e.seed}: '{odd[0]}' is in some episodes only; train on those that "
                "have it, or on the others"
            )
        for name, values in per_frame.items():
            if name not in self.arrays:
                shape = (self.source.frames, *values.shape[1:])
                self.arrays[name] = _create(self.folder / f"{name}.npy", values.dtype, shape)
            if values.shape[1:] != self.arrays[name].shape[1:]:
                raise DataError(
                    f"{self.source.path}: {e.task} seed {e.seed}: '{name}' is {values.shape[1:]} wide, in those "
                    f"before {self.arrays[name].shape[1:]}; train on one of them at a time"
                )
            self.arrays[name][start:stop] = values
        self.episodes.append({"task": e.task, "seed": e.seed, "start": start, "stop": stop})
        self.whole.append(per_episode)

    def finish(self) -> None:
        """Write what is still to be written, the index last."""
        order = sorted(range(len(self.episodes)), key=lambda k: (self.episodes[k]["task"], self.episodes[k]["seed"]))
        for name in self.whole[0]:
            np.save(self.folder / f"{name}.npy", np.stack([self.whole[k][name] for k in order]))
        for array in self.arrays.values():
            array.flush()  # type: ignore[attr-defined]
        names = [*self.arrays, *self.whole[0]]
        write_json(self.folder / INDEX, {"episodes": [self.episodes[k] for k in order], "arrays": names})


def _decode(source: TrainingSource, folder: Path, arrays_of: ArraysOf) -> None:
    folder.mkdir()
    decoder = _Decoder(source, folder)
    for episode in source.episodes():
        decoder.add(episode, *arrays_of(episode))
    decoder.finish()


def _create(path: Path, dtype: np.dtype, shape: tuple[int, ...]) -> np.ndarray:
    """A mapped array whose space on disk is taken: without that a full disk kills the process as it writes."""
    array = np.lib.format.open_memmap(path, "w+", dtype, shape)
    with path.open("r+b") as file:
        os.posix_fallocate(file.fileno(), 0, path.stat().st_size)
    return array
