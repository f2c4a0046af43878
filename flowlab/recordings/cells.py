"""Lines of a table cut into cells, where it is clear which signs stand between and which within these."""

import csv
import re
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from flowlab.errors import DataError
from flowlab.text import shown

Splitter = Callable[[str], list[str]]
"""Cuts a line into its cells."""

POINT = "write the numbers with a decimal point, and no sign between thousands"
_WITH_COMMA = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?")
_GROUPED = re.compile(r"[+-]?(\d{1,3}([.,' ]\d{3})+([.,]\d+)?|\d*,\d+)")
"""Numbers that have a sign between thousands, or a decimal comma."""
_DATE = re.compile(r"\d{1,4}[-/.]\d{1,2}[-/.]\d{1,4}|\d:\d\d")
_WRAPS = 2
"""So many times a fraction must begin anew where its whole number changes, to be known for one."""


def is_number(text: str) -> bool:
    """Whether a text is a number; Python's ``1_000`` is none."""
    try:
        float(text)
    except ValueError:
        return False
    return "_" not in text


def is_grouped(text: str) -> bool:
    """Whether a text is a number but for a decimal comma or signs between thousands."""
    return not is_number(text) and _GROUPED.fullmatch(text.strip()) is not None


def find_splitter(path: Path, lines: Sequence[str]) -> Splitter:
    """What splits lines into cells, by the sign that separates them.

    Args:
        path: The table, for messages.
        lines: Its lines, that of the names included.

    Raises:
        DataError: They can be read in two ways; the message says how to write them.
    """
    sign = next((s for s in ";\t," if any(s in line for line in lines[:2])), None)
    if sign is None:
        return lambda line: [x.strip('"') for x in line.split()]
    ended = all(line.rstrip().endswith(sign) for line in lines)

    def cells(line: str) -> list[str]:
        try:
            row = [x.strip() for x in next(csv.reader([line], delimiter=sign, skipinitialspace=True))]
        except (csv.Error, StopIteration) as error:
            raise DataError(f"{path}: holds the line {shown(line)}, which is none of a table") from error
        return row[:-1] if ended and row and not row[-1] else row

    if sign == ",":
        _check_commas(path, lines, [cells(line) for line in lines])
        return cells
    found = [x for line in lines for x in cells(line)]
    with_comma = [x for x in found if _WITH_COMMA.fullmatch(x)]
    if not with_comma:
        return cells
    several = any("." in x and is_number(x) for x in found)
    if several or all(re.fullmatch(r"[+-]?[1-9]\d{0,2},\d{3}", x) for x in with_comma):
        raise DataError(f"{path}: {shown(with_comma[0])} may have a decimal comma or a sign between thousands; {POINT}")
    return lambda line: [x.replace(",", ".") if _WITH_COMMA.fullmatch(x) else x for x in cells(line)]


def _check_commas(path: Path, lines: Sequence[str], rows: Sequence[list[str]]) -> None:
    """Refuse lines whose commas may be decimal ones, for these separate cells, too."""
    numbers = [line for line in lines if line[:1] in "+-.0123456789" and not _DATE.search(line)]
    both = [x for x in numbers if re.search(r"\d,\d", x) and re.search(r"\d,?[ \t]+[+-]?\.?\d", x)]
    if both:
        raise DataError(f"{path}: the line {shown(both[0])} has commas within its numbers and space between them: write "  # noqa: E501
                        "the numbers with a decimal point, or separate them by ';'")  # fmt: skip
    integers = [row for row in rows if all(re.fullmatch(r"[+-]?\d+", x) for x in row)]
    named = [row for row in rows if not any(map(is_number, row))]
    halves = [row for row in rows if _has_exponents(row)]
    if not halves:
        if not integers or len(integers) + len(named) < len(rows) or not _are_halves(integers):
            return
        halves = integers
    if any(len(row) == len(halves[0]) for row in named):  # every cell has a name
        return
    whole, part = next((row for row in halves if not row[1].isdecimal() or int(row[1])), halves[0])[:2]
    raise DataError(f"{path}: the cells {whole} and {part} may be one number, {whole}.{part}, with a decimal comma: every "  # noqa: E501
                    "second cell is written as what follows one; write the numbers with a decimal point, or separate "
                    "them by ';'")  # fmt: skip


def _has_exponents(row: Sequence[str]) -> bool:
    """Whether exponents stand behind every second cell alone, as in ``1,25e-1``: no one writes 25e-1 for 2.5."""
    parts = re.compile(r"\d+([eE][+-]?\d+)?")
    return (
        all(re.fullmatch(r"[+-]?\d+", x) for x in row[::2])
        and all(parts.fullmatch(x) for x in row[1::2])
        and any(not x.isdecimal() for x in row[1::2])
    )


def _are_halves(rows: Sequence[list[str]]) -> bool:
    """Whether every second cell is what stands after a decimal comma, by its zeros or by when it begins anew."""
    width = len(rows[0])
    if width % 2 or any(len(row) != width for row in rows):
        return False
    wholes, parts = ([row[k::2] for row in rows] for k in (0, 1))
    digits = [{len(row[k]) if row[k].isdecimal() else 0 for row in parts} for k in range(width // 2)]
    if any(re.fullmatch(r"[+-]?0\d+", x) for row in wholes for x in row) or any(d == {0} for d in digits):
        return False
    if any(re.fullmatch(r"0\d+", x) for row in parts for x in row) or any(x == "-0" for row in wholes for x in row):
        return all(x.isdecimal() for row in parts for x in row)
    return all(len(d) == 1 and 0 not in d for d in digits) and _begin_anew(wholes, parts)


def _begin_anew(wholes: Sequence[list[str]], parts: Sequence[list[str]]) -> bool:
    """Whether fractions begin anew just where their whole numbers change."""
    whole, part = np.array(wholes, np.float64), np.array(parts, np.float64)
    span = 10.0 ** np.array([len(x) for x in parts[0]])
    anew, changed = np.abs(np.diff(part, axis=0)) > span / 2, np.diff(whole, axis=0) != 0
    return bool(anew.sum() >= _WRAPS and (anew == changed).all())
