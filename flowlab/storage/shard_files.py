"""The files that a shard consists of, in one stored zip, or in the folder that it was until schema version 2."""

import stat
import zipfile
import zlib
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path

from flowlab.errors import DataError, first_line
from flowlab.limits import MAX_ARRAY_BYTES, MAX_LOADED_BYTES
from flowlab.text import is_path_inside, shown
from flowlab.untrusted import check_regular, read_bytes

SUFFIX = ".zarr.zip"
_EPOCH = (1980, 1, 1, 0, 0, 0)
"""The date of every file in a zip, so that the same episodes give the same bytes."""


class ShardFiles(ABC):
    """Some files by name, such as ``data/tracks/zarr.json``."""

    def __init__(self, path: Path) -> None:
        self.path = path

    @abstractmethod
    def __contains__(self, name: str) -> bool:
        """Whether there is a file of this name."""

    @abstractmethod
    def read(self, name: str) -> bytes:
        """The content of a file. Raises :class:`DataError` where it is missing or damaged."""


class ZippedFiles(ShardFiles):
    """Files in a zip that only stores them, so that it unpacks to no more than it is; their checksums are verified."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        check_regular(path, MAX_ARRAY_BYTES)
        try:
            self._zip = zipfile.ZipFile(path)
        except (OSError, ValueError, zipfile.BadZipFile, NotImplementedError) as error:
            raise DataError(f"{path}: not a readable shard ({first_line(error)})") from error
        self._members = {m.filename: m for m in self._zip.infolist()}
        if problem := _oddity(self._zip.infolist()):
            raise DataError(f"{path}: damaged ({problem})")

    def __contains__(self, name: str) -> bool:
        return name in self._members

    def read(self, name: str) -> bytes:
        """The content of a file."""
        member = self._members.get(name)
        if member is None:
            raise DataError(f"{self.path}/{name}: missing")
        if member.compress_type != zipfile.ZIP_STORED or member.file_size != member.compress_size:
            raise DataError(f"{self.path}/{name}: is compressed, expected a zip that only stores")
        try:
            return self._zip.read(member)
        except (
            OSError,
            ValueError,
            EOFError,
            RuntimeError,
            NotImplementedError,
            zipfile.BadZipFile,
            zlib.error,
        ) as error:
            raise DataError(f"{self.path}/{name}: damaged ({first_line(error)})") from error


def _oddity(members: Sequence[zipfile.ZipInfo]) -> str:
    """What a zip has that flowlab writes into none, so that other programs cannot read another shard in it."""
    names = [m.filename for m in members]
    if len({*names}) != len(names):
        return "two of its files have one name"
    if outside := [n for n in names if not is_path_inside(n)]:
        return f"a file in it is called {shown(outside[0])}"
    if linked := [m for m in members if stat.S_ISLNK(m.external_attr >> 16)]:
        return f"{shown(linked[0].filename)} in it is a link"
    if members and min(m.header_offset for m in members) != 0:
        return "something stands before its first file"
    return ""


class FolderFiles(ShardFiles):
    """Files in a folder."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        if not path.is_dir():
            raise DataError(f"{path}: not a readable shard (there is no such folder)")

    def __contains__(self, name: str) -> bool:
        return (self.path / name).is_file()

    def read(self, name: str) -> bytes:
        """The content of a file."""
        return read_bytes(self.path / name, MAX_LOADED_BYTES)


def open_files(path: Path) -> ShardFiles:
    """The files of a shard. Raises :class:`DataError` where it is missing or no shard."""
    return ZippedFiles(path) if path.name.endswith(SUFFIX) else FolderFiles(path)


def write_zip(path: Path, files: Mapping[str, bytes]) -> None:
    """Write files into a zip that only stores them; the same files give the same bytes."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
        for name in sorted(files):
            archive.writestr(zipfile.ZipInfo(name, _EPOCH), files[name])
