"""Pictures of a dataset as rows of one array that stays on disk: read from the shards as they are asked for."""

import math
import os
from collections import OrderedDict
from itertools import accumulate
from typing import Any

import numpy as np
from jaxtyping import Int

from flowlab.errors import DataError
from flowlab.limits import MAX_PIXELS
from flowlab.storage.dataset import Dataset
from flowlab.storage.episodes import unit_shard
from flowlab.storage.schema import SCHEMA
from flowlab.storage.shard import REPAIR, Shard
from flowlab.storage.stored_array import StoredArray
from flowlab.text import shown

_OPEN = 16
"""So many shards are open at a time."""


class StoredPictures:
    """One kind of picture of all episodes, (F, height, width, ...), in the order of the shards.

    Rows are asked for as of a NumPy array, ``pictures[5:8]`` or ``pictures[rows]``. Only the chunks that hold them are
    read, of which one is in memory at a time. Chunks are checked by their CRC-32C, and shards against their receipts.
    It can be pickled, and used by processes that were forked.

    Args:
        dataset: It holds episodes.
        name: ``rgb`` or ``depth``.

    Raises:
        DataError: Some episodes have no such pictures, or of another size; or a shard is damaged.
    """

    def __init__(self, dataset: Dataset, name: str) -> None:
        self._folder = dataset.path
        self._name = name
        slim: dict[str, Any] = {"stats": {}, "stages": {}, "rejects": ()}  # of what travels to other processes
        self._receipts = [r.model_copy(update=slim) for r in dataset.receipts if r.accepted]
        self._ends = np.cumsum([sum(r.frames) for r in self._receipts])
        self._opened: OrderedDict[int, tuple[Shard, StoredArray]] = OrderedDict()
        self._process = os.getpid()
        first = self._read_shard(0)[1]
        self.shape = (int(self._ends[-1]), *first.shape[1:])
        self.dtype = np.dtype(first.dtype)
        self._together = max(self._check_alike(k) for k in range(len(self._receipts)))
        rows = [(r.task, s, n) for r in self._receipts for s, n in zip(r.accepted, r.frames, strict=True)]
        begin = accumulate((n for *_, n in rows), initial=0)
        start = {(task, seed): first for (task, seed, _), first in zip(rows, begin, strict=False)}
        self.starts: Int[np.ndarray, E] = np.array([start[ref.task, ref.seed] for ref in dataset.refs])
        """The first row of each episode, these in order of task and seed."""

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, rows: slice | Int[np.ndarray, "T"]) -> np.ndarray:
        wanted = np.arange(len(self))[rows] if isinstance(rows, slice) else rows
        of_shard = np.searchsorted(self._ends, wanted, side="right")
        values = np.empty((len(wanted), *self.shape[1:]), self.dtype)
        for k in np.unique(of_shard):
            shard, array = self._open(int(k))
            start = self._ends[k - 1] if k else 0
            values[of_shard == k] = shard.take(array, wanted[of_shard == k] - start)
        return values

    def is_quick(self, most_bytes: int) -> bool:
        """Whether no more than that is decoded for any picture, or nothing but the picture itself.

        Earlier versions stored up to 256 of them together.
        """
        return self._together == 1 or self.chunk_bytes <= most_bytes

    @property
    def chunk_bytes(self) -> int:
        """So much is in memory at a time, beside what is asked for."""
        return self._together * math.prod(self.shape[1:]) * self.dtype.itemsize

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_opened": OrderedDict()}

    def _open(self, k: int) -> tuple[Shard, StoredArray]:
        """A shard, left open. A file that is open has one place where it is read, which forked processes would share,
        so each opens its own."""
        if self._process != os.getpid():
            self._opened, self._process = OrderedDict(), os.getpid()
        if k not in self._opened:
            self._opened[k] = self._read_shard(k)
            if len(self._opened) > _OPEN:
                self._opened.popitem(last=False)
        return self._opened[k]

    def _read_shard(self, k: int) -> tuple[Shard, StoredArray]:
        """A shard, and what it says of its pictures."""
        receipt, spec = self._receipts[k], next(spec for spec in SCHEMA if spec.path == f"data/{self._name}")
        shard = unit_shard(self._folder, receipt)
        if not shard.has(spec):
            where = f"{self._folder}: {receipt.task} seed {receipt.accepted[0]}"
            raise DataError(f"{where}: '{self._name}' is in some episodes only; take those by 'flowlab subset'")
        array = shard.stored(spec.path)
        colors = (3,) if self._name == "rgb" else ()
        size = tuple(shard.attributes.camera.get(name) for name in ("height", "width"))
        if array.shape != (sum(receipt.frames), *size, *colors) or array.dtype != spec.dtype:
            raise DataError(
                f"{shard.path}/{spec.path}: damaged ({array.dtype} {array.shape} for {sum(receipt.frames)} rows of a "
                f"camera of {shown(size)}); {REPAIR}"
            )
        if math.prod(array.shape[1:3]) > MAX_PIXELS:
            raise DataError(f"{shard.path}/{spec.path}: has pictures of {shown(size)}, at most {MAX_PIXELS:,} are read")
        return shard, array

    def _check_alike(self, k: int) -> int:
        """How many pictures lie together in a shard, which must be as large as those of the first."""
        array, receipt = self._read_shard(k)[1], self._receipts[k]
        if array.shape[1:] != self.shape[1:]:
            raise DataError(
                f"{self._folder}: {receipt.task} seed {receipt.accepted[0]}: '{self._name}' is {array.shape[1:]}, in "
                f"those before {self.shape[1:]}; take those of one size by 'flowlab subset'"
            )
        return array.rows_per_chunk


def kinds_of_pictures(dataset: Dataset) -> tuple[str, ...]:
    """Which kinds of pictures the first episodes of a dataset have; none where its shards are gone.

    Raises:
        DataError: The first shard is bad.
    """
    first = next(r for r in dataset.receipts if r.accepted)
    if not (dataset.path / first.shard).exists():
        return ()
    shard = unit_shard(dataset.path, first)
    return tuple(spec.name for spec in SCHEMA if spec.is_picture and shard.has(spec))
