"""Neighboring bodies that one motion explains are one body."""

import cv2
import numpy as np
from jaxtyping import Int64

from flowlab.tracking.trackers.rigid_bodies.assignment import motion_costs
from flowlab.tracking.trackers.rigid_bodies.bodies import RigidBodyFit, changed_body
from flowlab.tracking.trackers.rigid_bodies.pose_tracking import RigidBody, track_poses
from flowlab.tracking.trackers.rigid_bodies.rigid_motion import RigidMotion

_MAX_PAIRS = 10
_SLACK = 0.04
"""How much more one motion may cost than two, for small bodies; for others 0.4 of that."""
_ALIKE_M = 0.04
"""Motions that differ by more on the seam [m] are not tried as one."""


def merge(fit: RigidBodyFit, rng: np.random.Generator) -> RigidBodyFit | None:
    """Try neighboring bodies as one, and make them one where that explains their pixels almost as well.

    Fewer, larger bodies have better conditioned poses.

    Args:
        fit: The bodies, and whose pixels are whose.
        rng: Chooses the pixels by which a body is tracked.

    Returns:
        The fit with some bodies merged, each with one other at most; None if there is nothing to merge.
    """
    owner = fit.assignment.best_motion
    pairs = neighbors(fit)[:_MAX_PAIRS]
    trials = track_poses(fit.pictures, [_as_one(fit, owner, a, b) for a, b in pairs], rng)
    merits = [_merit(fit, owner, pair, trial.motion) for pair, trial in zip(pairs, trials, strict=True)]
    done: set[int] = set()
    accepted = []
    for k in np.argsort(merits)[::-1]:
        a, b = pairs[k]
        sizes = (owner == a).sum(), (owner == b).sum()
        slack = _SLACK if min(sizes) < 40 and sum(sizes) < 160 else 0.4 * _SLACK
        if merits[k] >= -slack and not {a, b} & done:
            done |= {a, b}
            accepted.append(trials[k])
    if not accepted:
        return None
    bodies = [*(b for k, b in enumerate(fit.bodies) if k + 1 not in done), *accepted]
    return RigidBodyFit.with_needed(fit.cells, bodies)


def neighbors(fit: RigidBodyFit) -> list[tuple[int, int]]:
    """Pairs of motions whose cells touch and that move alike there, those with the longest border first."""
    owner, z, count = fit.assignment.best_motion, fit.grid.depth, len(fit.bodies) + 1
    border = np.zeros((count, count), int)
    for near, far in (np.s_[1:], np.s_[:-1]), (np.s_[:, 1:], np.s_[:, :-1]):
        a, b = owner[near], owner[far]
        touch = (a > 0) & (b > 0) & (a != b) & (np.abs(z[near] - z[far]) < 0.03)
        np.add.at(border, (a[touch], b[touch]), 1)
    border = np.triu(border + border.T)
    pairs = [(a, b) for a, b in np.argwhere(border >= 2).tolist() if _move_alike(fit, owner, a, b)]
    return sorted(pairs, key=lambda p: -border[p])


def _as_one(fit: RigidBodyFit, owner: Int64[np.ndarray, "h w"], a: int, b: int) -> RigidBody:
    """A body of the cells of two, which may move as the larger of them does."""
    larger = a if (owner == a).sum() >= (owner == b).sum() else b
    return changed_body(fit.pictures, fit.grid, (owner == a) | (owner == b), fit.bodies[larger - 1].motion)


def _merit(fit: RigidBodyFit, owner: Int64[np.ndarray, "h w"], pair: tuple[int, int], motion: RigidMotion) -> float:
    """How much less a motion costs than the two bodies' own, in the mean over their cells."""
    a, b = pair
    region = (owner == a) | (owner == b)
    uv = fit.grid.pixels(region)
    xyz = fit.pictures.unproject(uv.astype(float), fit.grid.depth[region].astype(float))
    motions = [fit.bodies[a - 1].motion, fit.bodies[b - 1].motion, motion]
    cost = motion_costs(fit.pictures, fit.grid, motions, uv, xyz, motion_penalty=0.0)
    return float((np.where(owner[region] == a, cost[0], cost[1]) - cost[2]).mean())


def _move_alike(fit: RigidBodyFit, owner: Int64[np.ndarray, "h w"], a: int, b: int) -> bool:
    """Whether two bodies' motions differ little on the seam between them."""
    seam = cv2.dilate((owner == a).astype(np.uint8), np.ones((5, 5), np.uint8)).astype(bool) & (owner == b)
    if not seam.any():
        return False
    uv = fit.grid.pixels(seam).astype(float)
    xyz = fit.pictures.unproject(uv, fit.grid.depth[seam].astype(float))
    one, other = (fit.bodies[k - 1].motion.apply(xyz) for k in (a, b))
    return bool(np.linalg.norm(one - other, axis=-1).mean() < _ALIKE_M)
