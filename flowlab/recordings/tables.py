"""Tables of numbers in text files, as robots, loggers and spreadsheets write them; columns are told by their names."""

import csv
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from flowlab.array_files import load_array
from flowlab.errors import DataError
from flowlab.text import cut, shown
from flowlab.untrusted import read_text

_COMMENT = re.compile(r"\s*(#|%|//)")
_TIMES = {
    "time", "times", "t", "timestamp", "timestamps", "stamp", "sec", "secs", "second", "seconds", "clock", "epoch",
    "unixtime", "walltime", "rostime", "timesec", "headerstamp", "fieldheaderstamp", "rosbagtimestamp", "elapsed",
}  # fmt: skip
"""What columns of times are called, without their unit, case and signs."""
_COUNTS = {"", "index", "frame", "frames", "seq", "id", "row", "no", "unnamed0", "step", "sample", "fieldheaderseq"}
"""What columns that number the rows are called."""
_UNITS = {
    "s": 1.0, "sec": 1.0, "secs": 1.0, "seconds": 1.0, "ms": 1e-3, "msec": 1e-3, "milliseconds": 1e-3, "millis": 1e-3,
    "us": 1e-6, "µs": 1e-6, "μs": 1e-6, "usec": 1e-6, "microseconds": 1e-6, "ns": 1e-9, "nsec": 1e-9,
    "nanoseconds": 1e-9, "nanos": 1e-9,
}  # fmt: skip
_PARTS = {
    "ns": 1e-9, "nsec": 1e-9, "nsecs": 1e-9, "nanosec": 1e-9, "nanosecs": 1e-9, "nanoseconds": 1e-9, "us": 1e-6,
    "usec": 1e-6, "usecs": 1e-6, "microsec": 1e-6, "microsecs": 1e-6, "microseconds": 1e-6,
}  # fmt: skip
"""What the part below a second is called where it has a column of its own, as in ROS' stamps and in ``timeval``."""
_WHOLE = {"s", "sec", "secs", "seconds"}
_UNIT = re.compile(
    rf"[\s_\[\](){{}}/.:-]+({'|'.join(sorted(_UNITS, key=len, reverse=True))})[\])}}\s]*$", re.IGNORECASE
)
_ROSBAG_NS = 1e17
"""``rostopic echo -p`` writes ``%time`` in nanoseconds since 1970; in any other unit that would be beyond this."""
_LIKE_A_CLOCK = 5
"""So many rows are needed to tell that a column rises evenly."""
_SINCE_1970 = 1e8
"""Numbers beyond this that rise are times since 1970, in whatever unit [s or less]."""


Splitter = Callable[[str], list[str]]
"""Cuts a line into its cells."""


@dataclass(frozen=True, slots=True)
class SampleTable:
    """Rows of numbers."""

    path: Path
    names: tuple[str, ...]
    """Of the columns; empty where the file has none."""
    values: Float64[np.ndarray, "N D"]
    """nan for what is no number in a column of text."""
    text: frozenset[int] = frozenset()
    """Columns that hold text, as a frame's name."""
    integers: bool = False
    """Whether all numbers are written without a fraction."""

    def column(self, name: str) -> int:
        """The place of a column. Raises :class:`DataError` with the names there are."""
        found = [k for k, n in enumerate(self.names) if _plain(n) == _plain(name)]
        exact = [k for k in found if self.names[k] == name] or found
        if len(exact) != 1:
            have = "no names of columns" if not self.names else f"the columns {cut(', '.join(map(repr, self.names)))}"
            raise DataError(f"{self.path}: has {'two columns' if exact else 'no column'} {shown(name)}; it has {have}")
        return exact[0]


@dataclass(frozen=True, slots=True)
class Columns:
    """The columns of a table by what they are."""

    time: Float64[np.ndarray, "N"] | None
    """[s] where the table states its unit, else as it stands there; None where it has no times."""
    unit_known: bool
    names: tuple[str, ...]
    values: Float64[np.ndarray, "N D"]


def read_table(path: Path) -> SampleTable:
    """The table of a text file or a numpy array. Raises :class:`DataError` where it is none."""
    if path.suffix.lower() != ".npy":
        return parse_table(path, read_text(path))
    values = load_array(path)
    if values.dtype.kind not in "biuf":
        raise DataError(f"{path}: holds {cut(str(values.dtype))}, expected numbers")
    values = values[:, None] if values.ndim == 1 else values
    if values.ndim != 2 or not len(values):
        raise DataError(f"{path}: has the shape {cut(str(values.shape))}, expected (rows, numbers)")
    return SampleTable(path, (), values.astype(np.float64), integers=values.dtype.kind in "iu")


