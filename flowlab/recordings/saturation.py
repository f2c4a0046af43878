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
_NEAR_TYPES_LIMIT = (35, 0.75)
"""Readings of 16 bits this near to the greatest stand for none, too, where none lies from this share of it on."""
_FILLED = (0.05, 10.0)
"""One reading of this share, so many times as frequent as any other, fills holes among readings with noise."""
_ROUGH = 5e-4
"""Noise is more than this share of the depth."""
_STEADY = 0.2
"""A limit changes in so many times as few pixels as other readings."""


def without_saturated(streams: Streams) -> Streams:
    """The same streams, their depth without readings that stand for none, and with a check that says so."""
    depth = streams.depth
    pairs = _pairs(depth)
    pictures = [picture for pair in pairs for picture in pair]
    limits = (*_limits(pairs), *_near_types_limit(pictures))
    filled = [found for p in pictures if (found := _filled(p, ())) is not None]
    fills = len(filled) >= max(2, min(_RUN, len(pictures))) and len({value for value, _ in filled}) > 1
    masked = replace(depth, read=partial(_read_masked, depth.read, limits, fills))
    says = [
        f"{value:g} counts are taken as no reading: {_place(pictures, value)}, in {share:.1%} of the pixels"
        for value in sorted({*limits, *_types_limits(pictures)})
        if (share := float(np.mean([(p == value).mean() for p in pictures])))
    ]
    if fills:
        share = np.median([share for _, share in filled])
        says.append(f"in {len(filled)} of {len(pictures)} pictures {share:.0%} of the pixels have one reading, another "
                    "one from picture to picture, among others with noise, as of a filter that fills holes; these "
                    "are taken as no reading")  # fmt: skip
    verdict = Verdict.DOUBTFUL if fills else Verdict.ASSUMED if says else Verdict.OK
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


def _near_types_limit(pictures: Sequence[np.ndarray]) -> tuple[float, ...]:
    """Codes at the end of a type, such as negative numbers that were stored without a sign."""
    codes: set[float] = set()
    for picture in pictures:
        most = _types_limit(picture.dtype)
        if most is None:
            continue
        high = np.unique(picture[picture > _NEAR_TYPES_LIMIT[1] * most])
        if high.size and high[0] < most - _NEAR_TYPES_LIMIT[0]:
            return ()
        codes.update(np.arange(most - _NEAR_TYPES_LIMIT[0], most).tolist() if (high < most).any() else ())
    return tuple(sorted(codes))


def _filled(counts: np.ndarray, limits: Sequence[float]) -> tuple[float, float] | None:
    """The reading with which holes of a picture were filled, and its share of the pixels; None where there is none."""
    none = np.array([*limits, _types_limit(counts.dtype) or 0])
    valid = np.isfinite(counts) & (counts > 0) & ~np.isin(counts, none)
    values, times = np.unique(counts[valid], return_counts=True)
    if len(values) < 2 or times.max() < _FILLED[0] * valid.sum():
        return None
    value = values[times.argmax()]
    others = valid & (counts != value)
    fills = (
        others.sum() >= _OTHERS * valid.sum()
        and _is_rough(counts, others)
        and times.max() >= _FILLED[1] * np.sort(times)[-2]
    )
    return (float(value), float(times.max() / counts.size)) if fills else None


def _is_rough(counts: np.ndarray, valid: np.ndarray) -> bool:
    """Whether readings have noise: most lie off the line through their neighbors, by more than they are rounded."""
    depth = counts.astype(np.float64)
    off = np.abs(depth[:, 2:] - 2 * depth[:, 1:-1] + depth[:, :-2])[valid[:, 2:] & valid[:, 1:-1] & valid[:, :-2]]
    least = max(2.0 if counts.dtype.kind in "iu" else 0.0, _ROUGH * float(np.median(depth[valid])))
    return off.size > 0 and bool((off >= least).mean() > 0.5)


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


def _read_masked(read: Callable[[int], np.ndarray], limits: Sequence[float], fills: bool, index: int) -> np.ndarray:
    """Decode a depth picture; readings that are none are 0."""
    counts = read(index)
    own = _types_limit(counts.dtype)
    none = [*limits, *([] if own is None else [own])]
    filled = _filled(counts, none) if fills and counts.ndim == 2 else None
    none += [] if filled is None else [filled[0]]
    found = np.isin(counts, np.array(none, counts.dtype)) if none else np.zeros(0, bool)
    return np.where(found, 0, counts) if found.any() else counts
