"""Whether the numbers of a robot can be what they are taken for, whichever reader they are from."""

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float64

from flowlab.recordings.base import SampleStream
from flowlab.recordings.clock_numbers import ClockColumn, find_clocks
from flowlab.recordings.verdicts import Check, Verdict
from flowlab.text import cut

if TYPE_CHECKING:
    from flowlab.recordings.parsing import ParsedRecording

_FEWEST = 12
"""So many rows are needed to tell that numbers jump back and forth."""
_TURNS = 0.1
"""Numbers of one robot do not leap more often than in this share of the rows."""
_LEAP = 5.0
"""What lies between two robots is so many times the steps of each."""
_LEAST = 0.1
"""And this share of the range of every number, about."""
_BACK = 4
"""So many rows before are looked at."""
_COLUMNS = 3
"""Fewer numbers than this may lie near their earlier values by chance."""
_VALUES = 5
"""A number with fewer values than this is a switch, such as that of a gripper."""
_TURN = (2 * np.pi, 360.0)
"""Angles leap by a full turn where they wrap [rad, degrees]."""


def check_numbers(source: "ParsedRecording") -> Iterator[Check]:
    """Whether state and actions hold times, or are of two robots in turn; one check for each that there is."""
    for what in ("state", "action"):
        streams: Sequence[SampleStream] = getattr(source.streams, what)
        if not streams:
            continue
        chosen = getattr(source.metadata, f"{what}_columns") is not None
        found = [c for s in streams for c in (*(() if chosen else _times(s, what, source.write_to)), *_turns(s))]
        width = sum(s.values.shape[1] for s in streams)
        says = f"none of {width} numbers goes as a clock does, or leaps as those of two robots in turn"
        yield from found or [Check(f"{what} numbers", Verdict.OK, says)]


def _times(stream: SampleStream, what: str, write_to: str) -> Iterator[Check]:
    """Refusals, or doubts, about columns that are times."""
    clocks = find_clocks(stream.values, stream.columns, stream.time_s)
    if clocks:
        says = f"{describe_clock(clocks[0], stream.columns)}; {_advice(stream, what, clocks)}, in {write_to}"
        yield Check(f"{what} numbers", Verdict.REFUSED if clocks[0].certain else Verdict.DOUBTFUL, says)


def describe_clock(found: ClockColumn, names: Sequence[str]) -> str:
    """Which column it is, and why it is taken for times."""
    return f"column {cut(repr(names[found.place])) if names else found.place + 1} {found.why}"


def _advice(stream: SampleStream, what: str, clocks: Sequence[ClockColumn]) -> str:
    """What to write."""
    if stream.columns:
        rest = [n for k, n in enumerate(stream.columns) if k not in {c.place for c in clocks}]
        return f"name the numbers of the {what}, in order: '{what}_columns: [{cut(', '.join(map(repr, rest)), 400)}]'"
    return (f"write the {what} as a table with a line of names, its times in a column 'time [s]', and name it with "
            f"'{what}: {what}.csv'")  # fmt: skip


def _turns(stream: SampleStream) -> Iterator[Check]:
    """A refusal of numbers that leap back and forth between two robots."""
    values = stream.values[np.argsort(stream.time_s, kind="stable")].astype(np.float64)
    found = find_turns(values)
    if found is not None:
        k, count = found
        name = cut(repr(stream.columns[k])) if stream.columns else str(k + 1)
        says = (f"{stream.name} leaps away and back {count} times in {len(values)} rows, most in column {name}, as of "
                "two robots that publish in turn, and nothing tells which is which; record each by itself, or under "
                "names of its own")  # fmt: skip
        yield Check(f"{stream.name} numbers", Verdict.REFUSED, says)


def find_turns(values: Float64[np.ndarray, "N D"]) -> tuple[int, int] | None:
    """Which column leaps most between two robots in turn, and how often one follows on the other; None where none does.

    A row is a leap where it lies far from the one before, and near one of the three before that.
    """
    if len(values) < _FEWEST:
        return None
    count = [len(np.unique(column)) for column in values.T]
    moving = [k for k, n in enumerate(count) if n > 1]
    columns = [k for k in moving if count[k] >= _VALUES] or (moving if len(moving) >= _COLUMNS else [])
    if not columns:
        return None
    if len(columns) < _COLUMNS:
        return next(((k, n) for k in columns if (n := _between_places(values[:, k]))), None)
    seen = values[:, columns] / np.ptp(values[:, columns], axis=0)
    last, near = (np.linalg.norm(seen[_BACK:] - seen[_BACK - n : -n], axis=1) for n in (1, 2))
    for n in range(3, _BACK + 1):
        near = np.minimum(near, np.linalg.norm(seen[_BACK:] - seen[_BACK - n : -n], axis=1))
    leaps = np.flatnonzero((last > _LEAP * near) & (last > _LEAST * np.sqrt(len(columns)))) + _BACK
    if len(leaps) < max(4, _TURNS * len(values)):
        return None
    steps = np.abs(seen[leaps] - seen[leaps - 1])
    if _wrap(values[:, columns], leaps):
        return None
    return columns[int(steps.mean(0).argmax())], len(leaps)


def _between_places(column: Float64[np.ndarray, "N"]) -> int:
    """How often a number leaps over the widest gap between its values; 0 where few of its steps are far smaller."""
    ranked = np.sort(column)
    gaps = np.diff(ranked)
    upper = column > ranked[int(gaps.argmax())]
    step = max(float(np.abs(np.diff(part)).max(initial=0.0)) for part in (column[upper], column[~upper]))
    over = upper[1:] != upper[:-1]
    count, leap = int(over.sum()), float(np.median(np.abs(np.diff(column))[over]))
    turned = any(abs(leap / turn - 1) < 0.05 for turn in _TURN)
    return count if gaps.max() > _LEAP * step and count >= max(4, _TURNS * len(column)) and not turned else 0


def _wrap(values: np.ndarray, leaps: np.ndarray) -> bool:
    """Whether all that leaps are angles that wrap, or quaternions whose sign changes."""
    before, after = values[leaps - 1], values[leaps]
    size = np.abs(after - before)
    turned = np.any([np.abs(size - turn) < 0.05 * turn for turn in _TURN], axis=0)
    mirrored = np.abs(after + before) < 0.1 * size
    still = size < 0.1 * np.ptp(values, axis=0)
    return bool((turned | mirrored | still).all(1).mean() > 0.5)
