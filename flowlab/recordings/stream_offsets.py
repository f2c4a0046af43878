"""Whether depth and the robot move when the color pictures change."""

from collections.abc import Mapping
from itertools import pairwise

import numpy as np

from flowlab.recordings.base import ImageStream, Streams
from flowlab.recordings.content import PictureDigest, change_between
from flowlab.recordings.depth_lag import LEAST_CORRELATION, find_depth_lag
from flowlab.recordings.motion import Motion, check_offset, find_offset
from flowlab.recordings.picture_changes import find_changes
from flowlab.recordings.verdicts import Check


def check_offsets(
    streams: Streams,
    color: Mapping[int, PictureDigest],
    depth: Mapping[int, PictureDigest],
    stated: Mapping[str, float],
    *,
    aligned: bool,
) -> tuple[Check, ...]:
    """Whether depth and the robot move when the color pictures change.

    Args:
        streams: The recording.
        color: What is kept of color pictures, by index.
        depth: Likewise of depth pictures.
        stated: What the user has added to the times of a stream [s]: of depth, of state.
        aligned: Whether depth is seen from the color camera, by what is known.
    """
    if len(color) < 2 or len(depth) < 2:
        return ()
    pictures = _motion_of("color", streams.color, color)
    changes = find_changes(streams, color, depth) if aligned else None
    lag = None if changes is None else find_depth_lag(changes)
    if lag is None or lag.correlation < LEAST_CORRELATION:
        lag = find_offset(pictures, _motion_of("depth", streams.depth, depth))
    found = [check_offset("depth", lag, "depth_offset_s", stated.get("depth"), refusable=True)]
    for s in streams.state[:1]:
        if len(s.time_s) > 1 and s.values.shape[1]:
            values = s.values.astype(np.float64)  # of float32, what it goes over may be too large for that
            reach = np.maximum(np.ptp(values, axis=0), 1e-9)
            change = np.linalg.norm(np.diff(values, axis=0) / reach, axis=1)
            offset = find_offset(pictures, Motion.make("the robot", s.time_s, change))
            found.append(check_offset("the robot", offset, "state_offset_s", stated.get("state")))
    return tuple(found)


def _motion_of(name: str, stream: ImageStream, digests: Mapping[int, PictureDigest]) -> Motion:
    """When the pictures of a stream change, of those that were looked at."""
    kept = sorted(digests)
    change = np.array([change_between(digests[a], digests[b]) for a, b in pairwise(kept)], np.float64)
    return Motion.make(name, stream.time_s[kept], change)
