"""Where query points go: each with the motion that explains it and its surroundings best."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64
from scipy.ndimage import convolve

from flowlab.tracking.trackers.rigid_bodies import _costs, _surfaces
from flowlab.tracking.trackers.rigid_bodies.bodies import RigidBodyFit
from flowlab.tracking.trackers.rigid_bodies.choice import FollowedPoints, choose_motions
from flowlab.tracking.trackers.rigid_bodies.proposals import flow

_REFINE_FRAMES, _REFINE_PRIOR = 4, 3.0
"""Frames to either side over which readings of the surface are averaged, and the weight of no shift among them."""
_LEAST_TEXTURE, _FLOW_NOISE_PX = 2e-3, 0.1
"""Optical flow is believed where there is this much texture, and where it differs by more than this."""
_COST_SCALE = 0.06
"""A cost this much higher explains a point almost as well."""


@dataclass(frozen=True, slots=True)
class PropagatedTracks:
    """Query points, carried by the motions of a fit."""

    xyz_cam: Float64[np.ndarray, "T M 3"]
    visible: Bool[np.ndarray, "T M"]
    motion: Int64[np.ndarray, "M"]
    """Index of each query's motion."""
    cost: Float32[np.ndarray, "M"]
    """How badly that explains the point; 0 is perfect, 1 is nothing like it."""
    spread: Float64[np.ndarray, "T M"]
    """How far [m] the motions that explain the point almost as well would put it from there."""
    slip: Float64[np.ndarray, "T M"]
    """How far [m] optical flow has led away from there."""
    residual: Float32[np.ndarray, "T M"]
    """How badly color and depth fit at that very frame, 0 to 1; where the point is hidden, its cost."""


def propagate(
    fit: RigidBodyFit, uv: Float[np.ndarray, "M 2"], z: Float[np.ndarray, "M"], followed: FollowedPoints
) -> PropagatedTracks:
    """Carry points of the first frame through the clip.

    Args:
        fit: The motions, and which pixels are whose.
        uv: The points' pixels in the pictures of the fit.
        z: Their depths there [m].
        followed: The same points, followed in the pictures.
    """
    xyz = fit.pictures.unproject(uv.astype(float), z.astype(float))
    every = np.stack([m.apply(xyz) for m in fit.motions])
    choice = choose_motions(fit, uv, z, every, followed)
    path = every[choice.motion, :, np.arange(len(uv))].swapaxes(0, 1)
    path = _refine_depth(fit, path, (choice.motion > 0) | fit.pictures.still_is_fitted)
    seen = _surfaces.is_seen(fit.pictures.depth, fit.pictures.project(path), path[..., 2])
    belief = np.exp(-(choice.against - choice.against.min(0)) / _COST_SCALE)
    belief /= belief.sum(0)
    spread = np.sqrt(np.einsum("bm,btm->tm", belief, ((every - path) ** 2).sum(-1)))
    return PropagatedTracks(
        path, seen, choice.motion, choice.cost, spread, _slip(fit, path, seen),
        _residual(fit, uv, path, seen, choice.cost),
    )  # fmt: skip


def _refine_depth(fit: RigidBodyFit, path: np.ndarray, moving: np.ndarray) -> np.ndarray:
    """Paths (T, M, 3), of points whose motion was fitted shifted along their rays to the surface read there, smoothly.

    What is left of a pose's error changes slowly, while the sensor's changes from frame to frame; a still point
    is left alone where the camera's poses are given, since it has no pose to err.
    """
    z = path[..., 2]
    off = _surfaces.depth_offsets(fit.pictures.depth, fit.pictures.project(path), z)
    off[:, ~moving], off[0] = np.nan, 0
    known = np.isfinite(off).astype(float)
    window = np.hanning(2 * _REFINE_FRAMES + 3)[1:-1, None]
    total, weight = (convolve(x, window, mode="constant") for x in (np.nan_to_num(off), known))
    smooth = total / (weight + _REFINE_PRIOR)
    smooth[0] = 0
    return path * (1 + smooth / np.maximum(z, 0.05))[..., None]


def _slip(fit: RigidBodyFit, path: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """How far [m] optical flow has led away (T, M) from the paths, where the points are seen: steps of both are
    compared in every frame, and added up, since what is left behind by a wrong path is not seen there any more."""
    uv, z = fit.pictures.project(path), path[..., 2]
    slip = np.zeros_like(path[..., :2])
    for t in range(1, len(path)):
        slip[t] = slip[t - 1]
        mine = np.flatnonzero(seen[t - 1] & seen[t])
        if len(mine):
            to, found = flow(fit.pictures, t, uv[t - 1, mine], _LEAST_TEXTURE)
            off = to - uv[t, mine]
            found &= np.linalg.norm(off, axis=1) > _FLOW_NOISE_PX
            slip[t, mine[found]] += off[found]
    return np.linalg.norm(slip, axis=-1) * z / fit.pictures.K[0, 0]


def _residual(fit: RigidBodyFit, uv: np.ndarray, path: np.ndarray, seen: np.ndarray, cost: np.ndarray) -> np.ndarray:
    """How badly every frame fits (T, M), where the point is seen; its cost where not."""
    features = _costs.features_at(fit.pictures.feature[0], uv.astype(np.float32))
    p = fit.pictures
    now = _costs.residuals(p.depth, p.feature, features, p.project(path), path[..., 2])
    return np.where(seen & (now >= 0), now, cost.clip(0, 1)).astype(np.float32)
