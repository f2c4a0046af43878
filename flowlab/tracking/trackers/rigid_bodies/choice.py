"""Which motion carries a query point: told by the pictures, by where the point was followed in them, and by what is
around it."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64
from scipy.spatial import cKDTree

from flowlab.tracking.trackers.rigid_bodies import _costs
from flowlab.tracking.trackers.rigid_bodies.assignment import MOTION_PENALTY, motion_costs
from flowlab.tracking.trackers.rigid_bodies.bodies import RigidBodyFit
from flowlab.tracking.trackers.rigid_bodies.motion_segmentation import STEP, MotionGrid

_OWN_WEIGHT = 0.7
"""Weight of a point's own cost against one cell's that looks exactly like it."""
_ELSEWHERE, _ELSEWHERE_M, _LEAST_FOLLOWED = 0.4, 0.06, 3
"""What it costs a motion to carry a point elsewhere than where it was followed, how far off [m, at up to 1 m] is wholly
elsewhere, and in how many frames it must have been followed to tell."""
_BADLY_SHOWN = (0.5, 0.75)
"""Where the pictures explain a point at less than the first, they alone tell its motion, for beside what moves its
edge is followed; from the second on, where it was followed counts wholly."""
_FOREIGN = 0.3
"""What it costs that nothing around a point moves so."""
_UNEXPLAINED = (0.6, 0.85)
"""From this cost on no motion explains a point, and wholly from that: it is what is hidden nearly always that costs so
much, and then what is around it counts."""
_REACH_M, _CELL_COST = 0.03, 0.3
"""How far around a point [m] that is looked at, and the cost by which a cell says less of it, a factor e each."""


@dataclass(frozen=True, slots=True)
class FollowedPoints:
    """Points as a tracker that knows nothing of bodies follows them in the pictures."""

    xyz_cam: Float64[np.ndarray, "T M 3"]
    """[m]; filled where not measured."""
    believed: Bool[np.ndarray, "T M"]
    """Whether it sees them, looking as they did, and depth is read there."""


@dataclass(frozen=True, slots=True)
class MotionChoice:
    """The motions of M points."""

    motion: Int64[np.ndarray, "M"]
    cost: Float32[np.ndarray, "M"]
    """How badly it explains the point by the pictures; 0 is perfect, 1 is nothing like it."""
    against: Float32[np.ndarray, "B M"]
    """All that speaks against each motion."""


def choose_motions(
    fit: RigidBodyFit,
    uv: Float[np.ndarray, "M 2"],
    z: Float[np.ndarray, "M"],
    paths: Float64[np.ndarray, "B T M 3"],
    followed: FollowedPoints,
) -> MotionChoice:
    """The motion of every point against which least speaks.

    Args:
        fit: The motions, and which pixels are whose.
        uv: The points' pixels in the first of its pictures.
        z: Their depths there [m].
        paths: Where each motion takes them [m], in the camera frame; of the first frame, where they are.
        followed: Where another tracker does.
    """
    replaced = _replaced(fit.grid, uv)
    penalty = np.where(replaced, 0.0, MOTION_PENALTY)
    own = motion_costs(fit.pictures, fit.grid, fit.motions, uv, paths[0, 0], penalty)
    cost = _picture_costs(fit, uv, z, own, replaced)
    against = cost + _ELSEWHERE * _ramp(cost.min(0), *_BADLY_SHOWN) * _elsewhere(paths, followed)
    unexplained = _ramp(against.min(0), *_UNEXPLAINED)
    doubtful = np.flatnonzero(unexplained)
    around = _taken_around(fit, paths[0, 0, doubtful], replaced[doubtful])
    against[:, doubtful] += _FOREIGN * unexplained[doubtful] * (1 - around)
    motion = against.argmin(0)
    return MotionChoice(motion, cost[motion, np.arange(len(uv))], against.astype(np.float32))


def _ramp(cost: np.ndarray, low: float, high: float) -> np.ndarray:
    """0 up to a cost, 1 from another on."""
    return ((cost - low) / (high - low)).clip(0, 1)


def _cells(grid: MotionGrid, uv: Float[np.ndarray, "M 2"]) -> tuple[Int64[np.ndarray, "M"], Int64[np.ndarray, "M"]]:
    """Row and column of the cells that pixels lie in."""
    height, width = grid.valid.shape
    i, j = np.rint(uv[:, 1] / STEP).astype(int), np.rint(uv[:, 0] / STEP).astype(int)
    return i.clip(0, height - 1), j.clip(0, width - 1)


def _replaced(grid: MotionGrid, uv: Float[np.ndarray, "M 2"]) -> Bool[np.ndarray, "M"]:
    """Which points lie where something else is seen later, no less deep: as of a card that slides on a table.

    Nothing but the change tells such a thing from what it lies on. So what is known to stand still has no say in them,
    and that most things do is no reason to take it that they do.
    """
    at = _cells(grid, uv)
    return np.asarray(grid.changed[at] & ~grid.moved[at] & ~grid.edge[at])


def _picture_costs(
    fit: RigidBodyFit, uv: np.ndarray, z: np.ndarray, own: np.ndarray, replaced: np.ndarray
) -> Float32[np.ndarray, "B M"]:
    """The points' own costs (B, M) averaged with those of the cells around that are as deep and colored alike."""
    grid, height, width = fit.grid, *fit.grid.valid.shape
    features = _costs.features_at(fit.pictures.feature[0], uv.astype(np.float32))[:, 1:]
    cell_features = fit.pictures.feature[0, ::STEP, ::STEP, 1:].astype(np.float32)
    i, j = _cells(grid, uv)
    total, weights = _OWN_WEIGHT * own, np.full(len(uv), _OWN_WEIGHT)
    scale = np.array([_costs.L, _costs.A, _costs.B])
    for y in range(-3, 4):
        for x in range(-3, 4):
            a, b = np.clip(i + y, 0, height - 1), np.clip(j + x, 0, width - 1)
            far = np.abs(grid.depth[a, b] - z) / (0.01 * np.maximum(1, z))
            color = (np.abs(cell_features[a, b] - features) * scale).sum(1)
            has_say = grid.valid[a, b] & (grid.undecided[a, b] | ~replaced)
            w = has_say * np.exp(-np.minimum(far, 20) - color / 0.35 - (x * x + y * y) / 8)
            total = total + w * fit.assignment.raw[:, a, b]
            weights = weights + w
    return (total / weights).astype(np.float32)


