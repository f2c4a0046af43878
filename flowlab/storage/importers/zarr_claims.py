"""What the arrays of a stranger's zarr v2 store claim, checked before zarr believes it and takes memory for it."""

import itertools
import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flowlab.errors import DataError
from flowlab.limits import MAX_ARRAY_BYTES, MAX_CHUNKS, MAX_LOADED_BYTES
from flowlab.text import cut, shown
from flowlab.untrusted import check_regular, read_json

_REDO = "write the store anew, or copy it again from where it is whole"
_BLOSC_HEADER = 16
"""Bytes; the four from the fifth on are how many a chunk unpacks to."""
_NUMBERS = re.compile(r"[<>|][fiu][1248]")
_MOST_DIMENSIONS = 8
_PLAIN = "numbers as they are, or compressed by Blosc, without filters"


@dataclass(frozen=True, slots=True)
class ArrayClaim:
    """An array as its ``.zarray`` describes it."""

    folder: Path
    shape: tuple[int, ...]
    chunks: tuple[int, ...]
    chunk_bytes: int
    """Of a chunk, unpacked."""
    is_compressed: bool
    """By Blosc; else chunks are the numbers themselves."""
    separator: str
    """Between the numbers in the names of chunks."""

    @classmethod
    def read(cls, folder: Path) -> "ArrayClaim":
        """What an array claims.

        Raises:
            DataError: It is larger than anybody's, holds no plain numbers, or needs a codec to be read that is none
                of those which do nothing but compress.
        """
        file = folder / ".zarray"
        about = read_json(file, _REDO)
        check_attributes(folder)
        if not isinstance(about, dict):
            raise DataError(f"{file}: holds {shown(about)}, expected names and values; {_REDO}")
        dtype, compressor = about.get("dtype"), about.get("compressor")
        if not isinstance(dtype, str) or not _NUMBERS.fullmatch(dtype):
            raise DataError(f"{folder}: values of type {shown(dtype)}, expected numbers")
        is_blosc = isinstance(compressor, dict) and compressor.get("id") == "blosc"
        if about.get("filters") or not (compressor is None or is_blosc):
            found = about.get("filters") or compressor
            raise DataError(f"{folder}: is stored by {shown(found)}, expected {_PLAIN}")
        shape, chunks = _lengths(file, "shape", about, 0), _lengths(file, "chunks", about, 1)
        size = int(dtype[-1])
        claim = cls(folder, shape, chunks, math.prod(chunks) * size, is_blosc, _separator(file, about))
        claim._check_size(file, math.prod(shape) * size)
        return claim

    def check_chunks(self, start: int, stop: int) -> None:
        """Refuse chunks of some rows that are no files of the size that is claimed, or do not unpack to it."""
        grid = [range(-(-n // c)) for n, c in zip(self.shape, self.chunks, strict=True)]
        grid[0] = range(start // self.chunks[0], -(-min(stop, self.shape[0]) // self.chunks[0]))
        for place in itertools.product(*grid):
            file = self.folder / self.separator.join(map(str, place))
            if file.exists() or file.is_symlink():  # zarr takes one that is missing for the fill value
                self._check_chunk(file)

    def _check_chunk(self, file: Path) -> None:
        size = check_regular(file, 2 * self.chunk_bytes + (1 << 16))
        unpacked = size
        if self.is_compressed:
            try:
                with file.open("rb") as chunk:
                    header = chunk.read(_BLOSC_HEADER)
            except OSError as error:
                raise DataError(f"{file}: cannot be read ({error.strerror or error}); {_REDO}") from error
            unpacked = int.from_bytes(header[4:8], "little") if len(header) == _BLOSC_HEADER else 0
        if unpacked != self.chunk_bytes:
            raise DataError(
                f"{file}: damaged (it unpacks to {unpacked:,} bytes, expected {self.chunk_bytes:,}); {_REDO}"
            )

    def _check_size(self, file: Path, size: int) -> None:
        if len(self.shape) != len(self.chunks) or not self.shape:
            raise DataError(f"{file}: the chunks are {self.chunks} of the shape {self.shape}; {_REDO}")
        count = math.prod(-(-n // c) for n, c in zip(self.shape, self.chunks, strict=True))
        if size > MAX_ARRAY_BYTES or self.chunk_bytes > MAX_LOADED_BYTES or count > MAX_CHUNKS:
            raise DataError(
                f"{file}: claims the shape {cut(str(self.shape))} in chunks of {cut(str(self.chunks))}, expected at "
                f"most {MAX_ARRAY_BYTES:,} bytes, in chunks of {MAX_LOADED_BYTES:,}, of which there are {MAX_CHUNKS:,}"
            )


def check_attributes(folder: Path) -> None:
    """Refuse what zarr reads beside arrays and groups, where it is not as it should be."""
    for name in (".zgroup", ".zattrs", ".zmetadata"):
        file = folder / name
        if file.exists() or file.is_symlink():
            about = read_json(file, _REDO)
            if not isinstance(about, dict):
                raise DataError(f"{file}: holds {shown(about)}, expected names and values; {_REDO}")


def _lengths(file: Path, name: str, about: dict[str, Any], least: int) -> tuple[int, ...]:
    found = about.get(name)
    if isinstance(found, list) and len(found) <= _MOST_DIMENSIONS and all(_is_length(n, least) for n in found):
        return tuple(found)
    raise DataError(f"{file}: '{name}' is {shown(found)}, expected whole numbers from {least} on; {_REDO}")


def _is_length(value: Any, least: int) -> bool:
    return type(value) is int and least <= value < 1 << 62


def _separator(file: Path, about: dict[str, Any]) -> str:
    separator = about.get("dimension_separator", ".")
    if separator not in (".", "/"):
        raise DataError(f"{file}: 'dimension_separator' is {shown(separator)}, expected '.' or '/'; {_REDO}")
    return str(separator)
