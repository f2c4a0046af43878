"""Depth that stands for no reading: a type's greatest number, and the ends at which a sensor or a program cuts off."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from jaxtyping import Num

from flowlab.recordings.base import BadImage, ImageStream, Streams
from flowlab.recordings.verdicts import Check, Verdict

_PAIRS = 4
"""So many pairs of depth pictures are looked at, one right after the other."""
_PIXELS = 80_000
"""So many pixels of each, evenly spread."""
_RUN = 3
"""So many pictures with the same limit are no accident."""
_OFTEN = 0.02
"""A limit is the reading of so many pixels."""
_ALONE = (0.005, 1.5)
"""Fewer will do at an end of all readings, where the next one is this many times nearer or farther."""
_FAR = 3.0
"""Whether it varies or not, a greatest reading this many times the median is that of a plane where nothing was."""
_VARY = 0.3
"""So many readings change from one picture to the next where a sensor takes them."""
_OTHERS = 0.4
"""So many of the readings must be others, or it is a plane before which a thing moves."""
_STEADY = 0.2
"""A limit changes in so many times as few pixels as other readings."""


def without_saturated(streams: Streams) -> Streams:
    """The same streams, their depth without readings that stand for none, and with a check that says so."""
    depth = streams.depth
    pairs = _pairs(depth)
    pictures = [picture for pair in pairs for picture in pair]
    limits = _limits(pairs)
    masked = replace(depth, read=partial(_read_masked, depth.read, limits))
    says = [
        f"{value:g} counts are taken as no reading: {_place(pictures, value)}, in {share:.1%} of the pixels"
        for value in sorted({*limits, *_types_limits(pictures)})
        if (share := float(np.mean([(p == value).mean() for p in pictures])))
    ]
    verdict = Verdict.ASSUMED if says else Verdict.OK
    check = Check("saturated depth", verdict, "; ".join(says) or "no reading is that of a limit")
    return replace(streams, depth=masked, checks=(*streams.checks, check))


def _place(pictures: Sequence[np.ndarray], value: float) -> str:
    """Where a limit is among the readings."""
    readings = np.concatenate([p[np.isfinite(p) & (p > 0)] for p in pictures])
    return "the greatest" if readings.max() == value else "the least" if readings.min() == value else "always the same"


def _pairs(depth: ImageStream) -> list[list[np.ndarray]]:
    """Pictures one right after the other, thinned, at some places of the recording; alone where the other is bad."""
    starts = np.unique(np.linspace(0, max(len(depth) - 2, 0), _PAIRS).astype(int))
    return [[p for i in (at, at + 1) if (p := _thinned(depth, int(i))) is not None] for at in starts]


def _thinned(depth: ImageStream, index: int) -> Num[np.ndarray, "H W"] | None:
    try:
        counts = depth.read(index) if index < len(depth) else None
    except BadImage:
        return None
    if counts is None or counts.ndim != 2 or counts.dtype.kind not in "iuf":
        return None
    step = max(1, int(np.sqrt(counts.size / _PIXELS)))
    return counts[::step, ::step]


def _types_limits(pictures: Sequence[np.ndarray]) -> set[float]:
    """The greatest numbers of the types, where they are of 16 bits; these stand for no reading wherever they are."""
    return {most for p in pictures if (most := _types_limit(p.dtype)) is not None}


def _types_limit(dtype: np.dtype) -> float | None:
    return float(np.iinfo(dtype).max) if dtype.kind in "iu" and dtype.itemsize == 2 else None


def _limits(pairs: Sequence[Sequence[np.ndarray]]) -> tuple[float, ...]:
    """The readings that most of the pictures have as limits."""
    pairs = [pair for pair in pairs if pair]
    times = Counter(value for pair in pairs for value in _limits_of(pair))
    return tuple(value for value, n in times.items() if n >= min(_RUN, len(pairs)))


def _limits_of(pair: Sequence[np.ndarray]) -> list[float]:
    """Readings of a picture that are limits: frequent, and steady while the others vary, or far beyond them."""
    counts = pair[0]
    valid = np.isfinite(counts) & (counts > 0) & (counts != _types_limit(counts.dtype))
    values, times = np.unique(counts[valid], return_counts=True)
    if len(values) < 2:
        return []
    often, share = np.flatnonzero(times >= _OFTEN * times.sum()), times / times.sum()
    apart = {0: values[1] / values[0], len(values) - 1: values[-1] / values[-2]}
    alone = [k for k, gap in apart.items() if gap >= _ALONE[1] and share[k] >= _ALONE[0]]
    found = _steady(pair, valid, values[np.union1d(often, alone).astype(int)])
    median = float(np.median(counts[valid & (counts != values[-1])]))
    if share[-1] >= _OFTEN and values[-1] >= _FAR * median:
        found.add(float(values[-1]))
    return sorted(found)


def _steady(pair: Sequence[np.ndarray], valid: np.ndarray, values: np.ndarray) -> set[float]:
    """Values that stay in their pixels, of pictures whose other readings vary."""
    if len(pair) < 2 or pair[0].shape != pair[1].shape or pair[0].dtype != pair[1].dtype or not len(values):
        return set()
    changes = pair[0] != pair[1]
    others = valid & ~np.isin(pair[0], values)
    vary = float(changes[others].mean()) if others.sum() >= _OTHERS * valid.sum() else 0.0
    if vary < _VARY:
        return set()
    return {float(v) for v in values if changes[pair[0] == v].mean() <= _STEADY * vary}


def _read_masked(read: Callable[[int], np.ndarray], limits: Sequence[float], index: int) -> np.ndarray:
    """Decode a depth picture; readings that are none are 0."""
    counts = read(index)
    own = _types_limit(counts.dtype)
    none = [*limits, *([] if own is None else [own])]
    found = np.isin(counts, np.array(none, counts.dtype)) if none else np.zeros(0, bool)
    return np.where(found, 0, counts) if found.any() else counts
