"""Streams on one clock: what was measured nearest to, or last before, each color picture."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64, Int64

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

    Args:
        times: When each was seen [s]; they rise.
        step: From one instant to the next [s].
        near: How far from each the nearest of a stream may be [s].
    """
    start, stop = max(t[0] for t in times), min(t[-1] for t in times)
    if not (step > 0 and stop > start):
        return np.empty(0)
    reach = int(np.ceil(near / step))
    around = np.arange(-reach, reach + 2)
    instants = np.unique(np.concatenate([np.floor((t - start) / step)[:, None] + around for t in times]))
    clock = start + step * instants
    clock = clock[(clock >= start) & (clock <= stop + 1e-6)]
    return clock[np.logical_and.reduce([np.abs(t[nearest_sample(clock, t)] - clock) <= near for t in times])]


def sampling_rate(time_s: Float64[np.ndarray, "N"]) -> float:
    """Samples per second, by the median interval; 0 for fewer than two."""
    return float(1 / np.median(np.diff(time_s))) if len(time_s) > 1 else 0.0


def find_gaps(time_s: Float64[np.ndarray, "N"]) -> tuple[tuple[float, float], ...]:
    """Start and length [s] of every interval that is longer than ``GAP`` median ones."""
    interval = np.diff(time_s)
    if len(interval) < 2:
        return ()
    return tuple((float(time_s[i]), float(interval[i])) for i in np.flatnonzero(interval > GAP * np.median(interval)))
