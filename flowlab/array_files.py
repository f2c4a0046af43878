"""NumPy's files of strangers: what a header claims is checked before memory is taken, and nothing is unpickled."""

import io
import math
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np

from flowlab.errors import DataError, first_line
from flowlab.limits import MAX_ARRAY_BYTES, MAX_LOADED_BYTES
from flowlab.text import cut
from flowlab.untrusted import check_regular

_HEADER = 10_000
"""Bytes of a header that NumPy may parse."""


def map_array(path: Path) -> np.ndarray:
    """An ``.npy`` file, mapped: read only, and only where it is looked at.

    Raises:
        DataError: It is no such file, holds Python objects, or claims more than it has.
    """
    size = check_regular(path, MAX_ARRAY_BYTES)
    with _told(path), path.open("rb") as file:
        shape, fortran, dtype = _header(file, size)
        offset, count = file.tell(), math.prod(shape)
        if count == 0:
            return np.empty(shape, dtype)
        return np.memmap(path, dtype, "r", offset, shape, "F" if fortran else "C")


def load_array(path: Path) -> np.ndarray:
    """All of an ``.npy`` file. Raises :class:`DataError` as :func:`map_array`, and where it is too large for memory."""
    size = check_regular(path, MAX_LOADED_BYTES)
    with _told(path), path.open("rb") as file:
        return _read(file, size)


def load_arrays(path: Path) -> dict[str, np.ndarray]:
    """All arrays of an ``.npz`` file, by name.

    Raises:
        DataError: It is no such file, a member is no array, or all of them together are too large for memory.
    """
    check_regular(path, MAX_LOADED_BYTES)
    with _told(path), zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        unpacked = sum(m.file_size for m in members)
        if unpacked > MAX_LOADED_BYTES:
            raise DataError(f"{path}: unpacks to {unpacked:,} bytes, expected at most {MAX_LOADED_BYTES:,}")
        arrays = {}
        for member in members:
            name = member.filename.removesuffix(".npy")
            with _told(path, f"{cut(member.filename)}: "), archive.open(member) as file:
                arrays[name] = _read(io.BytesIO(file.read(member.file_size)), member.file_size)
        return arrays


def _read(file: IO[bytes], size: int) -> np.ndarray:
    shape, fortran, dtype = _header(file, size)
    values = np.frombuffer(file.read(math.prod(shape) * dtype.itemsize), dtype)
    return values.reshape(shape, order="F" if fortran else "C").copy()


def _header(file: IO[bytes], size: int) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Shape, order and type that a file claims and is large enough for; it stands behind its header then."""
    version = np.lib.format.read_magic(file)
    read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}.get(version)
    if read is None:
        raise ValueError(f"version {version} of the format is none that holds plain numbers")
    shape, fortran, dtype = read(file, _HEADER)
    if dtype.hasobject or dtype.kind not in "biufcUS" or dtype.itemsize == 0:
        raise ValueError(f"holds {cut(str(dtype))}, expected numbers or text; it is not unpickled")
    if not all(type(n) is int and n >= 0 for n in shape):
        raise ValueError(f"has the shape {cut(str(shape))}, which is none")
    claimed, there = math.prod(shape) * dtype.itemsize, size - file.tell()
    if claimed > there:
        raise ValueError(f"its header claims {claimed:,} bytes of numbers, it holds {there:,}")
    return shape, fortran, dtype


@contextmanager
def _told(path: Path, member: str = "") -> Iterator[None]:
    """Turns what NumPy and zipfile raise of damaged files into a sentence."""
    try:
        yield
    except DataError:
        raise
    except (
        ValueError, TypeError, SyntaxError, OverflowError, EOFError, KeyError, NotImplementedError, RecursionError,
        RuntimeError, MemoryError, OSError, zipfile.BadZipFile, zlib.error,
    ) as error:  # fmt: skip
        raise DataError(f"{path}: {member}not a readable NumPy file ({first_line(error)})") from error
