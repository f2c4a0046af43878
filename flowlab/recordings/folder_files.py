"""The files at or below a path, behind links too: what a recording consists of."""

import os
import stat
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from flowlab.errors import DataError
from flowlab.limits import MAX_FILES
from flowlab.text import natural_key

_OF_DESKTOPS = {"Thumbs.db", "desktop.ini", "__MACOSX", "Icon\r"}
"""What desktops leave in folders that they have shown, or packed."""


@dataclass(frozen=True, slots=True)
class FoundFile:
    """A regular file."""

    path: Path
    name: str
    """Its path below the folder that was looked into, with ``/`` between the parts."""
    size: int
    """[bytes]"""
    changed_s: float
    """When it was last written, or put where it is, by the clock of the file system [s since 1970]."""


def files_below(path: Path) -> Iterator[FoundFile]:
    """Every regular file at or below a path, in natural order; hidden ones are left out.

    Links are followed, but for those into a folder that they lie in: archives keep pictures behind links.

    Args:
        path: A file or a folder.

    Yields:
        The files.

    Raises:
        DataError: A folder cannot be looked into, or there are more files than any recording has.
    """
    for count, found in enumerate(_below(path, "", ()), 1):
        if count > MAX_FILES:
            raise DataError(f"{path}: has more than {MAX_FILES:,} files, expected one recording; name it")
        yield found


def _below(path: Path, name: str, above: tuple[tuple[int, int], ...]) -> Iterator[FoundFile]:
    try:
        about = path.stat()
    except OSError:  # a link that leads nowhere, or a file that has just been deleted
        return
    if stat.S_ISREG(about.st_mode):
        yield FoundFile(path, name or path.name, about.st_size, max(about.st_mtime, about.st_ctime))
    elif stat.S_ISDIR(about.st_mode) and (about.st_dev, about.st_ino) not in above:
        for inner in entries(path):
            inside = (*above, (about.st_dev, about.st_ino))
            yield from _below(path / inner, f"{name}/{inner}" if name else inner, inside)


def no_files_below(path: Path) -> Iterator[tuple[str, str]]:
    """What is below a folder and is neither a regular file nor a folder: its name, and what it is."""
    for parent, folders, names in os.walk(path):
        folders[:] = [name for name in folders if not name.startswith(".")]
        for name in sorted(names, key=natural_key):
            file = Path(parent, name)
            if name.startswith(".") or file.is_file():
                continue
            what = "a link that leads nowhere" if file.is_symlink() and not file.exists() else "no regular file"
            yield file.relative_to(path).as_posix(), what


def entries(folder: Path) -> list[str]:
    """The names of what is in a folder and not hidden, in natural order. Raises :class:`DataError`."""
    try:
        return sorted(
            (n for n in os.listdir(folder) if not n.startswith(".") and n not in _OF_DESKTOPS), key=natural_key
        )
    except OSError as error:
        raise DataError(f"{folder}: cannot be looked into ({error.strerror or error})") from error
