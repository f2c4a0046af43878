"""What the checks of every family share."""

import hashlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def require(holds: object, message: str) -> None:
    """Raise an AssertionError with a message that says what is promised, where that does not hold."""
    if not holds:
        raise AssertionError(message)


def require_words(thing: object, *fields: str) -> None:
    """Require that fields of a plug-in are some words."""
    for field in fields:
        value = getattr(thing, field, None)
        require(isinstance(value, str) and value, f"{field} must be some words, but is {value!r}")


def content(folder: Path) -> dict[str, str]:
    """What lies below a folder, or the one file, by its relative path: a digest, where a link leads, or ``folder``."""
    paths = [folder] if not folder.is_dir() else [folder, *sorted(folder.rglob("*"))]
    return {path.relative_to(folder).as_posix(): _digest(path) for path in paths}


@contextmanager
def elsewhere(folder: Path) -> Iterator[None]:
    """Run with a folder as the current one."""
    before = os.getcwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)


def _digest(path: Path) -> str:
    """What tells the content of a file from that of others."""
    if path.is_symlink():
        return f"to {path.readlink()}"
    if path.is_dir():
        return "folder"
    return hashlib.sha256(path.read_bytes()).hexdigest()
