"""The columns of a table by what they are, times or numbers of a robot; what may be either is asked for."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import PurePath
from types import MappingProxyType

import numpy as np
from jaxtyping import Float64

from flowlab.errors import DataError
from flowlab.recordings.clock_numbers import find_clocks
from flowlab.recordings.tables import SampleTable, plain_name
from flowlab.text import cut

_TIMES = {
    "time", "times", "t", "timestamp", "timestamps", "stamp", "sec", "secs", "second", "seconds", "clock", "epoch",
    "unixtime", "walltime", "rostime", "timesec", "headerstamp", "fieldheaderstamp", "rosbagtimestamp", "elapsed",
}  # fmt: skip
"""What columns of times are called, without their unit, case and signs."""
_COUNTS = {
    "", "index", "idx", "frame", "frames", "seq", "id", "row", "no", "nr", "unnamed0", "step", "sample",
    "fieldheaderseq", "counter", "count", "cnt", "number", "num", "n",
}  # fmt: skip
"""What columns that number the rows are called."""
_FRAMES = {"frame", "frames", "framenumber", "frameno", "frameid", "frameindex", "frameidx", "framecount"}
_FRAMES |= {
    f"{what}{word}" for what in ("image", "img", "picture") for word in ("", "number", "no", "nr", "id", "idx", "index")
}
"""What columns with the numbers of the pictures' frames are called."""
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


@dataclass(frozen=True, slots=True)
class Columns:
    """The columns of a table by what they are."""

    time: Float64[np.ndarray, "N"] | None
    """[s] where the table states its unit, else as it stands there; None where it has no times."""
    unit_known: bool
    names: tuple[str, ...]
    values: Float64[np.ndarray, "N D"]
    are_frames: bool = False
    """Whether the times are numbers of frames, those of the pictures."""
    are_stamps: bool = False
    """Whether the times are the stamps of the pictures that the rows name."""


def find_columns(
    table: SampleTable,
    name: str,
    chosen: Sequence[str] | None,
    color_s: np.ndarray,
    timed: bool,
    numbered: bool = False,
    pictures: Mapping[str, float] = MappingProxyType({}),
) -> Columns:
    """The times of a table and the numbers that are the state, or the action.

    Args:
        table: The table.
        name: ``state`` or ``action``, for messages.
        chosen: Names of the columns to take, in this order; None for all that are not times.
        color_s: Times of the color pictures.
        timed: Whether the rows have their times in another file.
        numbered: Whether the pictures' names number frames, so that rows may have the numbers of theirs.
        pictures: Stamps of the color pictures by the names of their files, so that rows may name theirs.

    Raises:
        DataError: Columns that are chosen do not exist, or it is not clear which are meant.
    """
    pair = _whole_and_part(table)
    times = [k for k, n in enumerate(table.names) if base_and_unit(n)[0] in _TIMES]
    times = [*pair[:1], *(k for k in times if k not in pair)]
    files = [] if timed else [k for k, cells in table.words.items() if {file_stem(c) for c in cells} <= pictures.keys()]
    frames = _frame_numbers(table) if numbered and not (times or timed or files) else []
    rest = [
        k for k in range(table.values.shape[1]) if k not in (*times[: None if files else 1], *pair, *frames, *files)
    ]
    if chosen is not None:
        rest = [table.column(n) for n in chosen]
    time, known = _own_time(table, pair, times or frames)
    if files:
        time, known = np.array([pictures[file_stem(cell)] for cell in table.words[files[0]]]), False
    if chosen is None or table.text & set(rest):
        rows_s = time if known else color_s if len(color_s) == len(table.values) and not (timed or times) else None
        doubts = _doubts(table, rest, times, color_s, timed)
        found = find_clocks(table.values[:, rest], [table.names[k] for k in rest] if table.names else (), rows_s)
        doubts = {rest[c.place]: c.why for c in found if c.certain} | doubts
        _check_meaning(table, name, rest, doubts, numbered)
    names = tuple(table.names[k] for k in rest) if table.names else ()
    columns = Columns(time, known, names, table.values[:, rest], bool(frames), bool(files))
    return _in_order(table, (*files, *frames)[0], columns) if files or frames else columns


