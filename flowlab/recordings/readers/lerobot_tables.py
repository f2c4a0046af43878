"""Parquet files of strangers: what they claim is checked before memory is taken. Runs in a process of its own."""

import os
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from flowlab.errors import DataError, first_line
from flowlab.limits import MAX_FILES, MAX_LOADED_BYTES, MAX_PICTURE_BYTES, MAX_PIXELS, MAX_TABLE_ROWS, MAX_TEXT_BYTES
from flowlab.text import shown

_KEPT = 4
"""So many columns of pictures are kept, of color and of depth the part that is read and the one before."""


class ParquetTables:
    """The Parquet files that were asked for."""

    def __init__(self) -> None:
        self._pictures: dict[tuple[Any, ...], Any] = {}
        self._opened: dict[tuple[Any, ...], pq.ParquetFile] = {}
        pa.set_cpu_count(1)

    def names(self, path: str) -> list[str]:
        """The columns of a file."""
        return list(self._file(path).schema_arrow.names)

    def count(self, path: str) -> int:
        """How many rows a file has."""
        return int(self._file(path).metadata.num_rows)

    def rows(self, path: str, passed_over: str) -> dict[str, list[Any]]:
        """All columns, but for those whose names begin with ``passed_over``, as plain values."""
        file = self._file(path)
        names = [n for n in file.schema_arrow.names if not n.startswith(passed_over)]
        if file.metadata.num_rows > MAX_FILES:
            raise DataError(f"{path}: has {file.metadata.num_rows:,} rows, expected at most {MAX_FILES:,}")
        return {n: column.to_pylist() for n, column in zip(names, self._read(path, names).columns, strict=True)}

    def columns(
        self, path: str, names: Sequence[str], first: int = 0, count: int | None = None
    ) -> dict[str, np.ndarray]:
        """Columns of numbers, those of ``names`` that there are, each with a row a step.

        Raises:
            DataError: One holds something else, or rows of different lengths.
        """
        there = [n for n in dict.fromkeys(names) if n in self.names(path)]
        table = self._read(path, there, first, count)
        return {n: _numbers(f"{path}: {shown(n)}", c) for n, c in zip(there, table.columns, strict=True)}

    def picture(self, path: str, name: str, row: int) -> bytes:
        """The bytes of an embedded picture. Raises :class:`DataError`."""
        group, first = self._group(path, row)
        key = (*_state(path), name, group)
        if key not in self._pictures:
            table = self._read_groups(path, [name], [group])
            while len(self._pictures) >= _KEPT:
                self._pictures.pop(next(iter(self._pictures)))
            self._pictures[key] = table.column(0).combine_chunks()
        value = self._pictures[key][row - first].as_py()
        content = value.get("bytes") if isinstance(value, dict) else value
        if not isinstance(content, bytes):
            where = (
                f"; it names {shown(value['path'])} instead" if isinstance(value, dict) and value.get("path") else ""
            )
            raise DataError(f"{path}: {shown(name)} has no picture embedded in row {row}{where}")
        return content

    def _file(self, path: str) -> pq.ParquetFile:
        key = _state(path)
        if key not in self._opened:
            try:
                file = pq.ParquetFile(path, thrift_string_size_limit=MAX_TEXT_BYTES, page_checksum_verification=True)
            except (pa.ArrowException, OSError, ValueError) as error:
                raise DataError(f"{path}: is no readable Parquet file ({first_line(error)}); copy it again") from error
            if file.metadata.num_rows > MAX_TABLE_ROWS or file.metadata.num_row_groups > MAX_FILES:
                raise DataError(
                    f"{path}: says it has {file.metadata.num_rows:,} rows, expected at most {MAX_TABLE_ROWS:,}"
                )
            while len(self._opened) >= _KEPT:
                self._opened.pop(next(iter(self._opened)))
            self._opened[key] = file
        return self._opened[key]

    def _group(self, path: str, row: int) -> tuple[int, int]:
        """The row group that a row is in, and its first row."""
        first, about = 0, self._file(path).metadata
        for group in range(about.num_row_groups):
            count = about.row_group(group).num_rows
            if row < first + count:
                return group, first
            first += count
        raise DataError(f"{path}: has no row {row}; there are {first}")

    def _read(self, path: str, names: Sequence[str], first: int = 0, count: int | None = None) -> Any:
        """Some rows of columns."""
        last = self.count(path) if count is None else first + count
        if not first < last:
            return self._file(path).schema_arrow.empty_table().select(list(names))
        (begin, skipped), (end, _) = self._group(path, first), self._group(path, last - 1)
        table = self._read_groups(path, names, list(range(begin, end + 1)))
        return table.slice(first - skipped, last - first)

    def _read_groups(self, path: str, names: Sequence[str], groups: list[int]) -> Any:
        """Row groups of columns, where they say that they are not too large."""
        file = self._file(path)
        about, size = file.metadata, 0
        for group in groups:
            chunks = (about.row_group(group).column(k) for k in range(about.num_columns))
            size += sum(max(c.total_uncompressed_size, 8 * c.num_values if "." in c.path_in_schema else 0)
                        for c in chunks if any(f"{c.path_in_schema}.".startswith(f"{n}.") for n in names))  # fmt: skip
        if size > MAX_LOADED_BYTES:
            raise DataError(
                f"{path}: {shown(names[0])} unpacks to {size:,} bytes, expected at most {MAX_LOADED_BYTES:,}"
            )
        try:
            table = file.read_row_groups(groups, columns=list(names), use_threads=False)
            return table.select(list(names))
        except (pa.ArrowException, OSError, ValueError, KeyError) as error:
            raise DataError(f"{path}: cannot be read ({first_line(error)}); copy it again") from error


def _state(path: str) -> tuple[Any, ...]:
    about = os.stat(path)
    return path, about.st_mtime_ns, about.st_size, about.st_ino


def _numbers(where: str, column: Any) -> np.ndarray:
    """A column as an array, its lists as axes of it."""
    array, shape = column.combine_chunks(), [len(column)]
    array = pa.concat_arrays(array.chunks) if isinstance(array, pa.ChunkedArray) else array
    array = array.storage if isinstance(array, pa.ExtensionArray) else array
    while pa.types.is_list(array.type) or pa.types.is_large_list(array.type) or pa.types.is_fixed_size_list(array.type):
        inner = array.flatten()
        size = len(inner) // len(array) if len(array) else 0
        lengths = array.value_lengths() if not pa.types.is_fixed_size_list(array.type) else None
        if array.null_count or (lengths is not None and len(array) and (np.asarray(lengths) != size).any()):
            raise DataError(f"{where} has rows of different lengths, or none in some row")
        array, shape = inner, [*shape, size]
    if array.null_count:
        raise DataError(f"{where} has no value in {array.null_count} places")
    if not (pa.types.is_integer(array.type) or pa.types.is_floating(array.type) or pa.types.is_boolean(array.type)):
        raise DataError(f"{where} holds {shown(str(array.type))[1:-1]}, expected numbers")
    return np.ascontiguousarray(array.to_numpy(zero_copy_only=False).reshape(shape))


def tiff(content: bytes) -> np.ndarray:
    """The picture of a TIFF. Raises :class:`DataError`."""
    if len(content) > MAX_PICTURE_BYTES:
        raise DataError(f"has {len(content):,} bytes, expected at most {MAX_PICTURE_BYTES:,}")
    try:
        picture = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise DataError(f"cannot be decoded ({first_line(error)})") from error
    if picture is None or not 0 < picture.size <= 4 * MAX_PIXELS:
        raise DataError("cannot be decoded")
    return picture
