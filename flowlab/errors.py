"""Every error a user may meet: one clear sentence, and the exit code it ends the program with."""

import difflib
from collections.abc import Iterable

from flowlab.limits import MAX_SHOWN
from flowlab.text import cut, printable, shown

_LONGEST = 8_000
"""Characters of a message: whatever was found, its end stays on the screen."""


class FlowlabError(Exception):
    """Something the user can mend. The message says what was found, what was expected, what to type."""

    exit_code = 1

    def __init__(self, message: str) -> None:
        text = printable(message[: 4 * _LONGEST])
        super().__init__(text if len(text) <= _LONGEST else f"{text[: _LONGEST // 2]} [...] {text[-_LONGEST // 2 :]}")


class UsageError(FlowlabError):
    """A name, an option or a recipe that does not exist or does not fit."""

    exit_code = 2


class DataError(FlowlabError):
    """Data that are missing, half written, damaged, made with other settings, or that do not fit what they are for."""

    exit_code = 3


class MissingFileError(DataError, FileNotFoundError):
    """A file or folder that does not exist."""


class RecordError(DataError, ValueError):
    """A value that does not fit the record it was given to, such as a depth picture in millimeters."""


class UnfinishedError(FlowlabError):
    """Some work units could not be done; what was done is whole, and the same command does the rest."""

    exit_code = 4


class MissingLibraryError(FlowlabError):
    """An optional library (OpenGL, say) that the chosen settings need and this machine lacks."""


def unknown_name(kind: str, found: str, known: Iterable[str]) -> UsageError:
    """An error for a name that does not exist: near misses first, else everything that does exist."""
    names = sorted(known)
    near = difflib.get_close_matches(found[:MAX_SHOWN], names, n=3, cutoff=0.6)
    hint = f"did you mean {' or '.join(near)}?" if near else f"there are: {', '.join(names)}"
    return UsageError(f"no {kind} is called {shown(found)}; {hint}")


def first_line(error: BaseException) -> str:
    """The first line of what an error says, or its name where it says nothing."""
    return cut(str(error).strip().split("\n")[0]) or type(error).__name__
