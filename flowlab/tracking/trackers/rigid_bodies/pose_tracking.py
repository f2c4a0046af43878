"""Poses of rigid bodies, frame by frame. What is aligned is always their first frame, so nothing drifts."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Int32

from flowlab.tracking.trackers.rigid_bodies.body_batch import BodyBatch, rotate
from flowlab.tracking.trackers.rigid_bodies.features import ClipFeatures
from flowlab.tracking.trackers.rigid_bodies.recovery import LOST_ENERGY, LastSeen, NewPlaces, find_again
from flowlab.tracking.trackers.rigid_bodies.rigid_motion import RigidMotion, fit_rigid

_POINTS_PER_BODY = 400
"""Points a body is tracked by."""
_HIGH_ENERGY, _ENERGY_RISE = 0.4, 0.05
"""An energy above this, or this much above the last frame's, calls for a wider search."""
_LOST, _GOOD = 0.4, 0.6
"""Energies above which a body is lost, and below which another may hold it."""
_SHIFTS = (-6.0, -3.0, -1.5, 0.0, 1.5, 3.0, 6.0)
_FAN_PX = np.array(sorted(((x, y, 0.0) for y in _SHIFTS for x in _SHIFTS), key=np.linalg.norm))
"""Shifts in the picture [px] that a wider search tries, the least first: often the best, which spares the rest."""


@dataclass(frozen=True, slots=True)
class RigidBody:
    """Pixels of the first frame that move as one."""

    pixels: Int32[np.ndarray, "n 2"]
    motion: RigidMotion
    """How they move; before they have been tracked, a guess."""
    guessed: Bool[np.ndarray, "T"]
    """Frames in which the guess is worth a try."""
    region: Bool[np.ndarray, "h w"] | None = None
    """Cells of the grid it was last fitted to."""


def track_poses(
    pictures: ClipFeatures, bodies: Sequence[RigidBody], rng: np.random.Generator, points: int = _POINTS_PER_BODY
) -> list[RigidBody]:
    """Find the motions of some bodies, all of them together, frame by frame.

    Args:
        pictures: The clip.
        bodies: Which pixels of the first frame move as one, and guesses of how.
        rng: Chooses the pixels by which a body is tracked.
        points: How many these are for each.

    Returns:
        The same bodies in the same order, with the motions found.
    """
    if not bodies:
        return []
    batch, frames, count = BodyBatch(pictures, [b.pixels for b in bodies], rng, points), len(pictures), len(bodies)
    R, s = np.tile(np.eye(3), (frames, count, 1, 1)), np.zeros((frames, count, 3))
    energy = np.zeros(count)
    seen = LastSeen.at_first(count)
    for t in range(1, frames):
        batch.last_center = rotate(R[t - 1], batch.center) + s[t - 1]
        poses = _easy_guesses(bodies, t, R, s, seen)
        if pictures.still is not None:
            poses = _with_stillness(pictures.still, t, R[t - 1], s[t - 1], poses)
        best = _BestPoses(*_choose(batch.energies(t, *poses), *poses))
        hard = np.flatnonzero((best.energy > _HIGH_ENERGY) | (best.energy > energy + _ENERGY_RISE))
        if len(hard):
            _search(batch, t, best, hard, R[t - 1], s[t - 1])
        lightness = pictures.lightness(t)
        best.try_poses(slice(None), *_evaluate(batch, t, *batch.align(t, best.R, best.s, lightness)), slack=1e-3)
        _borrow_motions(batch, t, best, R[t - 1], s[t - 1], lightness)
        _find_lost(batch, t, best, seen, lightness)
        R[t], s[t], energy = best.R, best.s, best.energy
        seen.update((best.seen > 0.4) & (energy < 0.5), t, R[t], s[t])
        batch.turn(np.flatnonzero(best.seen > 0.4), R[t], s[t])
    return [replace(b, motion=RigidMotion(R[:, k], s[:, k])) for k, b in enumerate(bodies)]


