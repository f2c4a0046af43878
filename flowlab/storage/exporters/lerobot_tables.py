"""Parquet files as LeRobot reads them: one row group for each episode, numbers split by their bytes and compressed."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Shaped

FILES_TO_CHUNK = 1000
"""A folder has so many files at most."""


def place_of(file: int) -> dict[str, int]:
    """The chunk of a file, and its number in there, as LeRobot calls them."""
    return {"chunk_index": file // FILES_TO_CHUNK, "file_index": file % FILES_TO_CHUNK}


def numbered(folder: Path, file: int, suffix: str) -> Path:
    """Where a file of a number lies below a folder."""
    chunk, number = place_of(file).values()
    return folder / f"chunk-{chunk:03d}" / f"file-{number:03d}{suffix}"


def as_column(values: Shaped[np.ndarray, "T ..."]) -> Any:
    """A column of an array with a row for each step: plain numbers, or lists of some depth."""
    column = pa.array(values.reshape(-1))
    if values.shape[1:] == (1,):
        return column
    for size in values.shape[:0:-1]:
        column = pa.ListArray.from_arrays(pa.array(np.arange(0, len(column) + 1, size, dtype=np.int32)), column)
    return column


def as_pictures(contents: Sequence[bytes], names: Sequence[str]) -> Any:
    """A column of embedded pictures."""
    kind = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
    return pa.array([{"bytes": b, "path": n} for b, n in zip(contents, names, strict=True)], kind)


class TableWriter:
    """Writes the steps of episodes into Parquet files of a limited size."""

    def __init__(self, folder: Path, most_bytes: int) -> None:
        self._folder, self._most = folder, most_bytes
        self._file = -1
        self._bytes = 0
        self._writer: Any = None

    def add(self, columns: Mapping[str, Any]) -> int:
        """Write an episode.

        Args:
            columns: Its columns, the same in every one.

        Returns:
            The number of the file that it is in.
        """
        table = pa.table(dict(columns))
        if self._writer is None or self._bytes > self._most:
            self._open(table.schema)
        self._writer.write_table(table, row_group_size=max(1, table.num_rows))
        self._bytes += table.nbytes
        return self._file

    def close(self) -> None:
        """End the last file."""
        if self._writer is not None:
            self._writer.close()
            self._writer = None

    def _open(self, schema: Any) -> None:
        self.close()
        self._file += 1
        self._bytes = 0
        path = numbered(self._folder, self._file, ".parquet")
        path.parent.mkdir(parents=True, exist_ok=True)
        split = [leaf for f in schema if (leaf := _float_leaf(f.name, f.type))]
        self._writer = pq.ParquetWriter(
            path,
            schema,
            compression="zstd",
            use_dictionary=False,
            use_byte_stream_split=split,
            write_page_checksum=True,
        )


def _float_leaf(name: str, kind: Any) -> str:
    """The path of the floats of a column in the file; empty where it has none."""
    while pa.types.is_list(kind):
        name, kind = f"{name}.list.element", kind.value_type
    return name if pa.types.is_floating(kind) else ""


def write_table(path: Path, columns: Mapping[str, Any]) -> None:
    """Write a small table."""
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(pa.table(dict(columns)), path, compression="snappy")


def write_tasks(path: Path, tasks: Sequence[str]) -> None:
    """Write ``meta/tasks.parquet``, whose words are the index of a table of pandas."""
    table = pa.table({"task_index": pa.array(range(len(tasks)), pa.int64()), "task": pa.array(tasks, pa.string())})
    about = {
        "index_columns": ["task"],
        "column_indexes": [],
        "columns": [
            {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": numpy, "metadata": None}
            for name, kind, numpy in (("task_index", "int64", "int64"), ("task", "unicode", "object"))
        ],
        "creator": {"library": "pyarrow", "version": pa.__version__},
        "pandas_version": None,
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(table.replace_schema_metadata({"pandas": json.dumps(about)}), path, compression="snappy")
