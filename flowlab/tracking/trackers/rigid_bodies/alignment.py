"""Following rigid bodies frame by frame. What is aligned is always their first frame, so nothing drifts."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Int32

from flowlab.tracking.trackers.rigid_bodies import _kernels
from flowlab.tracking.trackers.rigid_bodies.features import ClipFeatures
from flowlab.tracking.trackers.rigid_bodies.motion import RigidMotion, best_rigid, orthonormal

_POINTS = 400
"""Points a body is followed by."""
_ITERATIONS = 6
_HARD, _WORSE = 0.4, 0.05
"""An energy above this, or this much above the last frame's, calls for a wider search."""
_LEAP, _IMPOSSIBLE = 0.15, 10.0
"""Nothing moves farther than this from one frame to the next [m]."""
_LOST, _GOOD = 0.4, 0.6
_SHIFTS = (-6.0, -3.0, -1.5, 0.0, 1.5, 3.0, 6.0)
_FAN_PX = np.array([(x, y, 0.0) for y in _SHIFTS for x in _SHIFTS])


@dataclass(frozen=True, slots=True)
class Body:
    """Pixels of the first frame that move as one."""

    pixels: Int32[np.ndarray, "n 2"]
    motion: RigidMotion
    """How they move; before they have been followed, a guess."""
    guessed: Bool[np.ndarray, "T"]
    """Frames in which the guess is worth a try."""
    region: Bool[np.ndarray, "h w"] | None = None
    """Cells of the grid it was last fitted to."""


