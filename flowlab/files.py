"""Files that are either there and whole, or not there; also after a kill, a full disk or a power cut."""

import fcntl
import json
import os
import shutil
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from flowlab.errors import DataError, FlowlabError


def temporary_path(path: Path) -> Path:
    """Where this process makes what will be renamed to ``path``."""
    return path.with_name(f"{_prefix()}{os.getpid()}+{path.name}")


def remove_leftovers(folder: Path) -> None:
    """Delete what processes of this machine that no longer run were making in a folder, which is no link itself."""
    if folder.is_symlink():
        return
    for leftover in folder.glob(f"{_prefix()}*"):
        pid = leftover.name.removeprefix(_prefix()).partition("+")[0]
        if not (pid.isascii() and pid.isdecimal()) or is_running(int(pid)):
            continue
        _remove(leftover)


def _remove(path: Path) -> None:
    """Delete a file, a folder, or a link and not what it leads to, as far as this is possible."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink(missing_ok=True)


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """Make a folder that is there whole or not at all.

    Gives an empty folder beside it to fill, which takes its name in the end, or is deleted if anything is raised.
    What processes that no longer run were making beside it is deleted first.

    Raises:
        DataError: It cannot be written.
    """
    temporary = temporary_path(path)
    with told_when_unwritable(path):
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            remove_leftovers(path.parent)
            _remove(temporary)
            temporary.mkdir()
            yield temporary
            sync_tree(temporary)
            os.rename(temporary, path)
            sync_folder(path.parent)
        finally:
            _remove(temporary)


@contextmanager
def new_file(path: Path) -> Iterator[Path]:
    """Make a file that is there whole or not at all, or replace one in one step.

    Gives the path of a file beside it to write, which takes its name in the end, or is deleted if anything is raised.
    A power cut leaves the old one or the new one, since the content is on the disk before the name is.

    Raises:
        OSError: It cannot be written.
    """
    temporary = temporary_path(path)
    _remove(temporary)
    os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))  # a new file, and no link to another
    try:
        yield temporary
        _sync(temporary)
        os.replace(temporary, path)
        sync_folder(path.parent)
    finally:
        _remove(temporary)


@contextmanager
def new_file_alone(path: Path) -> Iterator[Path]:
    """:func:`new_file` for a writer that makes files of its own beside what it is told to write.

    These lie in a folder beside it, which is deleted with whatever is left in it.

    Raises:
        OSError: It cannot be written.
    """
    folder = temporary_path(path)
    _remove(folder)
    folder.mkdir()
    try:
        temporary = folder / path.name
        temporary.touch(0o666)
        usual = temporary.stat().st_mode
        yield temporary
        temporary.chmod(usual)  # such writers let nobody else read what they make
        _sync(temporary)
        os.replace(temporary, path)
        sync_folder(path.parent)
    finally:
        _remove(folder)


@contextmanager
def output_file(path: Path) -> Iterator[Path]:
    """:func:`new_file` where a user asked for it, in a folder that need not exist; leftovers beside it are deleted.

    Raises:
        DataError: It cannot be written.
    """
    with told_when_unwritable(path, "choose another file or make room"):
        path.parent.mkdir(parents=True, exist_ok=True)
        remove_leftovers(path.parent)
        with new_file(path) as temporary:
            yield temporary


@contextmanager
def told_when_unwritable(path: Path, advice: str = "choose another place") -> Iterator[None]:
    """Turns a failure to write a file or folder into a sentence."""
    try:
        yield
    except FlowlabError:  # that a file to be read is missing is an OSError, too
        raise
    except OSError as error:
        raise DataError(f"{path}: cannot be written ({error.strerror or error}); {advice}") from error


def check_inside(folder: Path, path: Path) -> None:
    """Refuse to write below ``folder`` where a link, which a stranger may have made, leads out of it.

    Raises:
        DataError: ``path`` is somewhere else.
    """
    real = Path(os.path.realpath(path))  # which is told of a circle of links, too, where Path.resolve fails
    if not real.is_relative_to(os.path.realpath(folder)):
        raise DataError(f"{path}: is a link that leads out of {folder}, expected a folder; nothing is written there")


def sync_folder(folder: Path) -> None:
    """Have the names in a folder on the disk, as far as its file system can."""
    with suppress(OSError):
        _sync(folder)


def sync_tree(folder: Path) -> None:
    """Have a folder and everything below it on the disk."""
    for parent, _, names in os.walk(folder):
        for name in names:
            _sync(Path(parent, name))
        sync_folder(Path(parent))


def _sync(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _prefix() -> str:
    return f".tmp-{socket.gethostname()}+"  # no machine's name has a plus sign


def is_running(pid: int) -> bool:
    """Whether a process of this machine runs."""
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        return True
    return True


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Alone with a folder, as far as its file system has locks; whoever else asks for it waits."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        with suppress(OSError):
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


def write_atomically(path: Path, text: str | bytes) -> None:
    """Replace a file in one step. Raises :class:`OSError`."""
    with new_file(path) as temporary:
        temporary.write_bytes(text.encode() if isinstance(text, str) else text)


def write_json(path: Path, values: Any) -> None:
    """Replace a JSON file in one step; the same values give the same bytes. Raises :class:`OSError`."""
    write_atomically(path, json.dumps(values, indent=1) + "\n")
