"""A motion of a robot fitted to how things move, and how sure it is."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool
from scipy.spatial.transform import Rotation

from flowlab.recordings.robot_motion import (
    SeenMotion,
    SeenSteps,
    Support,
    nearness_of,
    steps_off,
    support_of,
    turn_between,
)

_ROUNDS = 6
_LEAST = 3
"""Pairs that a motion is fitted to."""
_BLOCKS = 6
"""Parts of a recording without which each number is estimated again, to say how sure it is."""
_THIN = 0.15
"""Directions in which a robot goes less than this share of the others tell nothing of how it is sheared."""
_DAMPING = 1e-9


@dataclass(frozen=True, slots=True)
class Sureness:
    """One standard deviation of what a motion says."""

    across: float
    """As a share."""
    along: float
    turn_rad: float


def refined(
    seen: SeenSteps, motion: SeenMotion, *, turns: bool = True, scales: bool = True
) -> tuple[SeenMotion, Support]:
    """A motion brought to where what goes along fits best, and what does so then.

    Args:
        seen: What moves.
        motion: To begin with.
        turns: Whether its rotation is fitted, too.
        scales: Whether its scales are.
    """
    free = _free(turns=turns, scales=scales)
    support = support_of(seen, motion.matrix)
    best = motion, support
    for _ in range(_ROUNDS if free.any() else 0):
        if support.count < _LEAST:
            break
        motion = _solved(seen, support.inside, motion, free)
        support = support_of(seen, motion.matrix)
        best = (motion, support) if support.score > best[1].score else best
    return best


def linear_support(seen: SeenSteps, motion: SeenMotion) -> Support:
    """What goes along if ways may be sheared and scaled at will, as the angles of joints are, near a motion."""
    matrix = motion.matrix
    support = best = support_of(seen, matrix)
    for _ in range(_ROUNDS):
        if support.count < _LEAST:
            break
        pairs, means = _steps_of_pairs(seen, support.inside, matrix)
        way = seen.way[pairs]
        matrix = matrix + np.linalg.lstsq(way, means - way @ matrix.T, rcond=_THIN)[0].T
        support = support_of(seen, matrix)
        best = max(best, support, key=lambda s: s.score)
    return best


def _free(*, turns: bool, scales: bool) -> Bool[np.ndarray, "5"]:
    return np.r_[np.full(3, turns), np.full(2, scales)]


def _steps_of_pairs(seen: SeenSteps, inside: np.ndarray, matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The pairs of some points, and the mean step of these in each, where those count most that fit best."""
    pairs, where = np.unique(seen.pair[inside], return_inverse=True)
    weight = nearness_of(seen, steps_off(seen, matrix)[0])[inside] + 1e-3
    sums = np.stack([np.bincount(where, weight * seen.step[inside, k]) for k in range(3)], -1)
    return pairs, sums / np.bincount(where, weight)[:, None]


def _solved(seen: SeenSteps, inside: np.ndarray, motion: SeenMotion, free: np.ndarray) -> SeenMotion:
    """The motion after some steps of Gauss and Newton on the mean steps of pairs."""
    pairs, means = _steps_of_pairs(seen, inside, motion.matrix)
    for _ in range(2):
        J, left = _linear(seen.way[pairs], means, motion)
        J = J[:, free]
        change = np.zeros(5)
        change[free] = np.linalg.lstsq(J, left, rcond=1e-3)[0]
        change[3:] = change[3:].clip(-0.5, 0.5)
        R = Rotation.from_rotvec(change[:3]).as_matrix() @ motion.R_cam_base
        motion = SeenMotion(R, motion.across * float(np.exp(change[3])), motion.along * float(np.exp(change[4])))
    return motion


def _linear(way: np.ndarray, means: np.ndarray, motion: SeenMotion) -> tuple[np.ndarray, np.ndarray]:
    """How steps of pairs, relative to the way, change with rotation and logarithms of scales; and what is left."""
    turned = way @ motion.R_cam_base.T
    said = turned * motion.scale
    length = np.linalg.norm(said, axis=1)[:, None, None]
    J = np.zeros((len(way), 3, 5))
    x, y, z = turned.T
    J[:, 1, 0], J[:, 2, 0], J[:, 2, 1], J[:, 0, 1], J[:, 0, 2], J[:, 1, 2] = -z, y, -x, z, -y, x
    J[:, :, :3] *= motion.scale[:, None]
    J[:, :2, 3], J[:, 2, 4] = said[:, :2], said[:, 2]
    return (J / length).reshape(-1, 5), ((means - said) / length[:, :, 0]).ravel()


def sureness(seen: SeenSteps, motion: SeenMotion, support: Support, *, turns: bool = True) -> Sureness:
    """How sure a motion is: by the greater of what its fit leaves, and of leaving out one part of the recording after
    another.

    Args:
        seen: What moves.
        motion: That fits it.
        support: What goes along.
        turns: Whether its rotation was fitted.
    """
    if support.count < _LEAST:
        return Sureness(np.inf, np.inf, np.inf)
    free = _free(turns=turns, scales=True)
    pairs, means = _steps_of_pairs(seen, support.inside, motion.matrix)
    J, left = _linear(seen.way[pairs], means, motion)
    J = J[:, free]
    noise = max(float((left**2).sum() / max(len(left) - free.sum(), 1)), 0.02**2)
    cov = np.zeros((5, 5))
    cov[np.ix_(free, free)] = noise * np.linalg.inv(J.T @ J + _DAMPING * np.eye(J.shape[1]))
    across, along, turn = np.sqrt(cov[3, 3]), np.sqrt(cov[4, 4]), np.sqrt(np.linalg.eigvalsh(cov[:3, :3]).max())
    parts = [p for p in np.array_split(pairs, _BLOCKS) if 0 < len(p) < len(pairs)]
    without = [_solved(seen, support.inside & ~np.isin(seen.pair, p), motion, free) for p in parts]
    spread = np.sqrt((len(without) - 1) / max(len(without), 1))
    apart = [[np.log(m.across / motion.across), np.log(m.along / motion.along),
              turn_between(m.R_cam_base, motion.R_cam_base)] for m in without]  # fmt: skip
    left_out = spread * np.sqrt(np.square(apart).sum(0)) if apart else np.full(3, np.inf)
    return Sureness(*np.maximum([across, along, turn], left_out).tolist())
