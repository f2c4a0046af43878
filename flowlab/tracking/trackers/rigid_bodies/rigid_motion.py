"""Rigid motions: a rotation and a translation for every frame, from where things are at the first."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64

from flowlab.tracking.trackers.rigid_bodies import _absolute_orientation


@dataclass(frozen=True, slots=True)
class RigidMotion:
    """``x(t) = R[t] @ x(0) + t[t]``, in the camera frame [m]; the identity at frame 0."""

    R: Float64[np.ndarray, "T 3 3"]
    t: Float64[np.ndarray, "T 3"]

    @classmethod
    def identity(cls, frames: int) -> "RigidMotion":
        """No motion at all."""
        return cls(np.tile(np.eye(3), (frames, 1, 1)), np.zeros((frames, 3)))

    def apply(self, xyz_cam: Float[np.ndarray, "n 3"]) -> Float64[np.ndarray, "T n 3"]:
        """Where the motion takes points of frame 0 [m]."""
        return xyz_cam @ self.R.swapaxes(1, 2) + self.t[:, None]

    def __matmul__(self, first: "RigidMotion") -> "RigidMotion":
        """The motion that another one and then this one are."""
        return RigidMotion(self.R @ first.R, np.einsum("tij,tj->ti", self.R, first.t) + self.t)


def fit_rigid(
    a: Float[np.ndarray, "*#batch n 3"],
    b: Float[np.ndarray, "*#batch n 3"],
    weight: Float[np.ndarray, "*#batch n"],
    refinements: int,
    scale: float = 0.006,
) -> tuple[Float64[np.ndarray, "*out 3 3"], Float64[np.ndarray, "*out 3"]]:
    """The rigid motions that best take points onto others (Horn 1987, reweighted by Geman-McClure).

    Args:
        a: Points [m]; leading dimensions broadcast.
        b: Where each of them should go [m].
        weight: How much each counts; where all are 0, the motion is the identity.
        refinements: How many times what does not fit is weighed down.
        scale: A residual [m] that still counts.

    Returns:
        R and t, so that ``b`` is near ``R @ a + t``. R is a rotation, never a reflection, also where points on a
        line or in a plane leave one open.
    """
    batch = np.broadcast_shapes(a.shape[:-2], b.shape[:-2], weight.shape[:-1])
    n = weight.shape[-1]
    points = (np.broadcast_to(x, (*batch, n, 3)).reshape(-1, n, 3).astype(float) for x in (a, b))
    flat = np.broadcast_to(weight, (*batch, n)).reshape(-1, n).astype(float)
    R, t = _absolute_orientation.fit_rigid(*points, flat, refinements, scale)
    return R.reshape(*batch, 3, 3), t.reshape(*batch, 3)


def nearest_rotation(R: Float64[np.ndarray, "*batch 3 3"]) -> Float64[np.ndarray, "*batch 3 3"]:
    """The orthogonal matrices nearest to some that are nearly rotations."""
    U, _, Vt = np.linalg.svd(R)
    return U @ Vt
