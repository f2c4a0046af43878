"""Where color and depth change, from picture to picture, on one clock."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Num

from flowlab.recordings.base import Streams
from flowlab.recordings.content import PictureDigest
from flowlab.recordings.motion import FEWEST
from flowlab.recordings.sync import common_clock

_CELLS = (24, 32)
"""Rows and columns of cells in which changes over time are compared."""
_GRAY, _OF_DEPTH = 40.0, 0.05
"""So many gray levels, and so much of the depth, are the greatest change that counts: something came, or went."""
_NOTHING = 1e-12


@dataclass(frozen=True, slots=True)
class PictureChanges:
    """How much both change at every instant in every cell, beyond its mean: what flickers always tells nothing."""

    color: Float32[np.ndarray, "T h w"]
    depth: Float32[np.ndarray, "T h w"]
    step_s: float
    """From one instant to the next."""


def find_changes(
    streams: Streams, color: Mapping[int, PictureDigest], depth: Mapping[int, PictureDigest]
) -> PictureChanges | None:
    """Where color and depth change; None where there are too few pictures.

    Args:
        streams: The recording.
        color: What is kept of color pictures, by index.
        depth: Likewise of depth pictures.
    """
    times = [stream.time_s[sorted(kept)] for stream, kept in ((streams.color, color), (streams.depth, depth))]
    if min(map(len, times)) <= FEWEST:
        return None
    middle = [(t[1:] + t[:-1]) / 2 for t in times]
    step = float(max(np.median(np.diff(t)) for t in times))
    clock = common_clock(middle, step, step)
    if len(clock) < FEWEST:
        return None
    seen, read = color_changes(_thinned(color)), depth_changes(_thinned(depth))
    return PictureChanges(_on(clock, middle[0], seen), _on(clock, middle[1], read), step)


def correlation(one: np.ndarray, other: np.ndarray) -> float:
    """Correlation of changes whose means are 0."""
    return float((one * other).sum() / np.sqrt(max(float((one**2).sum()) * float((other**2).sum()), _NOTHING)))


def color_changes(gray: Num[np.ndarray, "T h w"]) -> Float32[np.ndarray, "N h w"]:
    """By how many gray levels pictures change from one to the next."""
    return np.minimum(np.abs(np.diff(gray.astype(np.float32), axis=0)), _GRAY)


def depth_changes(counts: Num[np.ndarray, "T h w"]) -> Float32[np.ndarray, "N h w"]:
    """By what share depth changes from picture to picture, 1 for what comes or goes; 0 where it is not read."""
    read = np.nan_to_num(counts.astype(np.float32), posinf=0, neginf=0)
    before, after = read[:-1], read[1:]
    share = np.abs(after - before) / np.maximum(before, np.float32(1e-6))
    return np.where((before > 0) & (after > 0), np.minimum(share / _OF_DEPTH, 1), 0).astype(np.float32)


def _thinned(digests: Mapping[int, PictureDigest]) -> Float32[np.ndarray, "T h w"]:
    """Pictures in order, of so many cells."""
    small = [digests[k].small for k in sorted(digests)]
    shape = small[0].shape
    rows, columns = (np.linspace(0, n - 1, m).round().astype(int) for n, m in zip(shape, _CELLS, strict=True))
    thin = [s[np.ix_(rows, columns)] if s.shape == shape else np.zeros(_CELLS) for s in small]
    return np.stack(thin).astype(np.float32)


def _on(
    clock: Float64[np.ndarray, "T"], time_s: Float64[np.ndarray, "N"], change: Float32[np.ndarray, "N h w"]
) -> Float32[np.ndarray, "T h w"]:
    """Changes at every instant."""
    at = np.interp(clock, time_s, np.arange(len(time_s)))
    low = np.floor(at).astype(int).clip(0, max(len(time_s) - 2, 0))
    share = (at - low).astype(np.float32)[:, None, None]
    changes = change[low] * (1 - share) + change[np.minimum(low + 1, len(time_s) - 1)] * share
    return changes - changes.mean(0)