def parse_table(path: Path, text: str) -> SampleTable:
    """The table of a text. Raises :class:`DataError` where it is none, or can be read in two ways."""
    lines = [(n, x.strip()) for n, x in enumerate(text.lstrip("\ufeff").splitlines(), 1) if x.strip()]
    first = next((k for k, (_, x) in enumerate(lines) if not _COMMENT.match(x)), len(lines))
    rows = [(n, line) for n, line in lines[first:] if not _COMMENT.match(line)]
    split = _splitter(path, [line for _, line in rows])
    cells = [(n, split(line)) for n, line in rows]
    names: list[str] = []
    if cells and not any(map(_is_number, cells[0][1])):
        names = cells.pop(0)[1]
    elif first and cells:  # names may be in a comment, as in rostopic's '%time,field.x' and TUM's '# timestamp tx ty'
        words = split(_COMMENT.sub("", lines[first - 1][1], count=1).strip())
        names = words if len(words) == len(cells[0][1]) and not any(map(_is_number, words)) else []
        names[:1] = [f"%{names[0]}"] if names and lines[first - 1][1].startswith("%") else names[:1]
    if not cells:
        raise DataError(f"{path}: holds no row of numbers")
    return _numbers(path, names, cells)


def _numbers(path: Path, names: list[str], cells: list[tuple[int, list[str]]]) -> SampleTable:
    """A table of cells; a column that never holds a number is one of text where it has a name."""
    width = len(names) or len(cells[0][1])
    text = {k for k in range(width if names else 0) if not any(len(c) > k and _is_number(c[k]) for _, c in cells)}
    rows = []
    for n, row in cells:
        if len(row) != width or not all(_is_number(x) for k, x in enumerate(row) if k not in text):
            comma = "; its numbers must have a decimal point, and no sign between thousands" * any(
                "," in x for x in row
            )
            raise DataError(f"{path}: line {n} is not {width} numbers: {shown(' '.join(row))}{comma}")
        rows.append([np.nan if k in text else float(x) for k, x in enumerate(row)])
    integers = all(x.lstrip("+-").isdecimal() for _, row in cells for x in row)
    return SampleTable(path, tuple(n.strip() for n in names), np.array(rows, np.float64), frozenset(text), integers)


def _splitter(path: Path, lines: Sequence[str]) -> Splitter:
    """What splits lines into cells, by the sign that separates them."""
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

    found = [x for line in lines for x in cells(line)]
    if sign == ",":
        return _of_commas(path, lines, cells)
    with_comma = [x for x in found if re.fullmatch(r"[+-]?\d*,\d+([eE][+-]?\d+)?", x)]
    if not with_comma:
        return cells
    several = any("." in x and _is_number(x) for x in found)
    if several or all(re.fullmatch(r"[+-]?[1-9]\d{0,2},\d{3}", x) for x in with_comma):
        raise DataError(f"{path}: {shown(with_comma[0])} may have a decimal comma or a sign between thousands; write the "  # noqa: E501
                        "numbers with a decimal point, and no sign between thousands")  # fmt: skip
    return lambda line: [x.replace(",", ".") if re.fullmatch(r"[+-]?\d*,\d+(?:[eE].*)?", x) else x for x in cells(line)]


def _of_commas(path: Path, lines: Sequence[str], cells: Splitter) -> Splitter:
    """What splits lines at commas, where these separate cells and nothing else; else they may be decimal ones."""
    numbers = [line for line in lines if line[:1] in "+-.0123456789"]
    both = [x for x in numbers if re.search(r"\d,\d", x) and re.search(r"\d,?[ \t]+[+-]?\.?\d", x)]
    if both:
        raise DataError(f"{path}: the line {shown(both[0])} has commas within its numbers and space between them: write "  # noqa: E501
                        "the numbers with a decimal point, or separate them by ';'")  # fmt: skip
    return cells


def find_columns(
    table: SampleTable, name: str, chosen: Sequence[str] | None, color_s: np.ndarray, timed: bool
) -> Columns:
    """The times of a table and the numbers that are the state, or the action.

    Args:
        table: The table.
        name: ``state`` or ``action``, for messages.
        chosen: Names of the columns to take, in this order; None for all that are not times.
        color_s: Times of the color pictures.
        timed: Whether the rows have their times in another file.

    Raises:
        DataError: Columns that are chosen do not exist, or it is not clear which are meant.
    """
    pair = _whole_and_part(table)
    times = [k for k, n in enumerate(table.names) if base_and_unit(n)[0] in _TIMES]
    times = [*pair[:1], *(k for k in times if k not in pair)]
    rest = [k for k in range(table.values.shape[1]) if k not in times[:1] and k not in pair]
    if chosen is not None:
        rest = [table.column(n) for n in chosen]
    if chosen is None or table.text & set(rest):
        _check_meaning(table, name, rest, times, color_s, timed)
    names = tuple(table.names[k] for k in rest) if table.names else ()
    time, known = None, False
    if pair:
        whole, part = pair
        known, time = True, table.values[:, whole] + table.values[:, part] * _PARTS[_last_word(table.names[part])[1]]
    elif times:
        scale = _scale(table, times[0])
        known, time = scale is not None, table.values[:, times[0]] * (1.0 if scale is None else scale)
    return Columns(time, known, names, table.values[:, rest])


