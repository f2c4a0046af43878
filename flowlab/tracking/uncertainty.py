"""The stated error of every tracked position, from what is known when it is made."""

from functools import cache
from importlib.resources import files

import numpy as np
from jaxtyping import Float32, Float64

from flowlab.records import Clip, PositionSource, Tracks2D
from flowlab.tracking.error_model import ErrorModel, log_scale
from flowlab.tracking.lifting import Lifted

EVIDENCE = {
    "moved": 0, "disagreement": 1, "forward-backward": 1, "misfit": 1, "hidden": 0, "no depth": 0,
    "hidden for": 1, "filled": 1,
}  # fmt: skip
"""What the error is told from, see :func:`evidence`, and whether more of it (1) never states less."""
MODEL_WEIGHTS = (-7.404, (0.089, 0.000, 0.000, 2.997, 0.000, 0.524, 0.216, 0.000))
"""Log of the error [m], at a depth of 1 m, of what a model gives that states none: a constant, and a weight for each
evidence. Fitted to ``rigid-bodies`` as of commit ee6b5f3."""
_LEAST_M, _MOST_M = 0.0005, 1.0


def stated_error(clip: Clip, tracks: Tracks2D, lifted: Lifted) -> Float32[np.ndarray, "T M"]:
    """The error [m] that two in three of such positions stay below, and more where it is likely that they are far off:
    where a model gives the position, what the tracker states of it (:attr:`Tracks2D.sigma`); elsewhere by what
    ``lucas-kanade`` was like on scenes with truth.

    The point at the first frame is the query itself: its error is the sensor's, at most what any other row states.
    """
    values, z = evidence(clip, tracks, lifted), clip.to_camera(lifted.xyz_world)[..., 2]
    error = error_model().stated_error(values, z)
    modeled = lifted.source == PositionSource.MODEL
    constant, weights = MODEL_WEIGHTS
    error[modeled] = np.exp(constant + values[modeled] @ weights + log_scale(z[modeled]))
    if tracks.sigma is not None:
        own = modeled & (tracks.sigma >= 0)
        error[own] = tracks.sigma[own]
    return error.clip(_LEAST_M, _MOST_M).astype(np.float32)


@cache
def error_model() -> ErrorModel:
    """What tells errors of positions that no model gives, as ``benchmarks/calibrate_sigma.py`` fitted it."""
    return ErrorModel.read(files(__package__) / "error_model.npz")


def evidence(clip: Clip, tracks: Tracks2D, lifted: Lifted) -> Float64[np.ndarray, "T M E"]:
    """What tells the error of every position: logs of how far it has moved, how far apart other estimates put it, and
    how far it lands when followed back; how badly it fits the pictures (0 to 1); whether it is hidden, or without
    depth; the log of for how many frames it has been hidden; and whether it is filled."""
    xyz_cam = clip.to_camera(lifted.xyz_world)
    z = np.maximum(xyz_cam[..., 2], 0.05)
    meters_per_px = z / clip.camera.K[0, 0]
    moved = np.linalg.norm(lifted.xyz_world - lifted.xyz_world[:1], axis=-1)
    if clip.T_world_cam is not None:  # what stands still was followed through the pictures, too
        moved = np.maximum(moved, np.linalg.norm(xyz_cam - xyz_cam[:1], axis=-1))
    columns = (
        _log_mm(moved),
        _log_mm(_known(tracks.disagreement, z) * meters_per_px),
        _log_mm(_known(tracks.forward_backward, z) * meters_per_px),
        1 - tracks.confidence
        if tracks.residual is None
        else np.where(tracks.residual < 0, 1 - tracks.confidence, tracks.residual),
        ~lifted.visible,
        ~lifted.depth_valid,
        np.log1p(_frames_hidden(lifted.visible)),
        lifted.source == PositionSource.FILLED,
    )
    return np.stack([np.asarray(c, float) for c in columns], -1)


def _log_mm(meters: np.ndarray) -> np.ndarray:
    """Log of a length in mm, of which the first is free."""
    return np.log1p(1000 * meters)


def _known(values: np.ndarray | None, like: np.ndarray) -> np.ndarray:
    """The values, 0 where they are not known."""
    return np.zeros_like(like) if values is None else np.maximum(values, 0)


def _frames_hidden(visible: np.ndarray) -> np.ndarray:
    """For how many frames (T, M) each point has been out of sight."""
    count = np.zeros(visible.shape)
    for t in range(1, len(visible)):
        count[t] = (count[t - 1] + 1) * ~visible[t]
    return count
