"""Single poses of a camera that cannot be: away and back at once, or the same one for every two pictures."""

import numpy as np
from jaxtyping import Bool, Float, Float64, Int64

from flowlab.recordings.verdicts import Check, Verdict

_FEWEST = 8
_LONGEST = 3
"""So many poses in a row may lie away from the path."""
_AWAY = (0.02, 0.035)
"""A pose lies away that is so far off the path between its neighbors: [m], and [rad]."""
_UNUSUAL = 6.0
"""And so many times as far as others in the median."""
_BESIDE = 1.0
"""And so many times as far as its neighbors are apart."""
_SAME = 1e-7
"""Poses that differ by less are one."""
_RARER, _STEADY = 1.8, 0.9
"""So many rows come to a new pose at least, as evenly as whole rows can in this share."""


def check_steps(T: Float[np.ndarray, "T 4 4"], names: tuple[str, ...]) -> Check:
    """Whether single poses leap away and back, or come several times while the camera moves.

    Args:
        T: The pose at every row.
        names: Of the color pictures of the rows.
    """
    away = leaps(T)
    if len(away):
        some = ", ".join(names[k] for k in away[:3])
        says = f"{len(away)} poses leap away and back, at {some}: what they place in the world is off by as much"
        return Check("steps of poses", Verdict.DOUBTFUL, f"{says}; correct them, or leave them out of the file")
    count = come_again(T)
    if count:
        says = (f"{count} of {len(T)} poses equal the one before, at even steps: they are rarer than the "
                "pictures; give the poses' own times, between which those of pictures are found")  # fmt: skip
        return Check("steps of poses", Verdict.DOUBTFUL, says)
    return Check("steps of poses", Verdict.OK, "no pose leaps away and back")


def come_again(T: Float[np.ndarray, "T 4 4"]) -> int:
    """How many poses equal the one before, where new ones come rarely but steadily; 0 of a camera that rests."""
    again = (np.abs(np.diff(T, axis=0)) < _SAME).all((1, 2))
    every = np.diff(np.flatnonzero(np.concatenate([[True], ~again])))
    if len(T) < _FEWEST or len(every) < _FEWEST // 2 or every.mean() < _RARER:
        return 0
    steady = np.isin(every, np.floor(every.mean()) + np.arange(2)).mean() >= _STEADY
    return int(again.sum()) if steady else 0


def leaps(T: Float[np.ndarray, "T 4 4"]) -> Int64[np.ndarray, "L"]:
    """Rows whose pose is far off the path between poses beside it that are near each other."""
    if len(T) < _FEWEST:
        return np.empty(0, np.int64)
    away = np.zeros(len(T), bool)
    for length in range(_LONGEST, 0, -1):
        for value, least in ((T[:, :3, 3], _AWAY[0]), (T[:, :3, :3].reshape(-1, 9) / np.sqrt(2), _AWAY[1])):
            away |= _off_the_path(value.astype(np.float64), length, least)
    return np.flatnonzero(away)


def _off_the_path(value: Float64[np.ndarray, "T D"], length: int, least: float) -> Bool[np.ndarray, "T"]:
    """Runs of so many rows that all are far off the line between the rows beside them."""
    before, after = value[: -length - 1], value[length + 1 :]
    part = (np.arange(length) + 1) / (length + 1)
    line = before[:, None] + (after - before)[:, None] * part[:, None]
    inside = np.stack([value[k + 1 : k + 1 + len(before)] for k in range(length)], 1)
    off = np.linalg.norm(inside - line, axis=-1)
    apart = np.linalg.norm(after - before, axis=-1)
    far = off.min(1) > np.maximum(np.maximum(least, _UNUSUAL * np.median(off)), _BESIDE * apart)
    found = np.zeros(len(value), bool)
    for k in np.flatnonzero(far):
        found[k + 1 : k + 1 + length] = True
    return found