def _with_stillness(
    still: RigidMotion, t: int, last_R: np.ndarray, last_s: np.ndarray, poses: tuple[np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Poses to try, and those of bodies that stay where they were in the frame before, though the camera moves."""
    R_step = still.R[t] @ still.R[t - 1].T
    s_step = still.t[t] - R_step @ still.t[t - 1]
    R, s = R_step @ last_R, rotate(R_step, last_s) + s_step
    return np.concatenate([poses[0], R[:, None]], 1), np.concatenate([poses[1], s[:, None]], 1)


def _easy_guesses(
    bodies: Sequence[RigidBody], t: int, R: np.ndarray, s: np.ndarray, seen: LastSeen
) -> tuple[np.ndarray, np.ndarray]:
    """Poses to try in frame t (B, 4, 3, 3) and (B, 4, 3): that of the frame before, that in which the body was last
    seen well, that to which its last step leads again, and that of its proposal."""
    before = max(t - 2, 0)
    R_step = R[t - 1] @ R[before].swapaxes(1, 2)
    s_step = s[t - 1] - rotate(R_step, s[before])
    guess_R = np.stack([b.motion.R[t] if b.guessed[t] else R[t - 1, k] for k, b in enumerate(bodies)])
    guess_s = np.stack([b.motion.t[t] if b.guessed[t] else s[t - 1, k] for k, b in enumerate(bodies)])
    return (
        np.stack([R[t - 1], seen.R, R_step @ R[t - 1], guess_R], 1),
        np.stack([s[t - 1], seen.s, rotate(R_step, s[t - 1]) + s_step, guess_s], 1),
    )


@dataclass(slots=True)
class _BestPoses:
    """The best poses found so far in a frame, with their energies and seen shares."""

    R: np.ndarray
    s: np.ndarray
    energy: np.ndarray
    seen: np.ndarray

    def try_poses(
        self, of: np.ndarray | slice, R: np.ndarray, s: np.ndarray, energy: np.ndarray, seen: np.ndarray, slack: float
    ) -> np.ndarray:
        """Take poses of the bodies ``of`` where they are better, or worse by no more than ``slack``."""
        index = np.arange(len(self.energy))[of]
        better = energy < self.energy[index] + slack
        take = index[better]
        self.R[take], self.s[take], self.energy[take], self.seen[take] = (
            R[better],
            s[better],
            energy[better],
            seen[better],
        )
        return take


def _choose(
    valued: tuple[np.ndarray, np.ndarray], R: np.ndarray, s: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Of each body's candidates the best."""
    energy, seen = valued
    k = np.arange(len(energy)), energy.argmin(1)
    return R[k], s[k], energy[k], seen[k]


def _evaluate(
    batch: BodyBatch, t: int, R: np.ndarray, s: np.ndarray, of: np.ndarray | slice = slice(None)
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Poses with their energies and seen shares."""
    energy, seen = batch.energies(t, R[:, None], s[:, None], of)
    return R, s, energy[:, 0], seen[:, 0]


def _search(
    batch: BodyBatch, t: int, best: _BestPoses, hard: np.ndarray, last_R: np.ndarray, last_s: np.ndarray
) -> None:
    """For bodies that no easy guess explains: optical flow of their own points, and shifts in the picture."""
    flow_R, flow_s = _by_flow(batch, t, best, hard, last_R, last_s)
    best.try_poses(hard, *_evaluate(batch, t, flow_R, flow_s, hard), slack=0)
    depth = rotate(best.R[hard], batch.center[hard])[:, 2] + best.s[hard, 2]
    fan = _FAN_PX / batch.pictures.K[0, 0] * depth[:, None, None]
    R = np.concatenate([np.repeat(x[hard][:, None], len(_FAN_PX), 1) for x in (best.R, last_R)], 1)
    s = np.concatenate([x[hard][:, None] + fan for x in (best.s, last_s)], 1)
    found = _choose(batch.energies(t, R, s, hard, every=3), R, s)
    best.try_poses(hard, *_evaluate(batch, t, found[0], found[1], hard), slack=0)


def _by_flow(
    batch: BodyBatch, t: int, best: _BestPoses, hard: np.ndarray, last_R: np.ndarray, last_s: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The poses that optical flow of the points seen in the last frame asks for; the best where it asks for none."""
    points = batch.points[hard, ::3]
    xyz = points @ last_R[hard].swapaxes(1, 2) + last_s[hard][:, None]
    target, ok = _carried_by_flow(batch.pictures, t, xyz)
    R, s = fit_rigid(points, target, ok.astype(float), 3, scale=0.004)
    few = ok.sum(1) < 6
    R[few], s[few] = best.R[hard[few]], best.s[hard[few]]
    return R, s


def _carried_by_flow(pictures: ClipFeatures, t: int, xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where optical flow takes points (B, n, 3) [m] of frame t - 1; and where that shows them and it is believed."""
    uv = pictures.project(xyz)
    j, i, ok = _pixels(pictures, uv)
    ok &= np.abs(pictures.depth[t - 1, i, j] - xyz[..., 2]) < 0.02
    q = uv + pictures.flow[t, i, j]
    j, i, inside = _pixels(pictures, q)
    z = pictures.depth[t, i, j].astype(float)
    ok &= inside & (z > 0) & (np.abs(z - xyz[..., 2]) < 0.03)
    return pictures.unproject(q, z), ok


def _pixels(pictures: ClipFeatures, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Columns and rows of the pixels nearest to some places (..., 2), and which of these are in the picture."""
    last = np.array(pictures.depth.shape[:0:-1]) - 1
    j, i = np.moveaxis(np.rint(np.minimum(np.maximum(uv, 0), last)).astype(int), -1, 0)
    return j, i, np.asarray((uv >= 0).all(-1) & (uv <= last).all(-1))


def _find_lost(batch: BodyBatch, t: int, best: _BestPoses, seen: LastSeen, lightness: np.ndarray) -> None:
    """Look for bodies that are lost wherever they may be by now, turned as they were when they were last seen."""
    lost = np.flatnonzero(best.energy > LOST_ENERGY)
    if len(lost):
        new = NewPlaces.of(batch.pictures, t)
        for k in lost:
            if found := find_again(batch, t, int(k), seen, lightness, new):
                best.R[k], best.s[k], best.energy[k], best.seen[k] = found


def _borrow_motions(
    batch: BodyBatch, t: int, best: _BestPoses, last_R: np.ndarray, last_s: np.ndarray, lightness: np.ndarray
) -> None:
    """A body that is lost may be held by one that is not: let it try the others' motions since the last frame."""
    lost = np.flatnonzero((best.energy > _LOST) | (best.seen < 0.35))
    good = np.flatnonzero((best.energy < _GOOD) & (best.seen > 0.4))
    if not (len(lost) and len(good)):
        return
    R_step = best.R[good] @ last_R[good].swapaxes(1, 2)
    s_step = best.s[good] - rotate(R_step, last_s[good])
    R = R_step[None] @ last_R[lost][:, None]
    s = rotate(R_step[None], last_s[lost][:, None]) + s_step
    found = _choose(batch.energies(t, R, s, lost), R, s)
    taken = best.try_poses(lost, *found, slack=-0.01)
    if len(taken):
        aligned = batch.align(t, best.R[taken], best.s[taken], lightness, taken)
        best.try_poses(taken, *_evaluate(batch, t, *aligned, taken), slack=0)
