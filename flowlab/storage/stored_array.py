"""The arrays of a shard, decoded from its files: zarr v3 in the one form that flowlab writes, and no other.

Zarr's own library reads them as well; it takes three times as long for arrays as short as these
(``benchmarks/load.py``), and believes what their metadata claim: any codec, any size.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import EllipsisType
from typing import Any

import google_crc32c
import numpy as np
from jaxtyping import Int
from numcodecs.zstd import decompress

from flowlab.errors import DataError, first_line
from flowlab.storage.shard_files import ShardFiles
from flowlab.text import shown
from flowlab.untrusted import parse_json

_CODECS = ["bytes", "zstd", "crc32c"]
_ZSTD, _FRAME_HEADER = b"\x28\xb5\x2f\xfd", 6
"""What a frame begins with, and how long its header is at least."""
_CHECKSUM = 4
"""Bytes at the end of every chunk."""
_MOST_CHUNKS = 100_000
_ALWAYS_BYTES, _MOST_COMPRESSED = 64 << 20, 2_000
"""An array may unpack to so many bytes, or to so many times of what is stored of it."""


@dataclass(frozen=True, slots=True)
class StoredArray:
    """What an array of a shard is, without its values."""

    path: str
    """Below the shard: ``data/tracks``."""
    dims: tuple[str, ...]
    shape: tuple[int, ...]
    dtype: str
    unit: str
    rows_per_chunk: int

    def read(self, files: ShardFiles, rows: slice | int | EllipsisType = ...) -> np.ndarray:
        """Its values, or those of some rows.

        Raises:
            DataError: A chunk is missing or damaged: never zeros in silence.
        """
        place = f"{files.path}/{self.path}"
        length = self.shape[0]
        if isinstance(rows, int):
            start, stop = rows, rows + 1
        else:
            start, stop, _ = (slice(None) if rows is ... else rows).indices(length)
        if not 0 <= start <= stop <= length:
            raise DataError(f"{place}: has {length} rows, and rows {start} to {stop} are asked for")
        size = self.rows_per_chunk
        chunks = range(start // size, -(-stop // size)) if math.prod(self.shape[1:]) else range(0)
        if len(chunks) > _MOST_CHUNKS:
            raise DataError(f"{place}: damaged (it claims {len(chunks):,} chunks)")
        names = {k: self._chunk(k) for k in chunks}
        missing = sum(name not in files for name in names.values())
        if missing:
            raise DataError(f"{place}: {missing} of {len(names)} chunks missing")
        stored = {k: files.read(name) for k, name in names.items()}
        self._check_size(place, stored)
        values = np.empty((stop - start, *self.shape[1:]), self.dtype)
        for k, content in stored.items():
            chunk = self._decode(place, content)
            first, last = max(start, k * size), min(stop, (k + 1) * size)
            values[first - start : last - start] = chunk[first - k * size : last - k * size]
        return values[0] if isinstance(rows, int) else values

    def take(self, files: ShardFiles, rows: Int[np.ndarray, "T"]) -> np.ndarray:
        """Some of its rows, in any order; no more chunks are in memory than one at a time.

        Raises:
            DataError: A chunk is missing or damaged.
        """
        place = f"{files.path}/{self.path}"
        chunk_of, inside = np.divmod(rows, self.rows_per_chunk)
        values = np.empty((len(rows), *self.shape[1:]), self.dtype)
        for k in np.unique(chunk_of):
            stored = {0: files.read(self._chunk(int(k)))}
            self._check_size(place, stored)
            values[chunk_of == k] = self._decode(place, stored[0])[inside[chunk_of == k]]
        return values

    def _chunk(self, k: int) -> str:
        return "/".join([self.path, "c", str(k), *("0" for _ in self.shape[1:])])

    def _check_size(self, place: str, stored: Mapping[int, bytes]) -> None:
        """Refuse a chunk that claims to hold far more than it can."""
        claimed = len(stored) * self.rows_per_chunk * math.prod(self.shape[1:]) * np.dtype(self.dtype).itemsize
        if claimed > max(_ALWAYS_BYTES, _MOST_COMPRESSED * sum(map(len, stored.values()))):
            raise DataError(f"{place}: damaged (it claims {claimed:,} bytes, far more than what is stored can hold)")

    def _decode(self, place: str, content: bytes) -> np.ndarray:
        """The values of a chunk. Raises :class:`DataError` where it is damaged."""
        try:
            return self._unpacked(content)
        except (ValueError, RuntimeError, TypeError) as error:
            raise DataError(f"{place}: damaged ({first_line(error)})") from error

    def _unpacked(self, content: bytes) -> np.ndarray:
        payload, checksum = content[:-_CHECKSUM], content[-_CHECKSUM:]
        if google_crc32c.value(payload).to_bytes(_CHECKSUM, "little") != checksum:
            raise ValueError("a checksum does not match")
        values = np.empty((self.rows_per_chunk, *(max(1, n) for n in self.shape[1:])), self.dtype)
        if (holds := _content_size(payload)) != values.nbytes:  # the rest would be whatever was in memory before
            raise ValueError(f"a chunk holds {holds:,} bytes, expected {values.nbytes:,}")
        decompress(payload, values.view(np.uint8).reshape(-1))
        return values[(slice(None), *(slice(n) for n in self.shape[1:]))]


def _content_size(frame: bytes) -> int:
    """How many bytes a Zstandard frame says that it unpacks to (RFC 8878, 3.1.1.1); -1 where it does not say."""
    if len(frame) < _FRAME_HEADER or frame[:4] != _ZSTD:
        return -1
    kind, single_segment, has_dictionary = frame[4] >> 6, frame[4] >> 5 & 1, frame[4] & 3
    if has_dictionary or not (kind or single_segment):
        return -1
    begin = 5 if single_segment else 6
    size = int.from_bytes(frame[begin : begin + (1, 2, 4, 8)[kind]], "little")
    return size + 256 if kind == 1 else size


def stored_array(files: ShardFiles, path: str) -> StoredArray:
    """An array of a shard, its values unread.

    Raises:
        DataError: It is missing, or of a form that flowlab does not write.
    """
    place = f"{files.path}/{path}"
    if f"{path}/zarr.json" not in files:
        raise DataError(f"{place}: the array is missing")
    values = parse_json(files.read(f"{path}/zarr.json"), f"{place}/zarr.json")
    try:
        return _understood(path, values)
    except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
        raise DataError(f"{place}: damaged (its zarr.json has no usable {first_line(error)})") from error


def _understood(path: str, values: Mapping[str, Any]) -> StoredArray:
    shape, dtype = tuple(values["shape"]), np.dtype(values["data_type"])
    if not shape or not all(type(n) is int and 0 <= n < 1 << 40 for n in shape):
        raise ValueError(f"shape: {shown(values['shape'])}")
    if dtype.kind not in "biuf" or dtype.byteorder not in "=|":
        raise ValueError(f"data_type: {shown(values['data_type'])}")
    if (values["zarr_format"], values["node_type"]) != (3, "array") or values.get("storage_transformers"):
        raise ValueError("zarr_format and node_type")
    codecs = values["codecs"]
    endian = codecs[0].get("configuration", {}).get("endian", "little")
    if [codec["name"] for codec in codecs] != _CODECS or endian != "little":
        raise ValueError(f"codecs: {shown([codec['name'] for codec in codecs])}, expected {', '.join(_CODECS)}")
    chunks = tuple(values["chunk_grid"]["configuration"]["chunk_shape"])
    encoding = values["chunk_key_encoding"]
    if (encoding["name"], encoding.get("configuration", {}).get("separator", "/")) != ("default", "/"):
        raise ValueError(f"chunk_key_encoding: {shown(encoding)}")
    whole = tuple(max(1, n) for n in shape)
    if not (type(chunks[0]) is int and 0 < chunks[0] <= whole[0] and chunks[1:] == whole[1:]):
        raise ValueError(f"chunk_shape: {shown(list(chunks))}, expected some rows of {shown(list(shape))}")
    dims, unit = values.get("dimension_names") or (), values["attributes"].get("unit", "")
    return StoredArray(path, tuple(map(str, dims)), shape, str(dtype), str(unit), chunks[0])