class _Pack:
    """Some bodies, as arrays the kernels take; B bodies of n points."""

    def __init__(self, pictures: ClipFeatures, bodies: Sequence[Body], rng: np.random.Generator) -> None:
        self.pictures = pictures
        chosen = [b.pixels[_sample(len(b.pixels), rng)] for b in bodies]
        uv = np.stack(chosen)
        z = pictures.smooth[0, uv[..., 1], uv[..., 0]].astype(float)
        self.points = pictures.unproject(uv.astype(float), z)
        flat = uv.reshape(-1, 2).astype(np.float32)
        self.features = _kernels.features_at(pictures.feature[0], flat).reshape(*uv.shape[:2], 4)
        self.lightness = self.features[..., 1].astype(float)
        self.center = self.points.mean(1)
        self.last_center = self.center
        """Where the bodies' centers (B, 3) [m] were in the frame before the one looked at."""

    def energies(
        self, t: int, R: np.ndarray, s: np.ndarray, of: np.ndarray | slice = slice(None), every: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        """Energy and seen share (B', C) of candidate poses (B', C, 3, 3), (B', C, 3) in frame t."""
        p = self.pictures
        energy, seen = _kernels.energies(self.points[of], self.features[of], R, s, p.depth[t], p.feature[t], p.K, every)
        leap = np.linalg.norm(_turn(R, self.center[of][:, None]) + s - self.last_center[of][:, None], axis=-1)
        return energy + _IMPOSSIBLE * (leap > _LEAP), seen

    def align(
        self, t: int, R: np.ndarray, s: np.ndarray, lightness: np.ndarray, of: np.ndarray | slice = slice(None)
    ) -> tuple[np.ndarray, np.ndarray]:
        """Poses (B', 3, 3), (B', 3) refined on frame t, whose lightness is given."""
        p = self.pictures
        R, s = _kernels.align(
            self.points[of], self.lightness[of], R, s, lightness, p.smooth[t], p.normal[t], p.K, _ITERATIONS
        )
        return orthonormal(R), s


def _sample(n: int, rng: np.random.Generator) -> np.ndarray:
    if n == _POINTS:
        return np.arange(n)
    return rng.choice(n, _POINTS, replace=n < _POINTS)


def follow(pictures: ClipFeatures, bodies: Sequence[Body], rng: np.random.Generator) -> list[Body]:
    """The bodies with their motions found, all of them together, frame by frame."""
    if not bodies:
        return []
    pack, frames, count = _Pack(pictures, bodies, rng), len(pictures), len(bodies)
    R, s = np.tile(np.eye(3), (frames, count, 1, 1)), np.zeros((frames, count, 3))
    energy = np.zeros(count)
    seen_R, seen_s = R[0].copy(), s[0].copy()
    for t in range(1, frames):
        before = max(t - 2, 0)
        pack.last_center = _turn(R[t - 1], pack.center) + s[t - 1]
        R_step = R[t - 1] @ R[before].swapaxes(1, 2)
        s_step = s[t - 1] - _turn(R_step, s[before])
        guess_R = np.stack([b.motion.R[t] if b.guessed[t] else R[t - 1, k] for k, b in enumerate(bodies)])
        guess_s = np.stack([b.motion.t[t] if b.guessed[t] else s[t - 1, k] for k, b in enumerate(bodies)])
        poses = (
            np.stack([R[t - 1], seen_R, R_step @ R[t - 1], guess_R], 1),
            np.stack([s[t - 1], seen_s, _turn(R_step, s[t - 1]) + s_step, guess_s], 1),
        )
        best = _Best(*_choose(pack.energies(t, *poses), *poses))
        hard = np.flatnonzero((best.energy > _HARD) | (best.energy > energy + _WORSE))
        if len(hard):
            _search(pack, t, best, hard, R[t - 1], s[t - 1])
        lightness = pictures.lightness(t)
        best.try_poses(slice(None), *_evaluate(pack, t, *pack.align(t, best.R, best.s, lightness)), slack=1e-3)
        _attach(pack, t, best, R[t - 1], s[t - 1], lightness)
        R[t], s[t], energy = best.R, best.s, best.energy
        good = (best.seen > 0.4) & (energy < 0.5)
        seen_R[good], seen_s[good] = R[t, good], s[t, good]
    return [replace(b, motion=RigidMotion(R[:, k], s[:, k])) for k, b in enumerate(bodies)]


@dataclass(slots=True)
class _Best:
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


def _turn(R: np.ndarray, s: np.ndarray) -> np.ndarray:
    return (R @ s[..., None])[..., 0]


def _choose(
    valued: tuple[np.ndarray, np.ndarray], R: np.ndarray, s: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Of each body's candidates the best."""
    energy, seen = valued
    k = np.arange(len(energy)), energy.argmin(1)
    return R[k], s[k], energy[k], seen[k]


def _evaluate(
    pack: _Pack, t: int, R: np.ndarray, s: np.ndarray, of: np.ndarray | slice = slice(None)
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    energy, seen = pack.energies(t, R[:, None], s[:, None], of)
    return R, s, energy[:, 0], seen[:, 0]


def _search(pack: _Pack, t: int, best: _Best, hard: np.ndarray, last_R: np.ndarray, last_s: np.ndarray) -> None:
    """For bodies that no easy guess explains: optical flow of their own points, and shifts in the picture."""
    flow_R, flow_s = _by_flow(pack, t, best, hard, last_R, last_s)
    best.try_poses(hard, *_evaluate(pack, t, flow_R, flow_s, hard), slack=0)
    depth = _turn(best.R[hard], pack.center[hard])[:, 2] + best.s[hard, 2]
    fan = _FAN_PX / pack.pictures.K[0, 0] * depth[:, None, None]
    R = np.concatenate([np.repeat(x[hard][:, None], len(_FAN_PX), 1) for x in (best.R, last_R)], 1)
    s = np.concatenate([x[hard][:, None] + fan for x in (best.s, last_s)], 1)
    found = _choose(pack.energies(t, R, s, hard, every=3), R, s)
    best.try_poses(hard, *_evaluate(pack, t, found[0], found[1], hard), slack=0)


def _by_flow(
    pack: _Pack, t: int, best: _Best, hard: np.ndarray, last_R: np.ndarray, last_s: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The poses that optical flow of the points seen in the last frame asks for; the best where it asks for none."""
    pictures = pack.pictures
    height, width = pictures.depth.shape[1:]
    xyz = pack.points[hard] @ last_R[hard].swapaxes(1, 2) + last_s[hard][:, None]
    uv = pictures.project(xyz)
    j, i = np.clip(np.rint(uv), 0, [width - 1, height - 1]).astype(int).transpose(2, 0, 1)
    there = (uv >= 0).all(-1) & (uv[..., 0] <= width - 1) & (uv[..., 1] <= height - 1)
    there &= np.abs(pictures.depth[t - 1, i, j] - xyz[..., 2]) < 0.02
    there[:, np.arange(there.shape[1]) % 3 > 0] = False
    R, s = best.R[hard].copy(), best.s[hard].copy()
    which, point = np.nonzero(there)
    if len(which) == 0:
        return R, s
    q = uv[which, point] + pictures.flow[t, i[which, point], j[which, point]]
    ok = (q >= 0).all(1) & (q[:, 0] <= width - 1) & (q[:, 1] <= height - 1)
    j, i = np.clip(np.rint(q), 0, [width - 1, height - 1]).astype(int).T
    z = pictures.depth[t, i, j].astype(float)
    ok &= (z > 0) & (np.abs(z - xyz[which, point, 2]) < 0.03)
    target = pictures.unproject(q, z)
    for k in range(len(hard)):
        mine = ok & (which == k)
        if mine.sum() >= 6:
            weight = np.ones(int(mine.sum()))
            R[k], s[k] = best_rigid(pack.points[hard[k], point[mine]], target[mine], weight, 3, scale=0.004)
    return R, s


def _attach(pack: _Pack, t: int, best: _Best, last_R: np.ndarray, last_s: np.ndarray, lightness: np.ndarray) -> None:
    """A body that is lost may be held by one that is not: let it try the others' motions since the last frame."""
    lost = np.flatnonzero((best.energy > _LOST) | (best.seen < 0.35))
    good = np.flatnonzero((best.energy < _GOOD) & (best.seen > 0.4))
    if not (len(lost) and len(good)):
        return
    R_step = best.R[good] @ last_R[good].swapaxes(1, 2)
    s_step = best.s[good] - _turn(R_step, last_s[good])
    R = R_step[None] @ last_R[lost][:, None]
    s = _turn(R_step[None], last_s[lost][:, None]) + s_step
    found = _choose(pack.energies(t, R, s, lost), R, s)
    taken = best.try_poses(lost, *found, slack=-0.01)
    if len(taken):
        aligned = pack.align(t, best.R[taken], best.s[taken], lightness, taken)
        best.try_poses(taken, *_evaluate(pack, t, *aligned, taken), slack=0)