def _whole_and_part(table: SampleTable) -> tuple[int, ...]:
    """The columns of the whole seconds of a time and of the part below a second; empty where there are none.

    They are called the same but for their last word, and no part is a second or more.
    """
    words = [_last_word(name) for name in table.names]
    for part, (start, word) in enumerate(words):
        if word not in _PARTS:
            continue
        whole = [k for k, (other, w) in enumerate(words) if w in _WHOLE and other == start]
        numbers = table.values[:, [*whole[:1], part]]
        if len(whole) == 1 and (numbers % 1 == 0).all() and (numbers[:, 1] // (1 / _PARTS[word]) == 0).all():
            return whole[0], part
    return ()


def _last_word(name: str) -> tuple[str, str]:
    """The last word of a name, and what comes before it, in small letters."""
    start, word = re.fullmatch(r"(.*?)([a-z]*)[^a-z]*", name.lower(), re.DOTALL).groups()  # type: ignore[union-attr]
    return start, word


def _check_meaning(
    table: SampleTable, name: str, rest: Sequence[int], times: Sequence[int], color_s: np.ndarray, timed: bool
) -> None:
    """Refuse columns that are no numbers of a robot, or may be none, with what to write."""
    doubtful = dict.fromkeys(times[1:], "is a time, too")
    doubtful |= {k: "is a part of a time" for k in rest if table.names and _plain(table.names[k]) in _PARTS}
    doubtful |= {k: "holds text" for k in rest if k in table.text}
    doubtful |= {k: "counts the rows" for k in rest if table.names and _plain(table.names[k]) in _COUNTS
                 and _rises(table.values[:, k])}  # fmt: skip
    if not times and not timed and not table.names and _is_clock(table, color_s):
        doubtful[0] = "rises like a clock"
    doubtful = {k: why for k, why in doubtful.items() if k in rest}
    if not doubtful:
        return
    k, why = next(iter(doubtful.items()))
    called = repr(table.names[k]) if table.names else f"{k + 1}"
    if table.names:
        some = [n for i, n in enumerate(table.names) if i in rest and i not in doubtful]
        advice = f"name those of the {name}, in order: '{name}_columns: [{', '.join(map(repr, some))}]'"
    else:
        advice = (
            f"if it is the time, give the columns names in a first line, the first 'time [s]', or the times a file of "
            f"their own with '{name}_times'; if it is a number of the {name}, name the columns, too"
        )
        if table.path.suffix.lower() == ".npy":
            advice = (
                f"if it is the time, write it into a file of its own, named as '{name}_times', and the rest without it; "  # noqa: E501
                f"if it is a number of the {name}, write the array as a table (.csv) with a line of names"
            )
    raise DataError(f"{table.path}: column {cut(called)} {why}; {cut(advice, 600)}")


def _scale(table: SampleTable, k: int) -> float | None:
    """Seconds in the unit of a column of times; None where nothing says which it is."""
    base, unit = base_and_unit(table.names[k])
    rosbag = table.names[k].startswith("%") or base in ("fieldheaderstamp", "rosbagtimestamp")
    if unit is None and rosbag and np.nanmin(table.values[:, k]) > _ROSBAG_NS:
        return 1e-9
    return unit


def base_and_unit(name: str) -> tuple[str, float | None]:
    """What a column is called without its unit and signs, and the unit [s] that its name states, if it does."""
    found = _UNIT.search(name)
    return _plain(name[: found.start()] if found else name), _UNITS[found[1].lower()] if found else None


def _plain(name: str) -> str:
    """A name of a column by its letters and digits."""
    return re.sub(r"[^a-z0-9]", "", name.lower())


def _rises(values: np.ndarray) -> bool:
    return bool(len(values) > 1 and (np.diff(values) > 0).all())


def _is_clock(table: SampleTable, color_s: np.ndarray) -> bool:
    """Whether the first column of a table without names may be times."""
    first = table.values[:, 0]
    if table.values.shape[1] < 2 or len(first) < _LIKE_A_CLOCK or not _rises(first):
        return False
    span, steps = first[-1] - first[0], np.diff(first)
    even = (np.abs(steps - np.median(steps)) < 0.2 * np.median(steps)).all()
    like_color = len(color_s) > 1 and abs(span - (color_s[-1] - color_s[0])) < 0.02 * abs(span)
    return bool(first[0] > _SINCE_1970 or (even and (like_color or table.path.suffix.lower() != ".npy")))


def _is_number(text: str) -> bool:
    """Whether a text is a number; Python's ``1_000`` is none."""
    try:
        float(text)
    except ValueError:
        return False
    return "_" not in text
