"""Numbers that are times, whatever they are called and wherever they stand among those of a robot."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Num

_SINCE_1970 = 1e8
"""Nothing that a robot measures is beyond this; times since 1970 are, in whatever unit [s or less]."""
_FEWEST = 8
"""So many rows are needed to tell that a column goes as a clock does."""
_OFF_RATE = 0.03
"""A column whose mean rate is this share off a clock's is none."""
_JITTER = 0.5
"""Steps of a clock differ by less than this share of the usual one, or its readings from an even course do."""
_RATES = {"1": 1.0, "1000": 1e3, "1000000": 1e6, "1000000000": 1e9}
"""What clocks go on by in a second, and how it is told."""
_SLOW = {"1/60": 1 / 60, "1/3600": 1 / 3600, "1/86400": 1 / 86400}
_LARGE = 1e4
"""Slow clocks count from long ago; a robot's numbers that go on so slowly are smaller."""
_FLOAT32 = 1e6
"""Numbers that are so many times their steps lose these where they are kept as float32."""
_TIMES = re.compile(
    r"(?<!cen)time(?!nt)|stamp|clock|epoch|elapsed|"
    r"(?<![a-z])(date|zeit|uhrzeit|tiempo|temps|tempo|tijd|heure|hora|czas|tid|ts|ticks?|secs?|seconds?|[mun]secs?)(?![a-z])"
)
"""What names of times have in them."""
_UNIT = re.compile(r"(ms|us|µs|ns|m?illis|micros|nanos)")
"""What the part of a time is called that begins anew with every second."""
_OF_ROBOTS = re.compile(
    r"joint|pos|vel|angle|grip|finger|wrist|elbow|shoulder|effort|torque|force|tcp|tool|eef|"
    r"(^|[/.])(?!(?:m|s|h|d|n|i|k|jd|mn|hr|no|nr|id|dt)$)[a-z]{1,2}[\W_]*\d*$|(^|[/._])([rdqptv]?[xyzw]|[qj]|roll|pitch|yaw|arm)[\W_]*\d*$|(^|/)\d+$"
)
"""What names of a robot's numbers have in them; these may, by chance, go on as a clock does."""


@dataclass(frozen=True, slots=True)
class ClockColumn:
    """A column of numbers that are times."""

    place: int
    why: str
    certain: bool
    """False where a robot could, by chance, have moved so."""


def find_clocks(
    values: Num[np.ndarray, "N D"], names: Sequence[str], time_s: Float64[np.ndarray, "N"] | None
) -> list[ClockColumn]:
    """The columns that are times: by their size, by their names, or since they go on as the clock of the rows does.

    Args:
        values: The rows.
        names: Of the columns; empty where they have none.
        time_s: Times of the rows [s]; None where they are not known.
    """
    found = []
    for k, column in enumerate(values.T.astype(np.float64)):
        name = names[k].lower() if names else ""
        if counts_rows(column):
            found.append(ClockColumn(k, "counts by one, as numbers of rows or of pictures do", True))
        elif len(column) and column.min() > _SINCE_1970:
            found.append(ClockColumn(k, f"is beyond {_SINCE_1970:.0e} throughout, as times since 1970 are", True))
        elif name and ((_TIMES.search(name) and _rises(column)) or (_UNIT.fullmatch(name) and _wraps(column))):
            found.append(ClockColumn(k, "is called as times are, and rises", True))
        elif time_s is not None and not (name and _OF_ROBOTS.search(name)):
            rate = _rate(column, time_s)
            why = f"goes on by {rate} a second, as a clock does"
            fine = rate is not None and np.abs(column).max() > _FLOAT32 * np.median(np.diff(column))
            found += [] if rate is None else [ClockColumn(k, why, not names or bool(fine))]
    every = len(found) == values.shape[1]  # numbers of a simple motion; a state that is nothing but times is no state
    return [c for c in found if not every or not c.why.startswith(("goes on", "counts"))]


def counts_rows(column: Num[np.ndarray, "N"]) -> bool:
    """Whether numbers are whole and each but one has its next, in order or not, as those of rows or pictures have."""
    ranked = np.sort(column)
    return len(column) >= _FEWEST and bool((ranked % 1 == 0).all() and (np.diff(ranked) == 1).all())


def _wraps(column: np.ndarray) -> bool:
    """Whether numbers rise, but where they begin anew after most of their range."""
    steps = np.diff(column)
    return bool(len(steps) and ((steps >= 0) | (steps < -0.5 * np.ptp(column))).all() and (steps > 0).mean() > 0.5)


def _rises(column: np.ndarray) -> bool:
    steps = np.diff(column)
    return bool(len(steps) and (steps >= 0).all() and np.mean(steps > 0) > 0.5)


def _rate(column: np.ndarray, time_s: np.ndarray) -> str | None:
    """How much a column goes on in a second, where it does so evenly and in the mean as much as a clock would."""
    steps, times = np.diff(column), np.diff(time_s)
    if len(column) < _FEWEST or not (steps > 0).all() or not (times > 0).all():
        return None
    rate = float((column[-1] - column[0]) / (time_s[-1] - time_s[0]))
    slow = _SLOW if np.abs(column).min() > _LARGE else {}
    clock = next((r for r, at in {**_RATES, **slow}.items() if abs(rate / at - 1) < _OFF_RATE), None)
    usual = float(np.median(steps / times))
    off = column - column.mean() - rate * (time_s - time_s.mean())
    even = (np.abs(steps / times - usual) < _JITTER * usual).all()
    even |= np.abs(off).max() < _JITTER * rate * np.median(times)
    return clock if even else None
