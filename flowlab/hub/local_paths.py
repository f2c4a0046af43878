"""What tells of the machine that something was made on: paths are cut to their last name before anybody gets them."""

import getpass
import os
import re
import socket
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from functools import cache
from pathlib import PureWindowsPath
from typing import Any

from flowlab.text import cut

_ROOTS = ("home", "Users", "root", "tmp", "mnt", "media", "var", "opt", "srv", "scratch", "Volumes", "private")
_HOMES = ("home", "Users")
_KNOWN = {"source", "films", "labeled", "dataset"}
"""Keys whose values are paths and nothing else."""
_ABSOLUTE = re.compile(r"/|~|\.\.[\\/]|[A-Za-z]:[\\/]|\\\\|file:")
_NOBODY = {"root", "user", "localhost"}
_SHORTEST = 3
"""Letters of a user's or machine's name that can be told from a word."""
_HIDDEN = "(a local path)"


@cache
def _local() -> re.Pattern[str]:
    """Absolute paths in text: below folders that machines have; not the topics of a robot, which look alike."""
    roots = "|".join(map(re.escape, sorted({*_ROOTS, *os.listdir("/")})))
    start = rf"(?:file://)?/(?:{roots})(?=/)|~[\w-]*(?=/)|[A-Za-z]:(?=[\\/])|\\\\(?=\w)|\.\.(?=/)"
    return re.compile(rf"(?<![\w/.:~-])(?:{start})[^\s'\"<>|,;:()\[\]{{}}]*")


def _last_name(path: str) -> str:
    """The last name of a path; nothing of one that is hardly more than somebody's home."""
    parts = PureWindowsPath(path.removeprefix("file://")).parts  # takes both kinds of separators
    least = 2 if parts[0][0] in "~." else 4 if parts[1] in _HOMES else 3
    return parts[-1] if len(parts) >= least else _HIDDEN


def without_local_paths(values: Any, where: str = "") -> tuple[Any, list[str]]:
    """JSON values, called ``where``, in which local paths are cut to their last names; and the places of these."""
    found: dict[str, None] = {}

    def clean(value: Any, key: str, place: str) -> Any:
        if not isinstance(value, str):
            return value
        if key in _KNOWN and _ABSOLUTE.match(value):  # a name in it may have spaces
            new = ", ".join(PureWindowsPath(path).name for path in value.split(", "))
        else:
            new = _local().sub(lambda path: _last_name(path[0]), value)
        if new != value:
            found[place] = None
        return new

    return _mapped(values, clean, "", where), list(found)


def _mapped(values: Any, change: Callable[[Any, str, str], Any], key: str, place: str) -> Any:
    """Nested values with every plain one changed; it is told the key it stands under, and its place."""
    if isinstance(values, Mapping):
        return {k: _mapped(v, change, str(k), f"{place}.{k}".strip(".")) for k, v in values.items()}
    if isinstance(values, list | tuple):
        return [_mapped(v, change, key, place) for v in values]
    return change(values, key, place)


def names_of_this_machine() -> Iterator[str]:
    """The user's name and the machine's, as far as they could be told in a text from other words."""
    names = [socket.gethostname()]
    with suppress(OSError, KeyError):  # nobody has a name in some containers
        names.append(getpass.getuser())
    yield from (name for name in names if len(name) >= _SHORTEST and name.lower() not in _NOBODY)


def told_names(text: str) -> list[str]:
    """Names of the user and the machine that stand in a text."""
    return [cut(n) for n in names_of_this_machine() if re.search(rf"(?<!\w){re.escape(n)}(?!\w)", text)]