def _elsewhere(paths: Float64[np.ndarray, "B T M 3"], followed: FollowedPoints) -> Float64[np.ndarray, "B M"]:
    """How far from where a point was followed each motion takes it, 0 to 1, in the mean over the frames that tell."""
    tells = followed.believed.copy()
    tells[0] = False
    tells &= tells.sum(0) >= _LEAST_FOLLOWED
    limit = _ELSEWHERE_M * np.maximum(1, followed.xyz_cam[..., 2])
    off = [np.minimum(np.linalg.norm(path - followed.xyz_cam, axis=-1) / limit, 1) for path in paths]
    return np.stack([(o * tells).sum(0) / np.maximum(tells.sum(0), 1) for o in off])


def _taken_around(
    fit: RigidBodyFit, xyz_cam: Float64[np.ndarray, "m 3"], replaced: Bool[np.ndarray, "m"]
) -> Float64[np.ndarray, "B m"]:
    """The share of what is around points of the first frame that takes each motion, what it explains best most."""
    cells = fit.grid.valid
    cost, owner = fit.assignment.cost[:, cells], fit.assignment.best_motion[cells]
    at = fit.pictures.unproject(fit.grid.pixels(cells).astype(float), fit.grid.depth[cells].astype(float))
    says, undecided = np.exp(-cost.min(0) / _CELL_COST), fit.grid.undecided[cells]
    share = np.full((len(cost), len(xyz_cam)), 1 / len(cost))
    tree = cKDTree(at)
    for k, point in enumerate(xyz_cam):  # one by one: of thousands of points near the camera, all lists take gigabytes
        near = np.array(tree.query_ball_point(point, 3 * _REACH_M), int)
        near = near[undecided[near]] if replaced[k] else near
        if len(near):
            weight = says[near] * np.exp(-np.linalg.norm(at[near] - point, axis=1) / _REACH_M)
            share[:, k] = np.bincount(owner[near], weight, len(cost)) / weight.sum()
    return share
