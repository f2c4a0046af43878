"""Files that are either there and whole, or not there."""

import fcntl
import json
import os
import shutil
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from flowlab.errors import DataError, FlowlabError, MissingFileError


def temporary_path(path: Path) -> Path:
    """Where this process makes what will be renamed to ``path``."""
    return path.with_name(f"{_prefix()}{os.getpid()}+{path.name}")


def remove_leftovers(folder: Path) -> None:
    """Delete what processes of this machine that no longer run were making in a folder."""
    for leftover in folder.glob(f"{_prefix()}*"):
        if is_running(int(leftover.name.removeprefix(_prefix()).partition("+")[0])):
            continue
        if leftover.is_dir():
            shutil.rmtree(leftover, ignore_errors=True)
        else:
            leftover.unlink(missing_ok=True)


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """Make a folder that is there whole or not at all.

    Gives an empty folder beside it to fill, which takes its name in the end, or is deleted if anything is raised.
    What processes that no longer run were making beside it is deleted first.

    Raises:
        DataError: It cannot be written.
    """
    temporary = temporary_path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        remove_leftovers(path.parent)
        temporary.mkdir()
        yield temporary
        os.rename(temporary, path)
    except FlowlabError:  # that a file to be read is missing is an OSError, too
        raise
    except OSError as error:
        raise DataError(f"{path}: cannot be written ({error.strerror or error}); choose another place") from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _prefix() -> str:
    return f".tmp-{socket.gethostname()}+"  # no machine's name has a plus sign


def is_running(pid: int) -> bool:
    """Whether a process of this machine runs."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
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


def write_atomically(path: Path, text: str) -> None:
    """Replace a file in one step."""
    temporary = temporary_path(path)
    try:
        temporary.write_text(text)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_json(path: Path, values: Any) -> None:
    """Replace a JSON file in one step; the same values give the same bytes."""
    write_atomically(path, json.dumps(values, indent=1) + "\n")


def read_json(path: Path) -> Any:
    """The values of a JSON file."""
    try:
        return json.loads(path.read_text())
    except FileNotFoundError as error:
        raise MissingFileError(f"{path}: there is no such file") from error
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: not valid JSON ({error}); restore it or extract again into a new folder") from error
