"""What pictures hold: depth that stands for no reading, and how much they change."""

import zlib
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise

import numpy as np
from jaxtyping import Int64, Num

from flowlab.recordings.base import BadImage, ImageStream, Streams
from flowlab.recordings.motion import Motion, check_motion
from flowlab.recordings.verdicts import Check, Verdict

_SAMPLES = 5
"""Depth pictures that are looked at for readings that are none."""
_FAR = 3.0
"""A greatest reading this many times the median of the others, and often, is that of a plane where nothing was."""
_FAR_SHARE = 0.02
_OFTEN = 3
"""So many pictures with the same greatest reading are no accident."""


@dataclass(frozen=True, slots=True)
class PictureDigest:
    """What is kept of a picture that was looked at."""

    checksum: int
    """The same only for pictures that are the same bit by bit."""
    small: Num[np.ndarray, "h w"]
    """The picture, thinned, to tell how much has changed."""


def digest(picture: np.ndarray) -> PictureDigest:
    """What is kept of a picture."""
    gray = picture[..., 1] if picture.ndim == 3 else picture
    step = max(1, gray.shape[0] // 24), max(1, gray.shape[1] // 32)
    small = np.nan_to_num(gray[:: step[0], :: step[1]].astype(np.float32), posinf=0, neginf=0)
    return PictureDigest(zlib.crc32(np.ascontiguousarray(picture).tobytes()), small)


def motion_of(name: str, stream: ImageStream, digests: Mapping[int, PictureDigest]) -> Motion:
    """When the pictures of a stream change, of those that were looked at."""
    kept = sorted(digests)
    change = np.array([change_between(digests[a], digests[b]) for a, b in pairwise(kept)], np.float64)
    return Motion.make(name, stream.time_s[kept], change)


def motion_checks(
    streams: Streams,
    color: Mapping[int, PictureDigest],
    depth: Mapping[int, PictureDigest],
    stated: Mapping[str, float],
) -> tuple[Check, ...]:
    """Whether depth and the robot move when the color pictures change.

    Args:
        streams: The recording.
        color: What is kept of color pictures, by index.
        depth: Likewise of depth pictures.
        stated: What the user has added to the times of a stream [s]: of depth, of state.
    """
    if len(color) < 2 or len(depth) < 2:
        return ()
    pictures = motion_of("color", streams.color, color)
    found = [check_motion(pictures, motion_of("depth", streams.depth, depth), stated.get("depth"))]
    for s in streams.state[:1]:
        if len(s.time_s) > 1 and s.values.shape[1]:
            reach = np.maximum(np.ptp(s.values, axis=0), 1e-9)
            change = np.linalg.norm(np.diff(s.values, axis=0) / reach, axis=1).astype(np.float64)
            found.append(check_motion(pictures, Motion.make("the robot", s.time_s, change), stated.get("state")))
    return tuple(found)


# --- readings that are none -------------------------------------------------------------------------------


def without_saturated(streams: Streams) -> Streams:
    """The same streams, their depth without readings that stand for none, and with a check that says so."""
    depth = streams.depth
    found, shares = [], []
    for i in np.unique(np.linspace(0, len(depth) - 1, _SAMPLES).astype(int)):
        try:
            counts = depth.read(int(i))
        except BadImage:
            continue
        if counts.ndim == 2 and counts.dtype.kind in "iuf" and (value := _saturated(counts)) is not None:
            found.append(value)
            shares.append(float((counts == value).mean()))
    value, times = Counter(found).most_common(1)[0] if found else (None, 0)
    far = value if times >= _OFTEN or times == len(depth) else None
    masked = replace(depth, read=partial(_read_masked, depth.read, far))
    if value is None:
        check = Check("saturated depth", Verdict.OK, "no reading is that of a limit")
    elif far is None and value != _limit(np.dtype(np.uint16)):
        return replace(streams, depth=masked)
    else:
        says = f"{value:g} counts are taken as no reading: the greatest, in {np.mean(shares):.1%} of the pixels"
        check = Check("saturated depth", Verdict.ASSUMED, says)
    return replace(streams, depth=masked, checks=(*streams.checks, check))


def _limit(dtype: np.dtype) -> float | None:
    """The greatest number of a type of 16 bits."""
    return float(np.iinfo(dtype).max) if dtype.kind in "iu" and dtype.itemsize == 2 else None


def _saturated(counts: Num[np.ndarray, "H W"]) -> float | None:
    """The reading of a picture that stands for none; None where there is none."""
    readings = counts[np.isfinite(counts) & (counts > 0)]
    if not readings.size:
        return None
    most = float(readings.max())
    if most == _limit(counts.dtype):
        return most
    others = readings[readings < most]
    often = 1 - others.size / readings.size >= _FAR_SHARE
    return most if often and others.size and most >= _FAR * float(np.median(others)) else None


def _read_masked(read: Callable[[int], np.ndarray], far: float | None, index: int) -> np.ndarray:
    """Decode a depth picture; readings that are none are 0."""
    counts = read(index)
    none = [value for value in (far, _limit(counts.dtype)) if value is not None]
    return np.where(np.isin(counts, none), 0, counts) if none and np.isin(counts, none).any() else counts


# --- whether pictures are the same --------------------------------------------------------------------------


def repeated_pictures(digests: Mapping[int, PictureDigest]) -> Int64[np.ndarray, "R"]:
    """The pictures that are the same as the one looked at before."""
    return np.array([b for a, b in pairwise(sorted(digests)) if is_equal(digests[a], digests[b])], np.int64)


def is_equal(a: PictureDigest, b: PictureDigest) -> bool:
    """Whether two pictures are the same, and have anything in them by which that could be told."""
    return a.checksum == b.checksum and np.ptp(a.small) > 0


def change_between(a: PictureDigest, b: PictureDigest) -> float:
    """How much has changed between two pictures."""
    return float(np.abs(a.small - b.small).mean()) if a.small.shape == b.small.shape else 0.0
