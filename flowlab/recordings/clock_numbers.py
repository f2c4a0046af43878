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
_OFF_RATE = 0.005
"""A column whose rate is this share off a clock's is none."""
_TIMES = re.compile(
    r"(?<!cen)time(?!nt)|stamp|clock|epoch|elapsed|"
    r"(?<![a-z])(date|zeit|uhrzeit|tiempo|temps|tempo|tijd|heure|hora|czas|tid|ts|ticks?|secs?|seconds?|[mun]secs?)(?![a-z])"
)
"""What names of times have in them."""
_OF_ROBOTS = re.compile(
    r"joint|pos|vel|angle|grip|finger|wrist|elbow|shoulder|effort|torque|force|tcp|tool|eef|"
    r"(^|[/.])[a-z]{1,2}[\W_]*\d*$|(^|[/._])([rdqptv]?[xyzw]|[qj]|roll|pitch|yaw|arm)[\W_]*\d*$|(^|/)\d+$"
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
        if len(column) and column.min() > _SINCE_1970:
            found.append(ClockColumn(k, f"is beyond {_SINCE_1970:.0e} throughout, as times since 1970 are", True))
        elif name and _TIMES.search(name) and _rises(column):
            found.append(ClockColumn(k, "is called as times are, and rises", True))
        elif time_s is not None and not (name and _OF_ROBOTS.search(name)):
            rate = _rate(column, time_s)
            why = f"goes on by {rate} a second, as a clock does"
            found += [] if rate is None else [ClockColumn(k, why, not names)]
    every = len(found) == values.shape[1]  # numbers of a simple motion; a state that is nothing but times is no state
    return [c for c in found if not every or not c.why.startswith("goes on")]


def _rises(column: np.ndarray) -> bool:
    steps = np.diff(column)
    return bool(len(steps) and (steps >= 0).all() and np.mean(steps > 0) > 0.5)


def _rate(column: np.ndarray, time_s: np.ndarray) -> int | None:
    """How much a column goes on in a second, where it does so evenly and as much as a clock would."""
    if len(column) < _FEWEST or not _rises(column) or not (np.diff(time_s) > 0).all():
        return None
    t = time_s - time_s.mean()
    rate = float(t @ (column - column.mean()) / (t @ t))
    clock = next((r for r in (1, 10**3, 10**6, 10**9) if abs(rate / r - 1) < _OFF_RATE), None)
    off = np.abs(column - column.mean() - rate * t)
    return clock if clock is not None and off.max() < 0.2 * clock * np.median(np.diff(time_s)) else None
