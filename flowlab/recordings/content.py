"""What pictures hold: how much they change, and pictures that come again and again."""

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Int64, Num

from flowlab.recordings.base import ImageStream, Streams
from flowlab.recordings.motion import Motion, check_motion
from flowlab.recordings.verdicts import Check, Verdict

_RUN = 3
"""So many equal pictures in a row are no accident."""
_MANY = 0.1
"""Share of pictures that may equal the one before, as cameras give one twice now and then."""
_JUMP = 2.5
"""A camera that stood still is told by this many times the usual change after it."""
_MOVED = 0.05
"""A robot moved where a number of its state changed by this share of its range."""


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
    change = np.array([_change(digests[a], digests[b]) for a, b in pairwise(kept)], np.float64)
    return Motion.make(name, stream.time_s[kept], change)


def motion_checks(
    streams: Streams, color: Mapping[int, PictureDigest], depth: Mapping[int, PictureDigest], stated: Sequence[str]
) -> tuple[Check, ...]:
    """Whether depth and the robot move when the color pictures change.

    Args:
        streams: The recording.
        color: What is kept of color pictures, by index.
        depth: Likewise of depth pictures.
        stated: Names of the streams of which the user says how they belong to color: depth, state.
    """
    if len(color) < 2 or len(depth) < 2:
        return ()
    pictures = motion_of("color", streams.color, color)
    found = [check_motion(pictures, motion_of("depth", streams.depth, depth), "depth" in stated)]
    for s in streams.state[:1]:
        if len(s.time_s) > 1 and s.values.shape[1]:
            reach = np.maximum(np.ptp(s.values, axis=0), 1e-9)
            change = np.linalg.norm(np.diff(s.values, axis=0) / reach, axis=1).astype(np.float64)
            found.append(check_motion(pictures, Motion.make("the robot", s.time_s, change), "state" in stated))
    return tuple(found)


# --- pictures that come again -----------------------------------------------------------------------------


def find_repeats(
    streams: Streams,
    color: Mapping[int, PictureDigest],
    depth: Mapping[int, PictureDigest],
    rows: Int64[np.ndarray, "T 2"],
    state: Num[np.ndarray, "T S"],
) -> tuple[dict[int, str], Check]:
    """Rows whose picture is that of a row before, while time went on, and what to say of it.

    Args:
        streams: The recording.
        color: What is kept of color pictures, by index.
        depth: Likewise of depth pictures.
        rows: Indices of the color and depth picture of every row that is good otherwise.
        state: What the robot was at each.

    Returns:
        The reason of every row that is bad, by its place in ``rows``; and the check.
    """
    kept = [[color[int(c)] for c, _ in rows], [depth[int(d)] for _, d in rows]]
    same = [np.array([_equal(a, b) for a, b in pairwise(k)], bool) for k in kept]
    change = [np.array([_change(a, b) for a, b in pairwise(k)]) for k in kept]
    bad: dict[int, str] = {}
    named, still = [], 0
    for which, (stream, other) in enumerate(((streams.color, 1), (streams.depth, 0))):
        for first, last in _runs(same[which]):
            moved = not same[other][first:last].all() or _robot_moved(state, first, last)
            froze = moved or _jumped(change[which], last)
            if last - first + 1 >= _RUN and froze:
                why = f"equals {_name(stream, rows, first, which)} bit by bit, as {last - first} in a row do: it froze"
                bad.update({k: f"{_name(stream, rows, k, which)} {why}" for k in range(first + 1, last + 1)})
            elif moved:
                named.append(_name(stream, rows, last, which))
            else:
                still += last - first
    says = f"{len(bad)} rows are of a picture that froze" if bad else "no picture froze"
    if named:
        says += f"; {len(named)} pictures equal the one before: {', '.join(named[:3])}"
    if still:
        says += f"; {still} equal the one before while nothing else moved, as in a scene that stands still"
    many = bool(bad) or len(named) > _MANY * len(rows)
    verdict = Verdict.DOUBTFUL if many else Verdict.ASSUMED if still or named else Verdict.OK
    return bad, Check("repeats", verdict, says)


def repeated_pictures(digests: Mapping[int, PictureDigest]) -> Int64[np.ndarray, "R"]:
    """The pictures that are the same as the one looked at before."""
    return np.array([b for a, b in pairwise(sorted(digests)) if _equal(digests[a], digests[b])], np.int64)


def _name(stream: ImageStream, rows: Int64[np.ndarray, "T 2"], row: int, which: int) -> str:
    return stream.names[int(rows[row][which])]


def _equal(a: PictureDigest, b: PictureDigest) -> bool:
    """Whether two pictures are the same, and have anything in them by which that could be told."""
    return a.checksum == b.checksum and np.ptp(a.small) > 0


def _change(a: PictureDigest, b: PictureDigest) -> float:
    """How much has changed between two pictures."""
    return float(np.abs(a.small - b.small).mean()) if a.small.shape == b.small.shape else 0.0


def _runs(same: np.ndarray) -> list[tuple[int, int]]:
    """First and last row of every run of equal pictures."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], same, [False]]).astype(np.int8)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def _robot_moved(state: Num[np.ndarray, "T S"], first: int, last: int) -> bool:
    """Whether the state changed while the picture did not."""
    reach = np.ptp(state, axis=0) if state.shape[1] else np.zeros(0)
    return bool((np.ptp(state[first : last + 1], axis=0)[reach > 0] > _MOVED * reach[reach > 0]).any())


def _jumped(change: np.ndarray, last: int) -> bool:
    """Whether much more than usual changed from the last picture of a run to the next."""
    usual = np.delete(change, last) if last < len(change) else change
    usual = usual[usual > 0]
    return bool(last < len(change) and len(usual) and change[last] > _JUMP * np.median(usual))