def _in_order(table: SampleTable, column: int, found: Columns) -> Columns:
    """The rows in the order of their pictures. Raises :class:`DataError` where two are of one."""
    assert found.time is not None
    order = np.argsort(found.time, kind="stable")
    time = found.time[order]
    if len(time) > 1 and (twice := np.flatnonzero(np.diff(time) == 0)).size:
        first, second = (int(order[twice[0] + k]) + 1 for k in (0, 1))
        says = f"column {cut(repr(table.names[column]))} names one picture in the rows {first} and {second}"
        raise DataError(f"{table.path}: {says}, expected one row for each")
    return replace(found, time=time, values=found.values[order])


def file_stem(name: str) -> str:
    """The name of a picture's file without its folders and its ending."""
    return PurePath(name.replace("\\", "/")).stem


def _frame_numbers(table: SampleTable) -> list[int]:
    """The column with the number of each row's frame; none where there is none, or several may be it."""
    called = [k for k, n in enumerate(table.names) if plain_name(n) in _FRAMES]
    columns = table.values[:, called]
    return called if len(called) == 1 and (columns % 1 == 0).all() else []


def _own_time(table: SampleTable, pair: Sequence[int], times: Sequence[int]) -> tuple[np.ndarray | None, bool]:
    """The times of the rows that a table has, and whether these are seconds."""
    if pair:
        whole, part = pair
        return table.values[:, whole] + table.values[:, part] * _PARTS[_last_word(table.names[part])[1]], True
    if not times:
        return None, False
    scale = _scale(table, times[0])
    return table.values[:, times[0]] * (1.0 if scale is None else scale), scale is not None


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


def _doubts(
    table: SampleTable, rest: Sequence[int], times: Sequence[int], color_s: np.ndarray, timed: bool
) -> dict[int, str]:
    """The columns that are no numbers of a robot, or may be none, and why."""
    doubtful = dict.fromkeys(times[1:], "is a time, too")
    doubtful |= {k: "is a part of a time" for k in rest if table.names and plain_name(table.names[k]) in _PARTS}
    doubtful |= {k: _of_text(table.words.get(k, ())) for k in rest if k in table.text}
    doubtful |= {k: "counts the rows" for k in rest if table.names and _is_count(table.names[k])
                 and _rises(table.values[:, k])}  # fmt: skip
    if not times and not timed and not table.names and _is_clock(table, color_s):
        doubtful[0] = "rises like a clock"
    return {k: why for k, why in doubtful.items() if k in rest}


def _is_count(name: str) -> bool:
    """Whether a column is called as numbers of rows are; a name in other letters than a to z is not known."""
    return plain_name(name) in _COUNTS and (plain_name(name) != "" or not any(map(str.isalpha, name)))


def _of_text(cells: Sequence[str]) -> str:
    """What is said of a column of text; of names of files that they are not those of the color pictures."""
    if not cells or not all(cell.lower().endswith((".png", ".jpg", ".jpeg")) for cell in cells):
        return "holds text"
    return f"names files of which not all are color pictures ({cut(cells[0])} to {cut(cells[-1])})"


def _check_meaning(table: SampleTable, name: str, rest: Sequence[int], doubts: dict[int, str], numbered: bool) -> None:
    """Refuse a table with columns that may be no numbers of a robot, with what to write."""
    if not doubts:
        return
    k, why = next(iter(sorted(doubts.items())))
    raise DataError(
        f"{table.path}: column {cut(repr(table.names[k])) if table.names else k + 1} {why}; "
        f"{_advice(table, name, [i for i in rest if i not in doubts], numbered)}"
    )


def _advice(table: SampleTable, name: str, others: Sequence[int], numbered: bool) -> str:
    """What to write where a column may be a time."""
    if table.names:
        some = cut(", ".join(repr(table.names[k]) for k in others), 400)
        return (
            f"name those of the {name}, in order: '{name}_columns: [{some}]', and if it is the time of the rows, call it "  # noqa: E501
            "'time', with its unit as in 'time [ms]'"
        ) + (", if it is the number of the row's picture, 'frame'" if numbered else "")
    if table.path.suffix.lower() == ".npy":
        return (
            f"if it is the time, write it into a file of its own, named as '{name}_times', and the rest without it; "
            f"if it is a number of the {name}, write the array as a table (.csv) with a line of names"
        )
    return (
        f"if it is the time, give the columns names in a first line, its own 'time [s]', or the times a file of "
        f"their own with '{name}_times'; if it is a number of the {name}, name the columns, too"
    )


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
    return plain_name(name[: found.start()] if found else name), _UNITS[found[1].lower()] if found else None


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
    return bool(even and (like_color or table.path.suffix.lower() != ".npy"))
