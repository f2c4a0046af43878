"""Streams on one clock: what was measured nearest to, or last before, each color picture."""

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float64, Int64

_MOST_INSTANTS = 2e6
"""A day at 23 a second: where a clock would have more, stamps are not what they seem."""
GAP = 1.5
"""An interval this many times the median one is a gap: at least one picture is missing."""


def nearest_sample(clock: Float64[np.ndarray, "T"], time_s: Float64[np.ndarray, "N"]) -> Int64[np.ndarray, "T"]:
    """Index of the sample nearest to every instant, the earlier of two; ``time_s`` must rise and not be empty."""
    after = np.searchsorted(time_s, clock).clip(1, max(len(time_s) - 1, 1))
    if len(time_s) == 1:
        return np.zeros(len(clock), np.int64)
    return np.where(clock - time_s[after - 1] <= time_s[after] - clock, after - 1, after)


def last_sample(clock: Float64[np.ndarray, "T"], time_s: Float64[np.ndarray, "N"]) -> Int64[np.ndarray, "T"]:
    """Index of the last sample not after every instant; the first where none is."""
    return (np.searchsorted(time_s, clock, side="right") - 1).clip(0)


def common_clock(times: Sequence[Float64[np.ndarray, "_"]], step: float, near: float) -> Float64[np.ndarray, "T"]:
    """Instants a step apart at which every stream was seen so near: not those of a pause, however long that is.

    Empty where they would be millions: stamps are not what they seem.

    Args:
        times: When each was seen [s]; they rise.
        step: From one instant to the next [s].
        near: How far from each the nearest of a stream may be [s].
    """
    parts = [(-np.inf, np.inf)]
    for t in times:
        ends = np.flatnonzero(np.diff(t) > 2 * near)
        seen = zip(t[np.r_[0, ends + 1]] - near, t[np.r_[ends, len(t) - 1]] + near, strict=True)
        parts = list(_overlaps(parts, [(max(a, t[0]), min(b, t[-1])) for a, b in seen]))
    if not parts or not step > 0 or sum(b - a for a, b in parts) > _MOST_INSTANTS * step:
        return np.empty(0)
    start = parts[0][0]
    steps = ((np.ceil((a - start) / step - 1e-6), np.floor((b - start) / step + 1e-6)) for a, b in parts)
    return start + step * np.concatenate([np.arange(first, last + 1) for first, last in steps])


def _overlaps(
    one: Sequence[tuple[float, float]], other: Sequence[tuple[float, float]]
) -> Iterator[tuple[float, float]]:
    """Where stretches of time that rise overlap those of others."""
    i = k = 0
    while i < len(one) and k < len(other):
        start, stop = max(one[i][0], other[k][0]), min(one[i][1], other[k][1])
        if start < stop:
            yield start, stop
        if one[i][1] < other[k][1]:
            i += 1
        else:
            k += 1


def sampling_rate(time_s: Float64[np.ndarray, "N"]) -> float:
    """Samples per second, by the median interval between different times; 0 for fewer than two of these."""
    step = _usual_step(time_s)
    return 1 / step if step else 0.0


def find_gaps(time_s: Float64[np.ndarray, "N"]) -> tuple[tuple[float, float], ...]:
    """Start and length [s] of every interval that is longer than ``GAP`` median ones."""
    interval, usual = np.diff(time_s), _usual_step(time_s)
    if len(interval) < 2:
        return ()
    return tuple((float(time_s[i]), float(interval[i])) for i in np.flatnonzero(interval > GAP * usual))


def _usual_step(time_s: Float64[np.ndarray, "N"]) -> float:
    """The median interval [s] between different times, of which samples may share one; 0 where there is none."""
    interval = np.diff(time_s)
    return float(np.median(interval[interval > 0])) if (interval > 0).any() else 0.0
