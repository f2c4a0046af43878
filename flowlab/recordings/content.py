"""What pictures hold: how much they change."""

import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Int64, Num

from flowlab.recordings.base import ImageStream, Streams
from flowlab.recordings.motion import Motion, check_motion
from flowlab.recordings.verdicts import Check


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
