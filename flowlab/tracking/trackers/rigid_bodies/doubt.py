"""How likely a point is far from where its motion takes it, told by how well that explains what is around it."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Float64
from scipy.spatial import cKDTree

from flowlab.tracking.trackers.rigid_bodies import _costs, _surfaces
from flowlab.tracking.trackers.rigid_bodies.bodies import RigidBodyFit
from flowlab.tracking.trackers.rigid_bodies.motion_segmentation import STEP
from flowlab.tracking.trackers.rigid_bodies.propagation import PropagatedTracks
from flowlab.tracking.trackers.rigid_bodies.rigid_motion import RigidMotion

EVIDENCE = (
    "1", "surroundings", "body", "other motions around", "still", "spread", "apart", "apart, expected", "undecided",
)  # fmt: skip
"""What doubt is told from, see :func:`evidence`."""
WEIGHTS = (-7.38, 4.65, 1.93, 3.50, 2.18, 0.15, 0.40, -0.02, 0.30)
"""Log-odds per unit of evidence. Fitted by ``benchmarks/calibrate_sigma.py`` as of commit ee6b5f3."""
FAR_M = 0.02
"""An error beyond this is far."""
_CELLS, _NEAR = 3000, 12
"""Cells at least that speak for the whole picture, and how many of them are a point's surroundings."""
_FRAMES_AT_ONCE = 128
_UNSEEN_COST = 0.6
"""What a cell counts that is not seen where its motion takes it."""


@dataclass(frozen=True, slots=True)
class SecondOpinion:
    """Where a tracker that knows nothing of bodies puts the same points."""

    xyz_cam: Float64[np.ndarray, "T M 3"]
    error_m: Float32[np.ndarray, "T M"]
    """What it states of its own error [m]."""


def probability_far(evidence: Float64[np.ndarray, "T M E"]) -> Float32[np.ndarray, "T M"]:
    """The probability that a position is off by more than ``FAR_M``, by a logistic regression on scenes with truth."""
    return (1 / (1 + np.exp(-evidence @ np.array(WEIGHTS)))).astype(np.float32)


def evidence(
    fit: RigidBodyFit, carried: PropagatedTracks, uv: Float[np.ndarray, "M 2"], z: Float[np.ndarray, "M"],
    other: SecondOpinion,
) -> Float64[np.ndarray, "T M E"]:  # fmt: skip
    """What speaks against positions.

    Args:
        fit: The motions, and which pixels are whose.
        carried: The points, as the fit carries them.
        uv: Their pixels in the first of the pictures of the fit.
        z: Their depths there [m].
        other: Where another tracker puts them.

    Returns:
        For every position, how badly frames fit around it, and in all that has its motion, 0 to 1; the share of its
        surroundings that has another motion; whether it is said to stand still; as logs of mm, how far motions that
        explain it almost as well would put it, how far the other tracker does, and how far that errs itself; and
        whether it was not seen to stay, or is near what moved.
    """
    pictures, grid, owner = fit.pictures, fit.grid, fit.assignment.best_motion
    at = np.argwhere(owner >= 0)
    at = at[:: max(1, len(at) // _CELLS)]
    cells = tuple(at.T)
    pixels = np.stack([grid.u[cells], grid.v[cells]], 1).astype(np.float32)
    xyz = pictures.unproject(pixels.astype(float), grid.depth[cells].astype(float))
    cost, seen = _fit_of_cells(fit, owner[cells], pixels, xyz)
    around = cKDTree(xyz).query(pictures.unproject(uv.astype(float), z.astype(float)), k=min(_NEAR, len(xyz)))[1]
    around = around.reshape(len(uv), -1)
    still = carried.motion == 0
    columns = (
        np.ones(seen.shape[:1] + still.shape),
        np.where(seen, cost, _UNSEEN_COST)[:, around].mean(2),
        _fit_of_motions(cost, seen, owner[cells], len(fit.motions))[:, carried.motion],
        (owner[cells][around] != carried.motion[:, None]).mean(1),
        still,
        np.log1p(1000 * carried.spread),
        np.log1p(1000 * np.linalg.norm(carried.xyz_cam - other.xyz_cam, axis=-1)),
        np.log1p(1000 * other.error_m),
        grid.undecided[tuple(np.minimum(np.rint(uv[:, ::-1] / STEP).astype(int), np.array(owner.shape) - 1).T)],
    )
    return np.stack([np.broadcast_to(c, columns[0].shape) for c in columns], -1).astype(np.float64)


def _fit_of_cells(
    fit: RigidBodyFit, motion: np.ndarray, pixels: np.ndarray, xyz: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """How badly every frame fits cells (T, n) where their motions take them, and whether they are seen there."""
    pictures = fit.pictures
    features = _costs.features_at(pictures.feature[0], pixels)
    cost, seen = np.empty((len(pictures), len(xyz)), np.float32), np.empty((len(pictures), len(xyz)), bool)
    for first in range(0, len(pictures), _FRAMES_AT_ONCE):
        now = slice(first, first + _FRAMES_AT_ONCE)
        path = np.empty((len(pictures.depth[now]), len(xyz), 3))
        for k, m in enumerate(fit.motions):
            path[:, motion == k] = RigidMotion(m.R[now], m.t[now]).apply(xyz[motion == k])
        uv, z = pictures.project(path), path[..., 2]
        cost[now] = _costs.residuals(pictures.depth[now], pictures.feature[now], features, uv, z)
        seen[now] = _surfaces.is_seen(pictures.depth[now], uv, z) & (cost[now] >= 0)
    return cost, seen


def _fit_of_motions(cost: np.ndarray, seen: np.ndarray, motion: np.ndarray, motions: int) -> np.ndarray:
    """How badly every frame fits the cells of every motion that are seen in it (T, B); 1 where none is."""
    total, count = np.zeros((2, len(cost), motions))
    for k in range(motions):
        mine = seen[:, motion == k]
        total[:, k], count[:, k] = (cost[:, motion == k] * mine).sum(1), mine.sum(1)
    return np.where(count > 0, total / np.maximum(count, 1), 1.0)
