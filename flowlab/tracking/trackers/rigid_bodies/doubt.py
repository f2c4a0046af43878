"""How far a point may be from where its motion takes it, told by how well that explains what is around it."""

from dataclasses import dataclass
from functools import cache
from importlib.resources import files

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from flowlab.tracking.error_model import ErrorModel
from flowlab.tracking.trackers.rigid_bodies import _costs, _surfaces
from flowlab.tracking.trackers.rigid_bodies.bodies import RigidBodyFit
from flowlab.tracking.trackers.rigid_bodies.propagation import PropagatedTracks
from flowlab.tracking.trackers.rigid_bodies.rigid_motion import RigidMotion

EVIDENCE = {
    "surroundings": 1, "worst surroundings": 1, "misfit": 1, "worst misfit": 1, "other motions around": 1, "spread": 1,
    "apart": 1, "slippage": 1, "fastest": 1, "moved": 0, "camera moved": 0, "hidden for": 0, "still": 0,
    "cells": 0, "share of cells": 0, "out of view": 0, "turned": 0, "cost": 1, "gain": 0,
}  # fmt: skip
"""What doubt is told from, see :func:`evidence`, and whether more of it (1) never states less."""
_OF_SLIPPAGE = 0.5
"""So much of how far it could have moved unseen is stated at least: trees have seen few things that slide far."""
_CELLS, _NEAR = 3000, 12
"""Cells at least that speak for the whole picture, and how many of them are a point's surroundings."""
_FRAMES_AT_ONCE = 128
_UNSEEN_COST = 0.6
"""What a cell counts that is not seen where its motion takes it."""


def stated_error(
    evidence: Float64[np.ndarray, "*n E"], z: Float64[np.ndarray, "*n"], model: ErrorModel | None = None
) -> Float64[np.ndarray, "*n"]:
    """The error [m] that two in three of such positions stay below; more, where it is likely that they are far off, and
    where they could have moved far unseen.

    Args:
        evidence: Against them.
        z: Their depths [m].
        model: What tells errors; that of :func:`error_model` by default.
    """
    slippage = evidence[..., list(EVIDENCE).index("slippage")]
    return np.maximum((model or error_model()).stated_error(evidence, z), _OF_SLIPPAGE * slippage)


@cache
def error_model() -> ErrorModel:
    """What tells errors from that, as ``benchmarks/calibrate_sigma.py`` fitted it."""
    return ErrorModel.read(files(__package__) / "error_model.npz")


@dataclass(frozen=True, slots=True)
class _Cells:
    """Cells that speak for the whole picture."""

    xyz: Float64[np.ndarray, "n 3"]
    motion: Int64[np.ndarray, "n"]
    cost: Float32[np.ndarray, "T n"]
    """How badly every frame fits them."""
    out_of_view: Bool[np.ndarray, "T n"]
    """Whether their motion takes them out of the picture: nothing tells how well it fits them then."""

    def misfit(self, of: Int64[np.ndarray, "*m k"]) -> Float64[np.ndarray, "T *m"]:
        """How badly every frame fits those of them (in the mean) that it can show; what it can't is as if hidden."""
        shown = ~self.out_of_view[:, of]
        total = np.where(shown, self.cost[:, of], 0).sum(-1)
        return np.where(shown.any(-1), total / np.maximum(shown.sum(-1), 1), _UNSEEN_COST)


def evidence(
    fit: RigidBodyFit, carried: PropagatedTracks, uv: Float[np.ndarray, "M 2"], z: Float[np.ndarray, "M"],
    seen: Bool[np.ndarray, "T M"], other_xyz_cam: Float[np.ndarray, "T M 3"], slippage: Float[np.ndarray, "M"],
) -> Float64[np.ndarray, "T M E"]:  # fmt: skip
    """What speaks against positions.

    Args:
        fit: The motions, and which pixels are whose.
        carried: The points, as the fit carries them.
        uv: Their pixels in the first of the pictures of the fit.
        z: Their depths there [m].
        seen: Whether the sensor sees them.
        other_xyz_cam: Where a tracker that knows nothing of bodies puts them [m].
        slippage: How far they could move unseen [m].

    Returns:
        For every position, how badly the frame fits around it, and how badly one has so far, 0 to 1; the same of
        the point itself; the share of its surroundings that has another motion; how far [m] motions that explain it
        almost as well, and how far the other tracker, would put it; its slippage; the longest step of its body so far
        and how far it has moved [m], before what stands still; how far that has moved itself where it was found in the
        pictures; for how many frames it has been hidden; whether it is said to stand still; how many
        cells are its body's, also as a share of all; the share of its surroundings that is out of the picture; by how
        much its body has turned [rad]; how badly its motion explains it over all; and how much worse the cells of its
        body would be explained without it.
    """
    still, xyz_cam = fit.motions[0], fit.pictures.unproject(uv.astype(float), z.astype(float))
    moved = np.linalg.norm(_undo(still, carried.xyz_cam) - xyz_cam, axis=-1)
    camera_moved = np.linalg.norm(still.apply(xyz_cam) - xyz_cam, axis=-1) * fit.pictures.still_is_fitted
    cells = _cells(fit)
    around = cKDTree(cells.xyz).query(xyz_cam, k=min(_NEAR, len(cells.xyz)))[1].reshape(len(uv), -1)
    surroundings = cells.misfit(around)
    count = np.bincount(fit.assignment.best_motion[fit.assignment.best_motion >= 0], minlength=len(fit.motions))
    columns = (
        surroundings,
        np.maximum.accumulate(surroundings),
        carried.residual,
        np.maximum.accumulate(np.where(carried.visible, carried.residual, 0)),
        (cells.motion[around] != carried.motion[:, None]).mean(1),
        carried.spread,
        np.linalg.norm(carried.xyz_cam - other_xyz_cam, axis=-1),
        slippage,
        _fastest(fit)[:, carried.motion],
        moved,
        camera_moved,
        _frames_hidden(seen),
        carried.motion == 0,
        count[carried.motion],
        count[carried.motion] / max(count.sum(), 1),
        cells.out_of_view[:, around].mean(-1),
        _turned(fit)[:, carried.motion],
        carried.cost,
        fit.assignment.gain[carried.motion],
    )
    return np.stack([np.broadcast_to(c, seen.shape) for c in columns], -1).astype(np.float64)


