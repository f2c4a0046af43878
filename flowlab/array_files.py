"""NumPy's files of strangers: what a header claims is checked before memory is taken, and nothing is unpickled."""

import math
import shutil
import tempfile
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np

from flowlab.errors import DataError, first_line
from flowlab.files import told_when_unwritable
from flowlab.limits import MAX_ARRAY_BYTES, MAX_LOADED_BYTES, MAX_UNPACKING
from flowlab.text import cut
from flowlab.untrusted import check_regular

_ROOM = "have TMPDIR name a folder with more room"
_MOST_OF_NOTHING = 1 << 24
"""Rows of an array that holds no number."""
_HEADER = 10_000
"""Bytes of a header that NumPy may parse."""


def map_array(path: Path) -> np.ndarray:
    """An ``.npy`` file, mapped: read only, and only where it is looked at.

    Raises:
        DataError: It is no such file, holds Python objects, or claims more than it has.
    """
    size = check_regular(path, MAX_ARRAY_BYTES)
    with _told(path), path.open("rb") as file:
        return _mapped(file, size)


def load_array(path: Path, limit: int = MAX_LOADED_BYTES) -> np.ndarray:
    """All of an ``.npy`` file.

    Raises:
        DataError: As :func:`map_array`, and where it is larger than ``limit``.
    """
    size = check_regular(path, limit)
    with _told(path), path.open("rb") as file:
        return _read(file, size)


def load_arrays(path: Path, limit: int = MAX_LOADED_BYTES) -> dict[str, np.ndarray]:
    """All arrays of an ``.npz`` file, by name.

    Raises:
        DataError: It is no such file, a member is no array, or all of them together are larger than ``limit``.
    """
    check_regular(path, limit)
    with _told(path), zipfile.ZipFile(path) as archive:
        _check_unpacked(path, archive.infolist(), limit)
        arrays = {}
        for member in archive.infolist():
            with _told(path, member.filename), archive.open(member) as file:
                arrays[member.filename.removesuffix(".npy")] = _read(file, member.file_size)
        return arrays


def map_member(path: Path, name: str) -> np.ndarray:
    """An array of an ``.npz`` file, unpacked into a file without a name and mapped: nothing of it stays on the disk.

    Raises:
        DataError: It is no such file, holds no such array, unpacks to too much, or the disk is full.
    """
    size = check_regular(path, MAX_ARRAY_BYTES)
    with _told(path), zipfile.ZipFile(path) as archive:
        member = archive.getinfo(f"{name}.npy")
        _check_unpacked(path, archive.infolist(), min(MAX_ARRAY_BYTES, max(MAX_LOADED_BYTES, MAX_UNPACKING * size)))
        with _told(path, member.filename), archive.open(member) as file:
            _header(file, member.file_size)
        with tempfile.TemporaryFile() as unpacked, _told(path, member.filename):
            _check_room(path, member.file_size)
            with archive.open(member) as file, told_when_unwritable(Path(tempfile.gettempdir()), _ROOM):
                shutil.copyfileobj(file, unpacked, 1 << 20)
            length = unpacked.tell()
            unpacked.seek(0)
            return _mapped(unpacked, length)


def _check_room(path: Path, needed: int) -> None:
    folder = tempfile.gettempdir()
    if (free := shutil.disk_usage(folder).free) < needed:
        raise DataError(f"{path}: unpacks to {needed:,} bytes, and {folder} has {free:,} left; {_ROOM}")


def _check_unpacked(path: Path, members: list[zipfile.ZipInfo], limit: int) -> None:
    unpacked = sum(m.file_size for m in members)
    if unpacked > limit:
        raise DataError(f"{path}: unpacks to {unpacked:,} bytes, expected at most {limit:,}")


def _mapped(file: IO[bytes], size: int) -> np.ndarray:
    shape, fortran, dtype = _header(file, size)
    if math.prod(shape) == 0:
        return np.empty(shape, dtype)
    return np.memmap(file, dtype, "r", file.tell(), shape, "F" if fortran else "C")


def _read(file: IO[bytes], size: int) -> np.ndarray:
    shape, fortran, dtype = _header(file, size)
    values = np.empty(math.prod(shape), dtype)
    here, end = values.view(np.uint8).data, 0
    while end < len(here) and (count := file.readinto(here[end:])):  # type: ignore[attr-defined]
        end += count
    if end < len(here):
        raise ValueError("it ends too early")
    return values.reshape(shape, order="F" if fortran else "C")


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
    if 0 in shape and math.prod(n for n in shape if n) > _MOST_OF_NOTHING:
        raise ValueError(f"has the shape {cut(str(shape))}, and holds nothing")
    claimed, there = math.prod(shape) * dtype.itemsize, size - file.tell()
    if claimed > there:
        raise ValueError(f"its header claims {cut(f'{claimed:,}', 40)} bytes of numbers, it holds {there:,}")
    return shape, fortran, dtype


@contextmanager
def _told(path: Path, member: str = "") -> Iterator[None]:
    """Turns what NumPy and zipfile raise of damaged files into a sentence."""
    try:
        yield
    except DataError:
        raise
    except Exception as error:  # a score of kinds, zlib's and the tokenizer's among them
        where = f"{cut(member)}: " if member else ""
        raise DataError(f"{path}: {where}not a readable NumPy file ({first_line(error)})") from error
