"""Two robots that publish in turn under one name: rows that fall apart into smooth tracks, between which they leap."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float64, Int64

_FEWEST = 12
"""So many rows are needed to tell that numbers jump back and forth."""
_BLOCK = 2000
"""So many rows are looked at, at the start, in the middle and at the end."""
_TRACKS = 3
"""No more robots than this are told apart; what needs more tracks is noise."""
_OPENS = (0.33, 0.5)
"""A new track begins this share of a leap away from all others."""
_SMOOTHER = 3.0
"""Each track is so many times smoother than the whole where that leaps from one to another."""
_FORTH, _SHARE = 6, 0.04
"""Two robots leap at least so often, and in this share of the rows."""
_CLEAR_SHARE, _SURE = 0.4, 5.0
"""And in this share, and tracks are so many times smoother, where fewer numbers than three tell it."""
_VALUES = 5
"""A number with fewer values than this is a switch, such as that of a gripper."""
_GOES = 0.1
"""A number travels that steps by less than this share of its range, and may not do so on through leaps."""
_GOES_ON = 1.5
"""It goes on through a leap by no more than this many of its steps."""
_LIKE = 0.25
"""So many of the numbers may go on through leaps."""
_HOLDS = 0.5
"""More rows than this stay exactly where they are between leaps: these are targets that are reached in turn."""
_BEFORE = 8
"""Rows are compared with so many before."""
_TURN = (2 * np.pi, 360.0)
"""Angles leap by a full turn where they wrap [rad, degrees]."""


@dataclass
class _Track:
    """Rows that follow one another closely."""

    last: Float64[np.ndarray, "D"]
    rows: list[int] = field(default_factory=list)


def find_turns(values: Float64[np.ndarray, "N D"]) -> tuple[int, int] | None:
    """Which column leaps most between robots in turn, and how often one follows on another; None where none does.

    Every row is given to the track whose last row is nearest. Of robots in turn each track is smooth, and the whole
    leaps from one to another; noise, differences and velocities are as rough within any track as between them.
    """
    starts = {0, max(0, (len(values) - _BLOCK) // 2), max(0, len(values) - _BLOCK)}
    found = [turns for at in sorted(starts) if (turns := _turns(values[at : at + _BLOCK])) is not None]
    return max(found, key=lambda turns: turns[1], default=None)


def _turns(values: Float64[np.ndarray, "N D"]) -> tuple[int, int] | None:
    """The same of one block of rows."""
    columns = np.flatnonzero([len(np.unique(column)) >= _VALUES for column in values.T])
    if len(values) < _FEWEST or not len(columns):
        return None
    scaled = values[:, columns] / np.ptp(values[:, columns], axis=0)
    seen = scaled[:, _telling(scaled)]
    for share in _OPENS if seen.shape[1] else ():
        tracks = _tracks(seen, share)
        found = None if tracks is None else _judge(values[:, columns], scaled, seen, tracks)
        if found is not None:
            return int(columns[found[0]]), found[1]
    return None


def _judge(
    values: Float64[np.ndarray, "N C"],
    scaled: Float64[np.ndarray, "N C"],
    seen: Float64[np.ndarray, "N D"],
    tracks: list[_Track],
) -> tuple[int, int] | None:
    """Which column leaps most between tracks, and how often; None where they are none of robots in turn."""
    whose, before = _order(tracks, len(seen))
    leaps = np.flatnonzero(np.diff(whose)) + 1
    if len(leaps) < max(_FORTH, _SHARE * len(seen)) or not _are_smooth(seen, whose, before, leaps):
        return None
    held = np.flatnonzero(np.diff(whose) == 0) + 1
    if len(held) > len(seen) / 4 and (seen[held] == seen[held - 1]).all(1).mean() > _HOLDS:
        return None
    if _swings(seen, leaps, whose):
        return None
    times = _times_own_steps(values, leaps, before)
    leap = times > _SMOOTHER
    travels = (times < _GOES_ON) & (np.median(np.abs(np.diff(scaled, axis=0)), axis=0) < _GOES)
    if leap.sum() < min(2, len(leap)) or travels.sum() > _LIKE * (travels.sum() + leap.sum()):
        return None
    if leap.sum() < 3 and (len(leaps) < _CLEAR_SHARE * len(seen) or not _are_smooth(seen, whose, before, leaps, _SURE)):
        return None
    size = np.abs(scaled[leaps] - scaled[leaps - 1]).mean(0) * leap
    return int(size.argmax()), len(leaps)


def _telling(scaled: Float64[np.ndarray, "N D"]) -> Bool[np.ndarray, "D"]:
    """Which columns both lie near a value before and leap: neither noise nor a steady motion."""
    apart = np.concatenate([np.abs(scaled[n:] - scaled[:-n]) for n in range(1, _BEFORE + 1)])
    near, far = np.quantile(apart, (0.2, 0.98), axis=0)
    told: np.ndarray = near < _GOES * far
    return told


def _tracks(seen: Float64[np.ndarray, "N D"], share: float) -> list[_Track] | None:
    """The rows by the nearest last row of a track; None where they are on one track, or on too many."""
    leap = float(np.quantile(np.linalg.norm(np.diff(seen, axis=0), axis=1), 1 - _SHARE))
    away = share * leap
    tracks: list[_Track] = []
    for row, place in enumerate(seen):
        apart = [float(np.linalg.norm(place - track.last)) for track in tracks]
        if not apart or min(apart) > away:
            tracks.append(_Track(place))
            apart.append(0.0)
        track = tracks[int(np.argmin(apart))] if apart[-1] else tracks[-1]
        track.last = place
        track.rows.append(row)
        if len(tracks) > _TRACKS * 2:
            return None
    some = [track for track in tracks if len(track.rows) >= 3]
    return tracks if 2 <= len(some) <= _TRACKS else None


def _order(tracks: list[_Track], count: int) -> tuple[Int64[np.ndarray, "N"], Int64[np.ndarray, "N"]]:
    """The track of every row, and the row before it on its track; -1 for the first of a track."""
    whose, before = np.zeros(count, np.int64), np.full(count, -1, np.int64)
    for k, track in enumerate(tracks):
        whose[track.rows] = k
        before[track.rows[1:]] = track.rows[:-1]
    return whose, before


def _are_smooth(
    seen: Float64[np.ndarray, "N D"],
    whose: Int64[np.ndarray, "N"],
    before: Int64[np.ndarray, "N"],
    leaps: Int64[np.ndarray, "L"],
    times: float = _SMOOTHER,
) -> bool:
    """Whether each track that is come back to is much smoother than the whole, and none stands at nothing."""
    leap = np.linalg.norm(seen[leaps] - seen[leaps - 1], axis=1)
    back = leaps[before[leaps] >= 0]
    smooth = []
    for k in np.unique(whose[back]):
        rows = np.flatnonzero((whose == k) & (before >= 0))
        steps = np.linalg.norm(seen[rows] - seen[before[rows]], axis=1)
        smooth.append(np.quantile(steps, 0.9) * times < np.median(leap) and bool(seen[rows].any()))
    return len(smooth) >= 2 and all(smooth)


def _swings(seen: Float64[np.ndarray, "N D"], leaps: Int64[np.ndarray, "L"], whose: Int64[np.ndarray, "N"]) -> bool:
    """Whether what seem three tracks lie on one line, as what swings faster than it was recorded does."""
    leap = seen[leaps] - seen[leaps - 1]
    if len(np.unique(whose[leaps])) < 3:
        return False
    size = np.linalg.svd(leap, compute_uv=False)
    return bool(len(size) < 2 or size[1] < 0.2 * size[0])


def _times_own_steps(
    values: Float64[np.ndarray, "N C"], leaps: Int64[np.ndarray, "L"], before: Int64[np.ndarray, "N"]
) -> Float64[np.ndarray, "C"]:
    """How far each column leaps, in steps of its tracks; not as angles that wrap or quaternions whose sign changes."""
    old, new = values[leaps - 1], values[leaps]
    size = np.abs(new - old)
    on = np.flatnonzero(before >= 0)
    step = np.quantile(np.abs(values[on] - values[before[on]]), 0.9, axis=0)
    turned = np.any([np.abs(size - turn) < 0.05 * turn for turn in _TURN], axis=0)
    mirrored = np.abs(new + old) < 0.1 * size
    size[turned | mirrored] = 0
    median: np.ndarray = np.median(size, axis=0) / np.maximum(step, 1e-12)
    return median
