"""Rows of a robot's numbers that are no readings: values that stand for none, and rows that froze."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from flowlab.recordings.content import runs
from flowlab.text import cut

_FAR = 8.0
"""A value this many times the spread of the others away from them is none of them."""
_ENDS = 4
"""So many of the least and of the greatest values are looked at."""
_SPREAD = 5
"""So many different values have a spread."""
_SELDOM = 1 / 3
"""A value in more of the rows than this is a usual one."""
_FROZEN = 5
"""So many equal rows are no accident where rows else differ."""
_USUAL = 0.05
"""Where more of the other rows equal the one before, that is how this robot is recorded."""
_LEAP = 4.0
"""Numbers that froze leap by this many times the usual step when they go on."""


def no_readings(values: Float64[np.ndarray, "T D"], columns: Sequence[str]) -> str:
    """Which value stands for no reading, in words; empty where none seems to.

    Args:
        values: A row for every sample.
        columns: Names of the numbers, where they are known.

    Returns:
        The column, the value and the rows: it comes again and again, far from all others.
    """
    for k, column in enumerate(values.T):
        found, count = np.unique(column, return_counts=True)
        place = np.arange(len(found))  # what is far from all others is among the least or the greatest
        at_ends = (place < _ENDS) | (place >= len(found) - _ENDS)
        for value in found[at_ends & (count >= 2) & (count <= _SELDOM * len(column))]:
            others = column[column != value]
            if len(np.unique(others)) < _SPREAD:
                continue
            low, high = np.quantile(others, (0.02, 0.98))
            if max(low - value, value - high) > _FAR * (high - low) > 0:
                rows = np.flatnonzero(column == value)
                name = cut(repr(columns[k])) if columns else str(k + 1)
                return (f"column {name} is {value:g} in {len(rows)} of {len(column)} rows, the first {rows[0]}, and "
                        f"else {low:.3g} to {high:.3g}: it may stand for no reading")  # fmt: skip
    return ""


def frozen_rows(values: Float64[np.ndarray, "T D"]) -> str:
    """Which rows froze, in words; empty where none did.

    Args:
        values: A row for every sample, in the order of time.

    Returns:
        The first and last of rows that are equal in every number, while others never are, and leap when they go on.
    """
    if len(values) < 2 * _FROZEN:
        return ""
    same = (np.diff(values, axis=0) == 0).all(1)
    spread = np.ptp(values, axis=0)
    step = np.abs(np.diff(values, axis=0)[:, spread > 0] / spread[spread > 0]).max(1, initial=0)
    usual = float(np.median(step[~same])) if (~same).any() else np.inf
    for first, last in runs(same):
        others = np.delete(same, np.s_[first:last])
        if last - first + 1 < _FROZEN or not len(others) or others.mean() > _USUAL:
            continue
        leaps = [step[k] for k in (first - 1, last) if 0 <= k < len(step)]
        if leaps and max(leaps) > _LEAP * usual:
            return (f"rows {first} to {last} are equal in every number, and leap when they go on, while other rows "
                    "differ: the robot's numbers froze, or were lost")  # fmt: skip
    return ""
