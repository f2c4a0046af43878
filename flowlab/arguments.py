"""Arguments as people give them to Python functions: what fits is brought into one form, what does not is one sentence.

The command line has its own checks of what is typed; these are the same limits for those who call a function.
"""

import math
import os
import re
from collections.abc import Iterable, Mapping
from numbers import Integral, Real
from pathlib import Path
from typing import Any

from flowlab.errors import UsageError
from flowlab.text import cut

_RANGE = re.compile(r"\s*(-?\d{0,18})\s*(:?)\s*(-?\d{0,18})\s*", re.ASCII)
_MOST_NUMBERS = 10_000_000
SETTINGS_FORM = "a list of strings, as in settings=['observer.points=512']"


def check_settings(value: Any, name: str = "settings", form: str = SETTINGS_FORM) -> tuple[str, ...]:
    """Strings, of which one alone is no list: it would be taken letter by letter.

    Args:
        value: What was given.
        name: Of the argument.
        form: What it should be, in words.

    Returns:
        The strings.

    Raises:
        UsageError: They are no strings, or one alone, or a mapping.
    """
    if (listed := _listed(value, str)) is None:
        raise _wrong(name, value, form)
    return listed


def check_names(value: Any, name: str) -> tuple[str, ...]:
    """Names, or one of them. Raises :class:`UsageError` for anything else."""
    if isinstance(value, str):
        return (value,)
    if (listed := _listed(value, str)) is None:
        raise _wrong(name, value, "a name or a list of names")
    return listed


def check_paths(value: Any, name: str) -> tuple[Path, ...]:
    """Paths, or one of them. Raises :class:`UsageError` for anything else."""
    if isinstance(value, str | os.PathLike):
        return (Path(value),)
    if (listed := _listed(value, str | os.PathLike)) is None:
        raise _wrong(name, value, "a path or a list of paths")
    return tuple(map(Path, listed))


def check_path(value: Any, name: str) -> Path:
    """One path. Raises :class:`UsageError` for anything else."""
    if not isinstance(value, str | os.PathLike):
        raise _wrong(name, value, "a path")
    return Path(value)


def check_count(value: Any, name: str, least: int | None = 1) -> int:
    """A whole number, not less than a limit.

    Args:
        value: What was given.
        name: Of the argument.
        least: The limit; None where there is none here.

    Returns:
        The number.

    Raises:
        UsageError: It is none, or less.
    """
    if isinstance(value, bool) or not isinstance(value, Integral) or (least is not None and value < least):
        raise _wrong(name, value, "a whole number" if least is None else f"a whole number from {least} on")
    return int(value)


def check_optional_count(value: Any, name: str, least: int = 1) -> int | None:
    """The same, or None."""
    return None if value is None else check_count(value, name, least)


def check_optional_name(value: Any, name: str) -> str | None:
    """A name, or None. Raises :class:`UsageError` for anything else."""
    if value is not None and not (isinstance(value, str) and value):
        raise _wrong(name, value, "a name")
    return value


def check_size(value: Any, name: str) -> tuple[int, int] | None:
    """A width and a height, or None. Raises :class:`UsageError` for anything else."""
    if value is None:
        return None
    if (listed := _listed(value, Integral)) is None or len(listed) != 2:
        raise _wrong(name, value, f"a width and a height, as in {name}=(320, 240)")
    return check_count(listed[0], name), check_count(listed[1], name)


def check_counts(value: Any, name: str, least: int | None = 0) -> tuple[int, ...]:
    """Whole numbers, or one of them. Raises :class:`UsageError` for anything else."""
    if isinstance(value, Integral):
        return (check_count(value, name, least),)
    if (listed := _listed(value, Integral)) is None:
        raise _wrong(name, value, f"a whole number or a list of them, as in {name}=(0, 1, 2)")
    return tuple(check_count(v, name, least) for v in listed)


def check_numbers(value: Any, name: str, form: str) -> tuple[float, ...]:
    """Numbers, in a list. Raises :class:`UsageError`, with the ``form`` in words, for anything else."""
    if (listed := _listed(value, Real)) is None or any(isinstance(v, bool) for v in listed):
        raise _wrong(name, value, form)
    return tuple(map(float, listed))


def check_minutes(value: Any, name: str = "minutes") -> float | None:
    """A time above 0, or None. Raises :class:`UsageError` for anything else."""
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, Real) or not 0 < float(value) < math.inf:
        raise _wrong(name, value, "a number above 0, or None")
    return float(value)


def parse_numbers(text: str, name: str, count: int | None = None) -> list[int]:
    """Whole numbers of a list with commas: numbers, and ranges as in a slice, whose end is not in it.

    Where it is told how many there are, a range may lack an end, and negative numbers count from there. Raises
    :class:`UsageError` for anything else, and for what is beyond ``count``.
    """
    found: list[int] = []
    for part in text.split(","):
        found += _range(part, name, count)
        if len(found) > _MOST_NUMBERS:
            raise UsageError(f"{name}: {cut(part)} is more than {_MOST_NUMBERS:,} numbers")
    return found


def _range(text: str, name: str, count: int | None) -> range:
    """The numbers that ``3``, ``0:50``, ``50:`` or ``-10:`` mean."""
    match = _RANGE.fullmatch(text)
    first, colon, last = match.groups() if match else ("", "", "")
    endless = count is None and (first.startswith("-") or bool(colon and not last) or last.startswith("-"))
    if (not colon and not first) or "-" in (first, last) or (last and not colon) or endless:
        raise UsageError(f"{name}: found {cut(repr(text))}, expected numbers or ranges from 0, as in 0:50,70")
    start = position(int(first), count, name) if first else 0
    if not colon:
        return range(start, start + 1)
    end = int(last) if last else count or 0
    stop = end + (count or 0) if end < 0 else end
    if stop <= start or (count is not None and stop > count):
        beyond = "" if count is None else f" or ends beyond the {count} that there are, counted from 0"
        raise UsageError(f"{name}: {cut(text)} is empty{beyond}")
    return range(start, min(stop, start + _MOST_NUMBERS + 1))


def position(number: int, count: int | None, name: str) -> int:
    """A position among ``count``, from 0, where -1 is the last. Raises :class:`UsageError` where there is none."""
    if count is None:
        return number
    if not -count <= number < count:
        one = name.removesuffix("s")
        raise UsageError(f"{name}: there is no {one} {number}; there are {count} to choose from, counted from 0")
    return number % count


def _listed(value: Any, kind: Any) -> tuple[Any, ...] | None:
    """What can be gone through as a list; None where it cannot, or not all in it is of a kind."""
    if isinstance(value, str | bytes | Mapping) or not isinstance(value, Iterable):
        return None
    values = tuple(value)
    return values if all(isinstance(v, kind) for v in values) else None


def _wrong(name: str, found: Any, expected: str) -> UsageError:
    shown = repr(found)
    return UsageError(f"{name}: must be {expected}; found {shown if len(shown) <= 60 else type(found).__name__}")