def _cells(fit: RigidBodyFit) -> _Cells:
    pictures, grid, owner = fit.pictures, fit.grid, fit.assignment.best_motion
    at = np.argwhere(owner >= 0)
    cells = tuple(at[:: max(1, len(at) // _CELLS)].T)
    pixels = np.stack([grid.u[cells], grid.v[cells]], 1).astype(np.float32)
    xyz = pictures.unproject(pixels.astype(float), grid.depth[cells].astype(float))
    cost, seen, out_of_view = _fit_of_cells(fit, owner[cells], pixels, xyz)
    return _Cells(xyz, owner[cells], np.where(seen, cost, _UNSEEN_COST), out_of_view)


def _undo(motion: RigidMotion, xyz_cam: Float[np.ndarray, "T n 3"]) -> Float64[np.ndarray, "T n 3"]:
    """Where points of every frame were at the first, had they moved so."""
    return (xyz_cam - motion.t[:, None]) @ motion.R


def _fastest(fit: RigidBodyFit) -> Float64[np.ndarray, "T B"]:
    """The longest step [m] that the middle of each body has made so far, before what stands still."""
    owner, grid, steps = fit.assignment.best_motion, fit.grid, np.zeros((len(fit.pictures), len(fit.motions)))
    for k, motion in enumerate(fit.motions):
        cells = owner == k
        if cells.any():
            pixels = np.stack([grid.u[cells], grid.v[cells]], 1).astype(float)
            middle = fit.pictures.unproject(pixels, grid.depth[cells].astype(float)).mean(0, keepdims=True)
            path = _undo(fit.motions[0], motion.apply(middle))[:, 0]
            steps[1:, k] = np.linalg.norm(np.diff(path, axis=0), axis=1)
    return np.maximum.accumulate(steps)


def _turned(fit: RigidBodyFit) -> Float64[np.ndarray, "T B"]:
    """The angle [rad] by which each body is turned, before what stands still."""
    back = fit.motions[0].R.swapaxes(1, 2)
    return np.stack([Rotation.from_matrix(m.R @ back).magnitude() for m in fit.motions], 1)


def _frames_hidden(seen: Bool[np.ndarray, "T M"]) -> Float64[np.ndarray, "T M"]:
    """For how many frames each point has been out of sight."""
    frame = np.arange(len(seen), dtype=float)[:, None]
    return frame - np.maximum.accumulate(np.where(seen, frame, -1))


def _fit_of_cells(
    fit: RigidBodyFit, motion: np.ndarray, pixels: np.ndarray, xyz: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """How badly every frame fits cells (T, n) where their motions take them, whether they are seen there, and whether
    that is out of the picture."""
    pictures = fit.pictures
    features = _costs.features_at(pictures.feature[0], pixels)
    cost, seen = np.empty((len(pictures), len(xyz)), np.float32), np.empty((len(pictures), len(xyz)), bool)
    outside, (height, width) = seen.copy(), pictures.depth.shape[1:]
    for first in range(0, len(pictures), _FRAMES_AT_ONCE):
        now = slice(first, first + _FRAMES_AT_ONCE)
        path = np.empty((len(pictures.depth[now]), len(xyz), 3))
        for k, m in enumerate(fit.motions):
            path[:, motion == k] = RigidMotion(m.R[now], m.t[now]).apply(xyz[motion == k])
        uv, z = pictures.project(path), path[..., 2]
        cost[now] = _costs.residuals(pictures.depth[now], pictures.feature[now], features, uv, z)
        seen[now] = _surfaces.is_seen(pictures.depth[now], uv, z) & (cost[now] >= 0)
        outside[now] = (uv < 0).any(-1) | (uv > [width - 1, height - 1]).any(-1) | (z <= 0)
    return cost, seen, outside
