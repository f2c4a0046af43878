"""Rigid motions: a rotation and a translation for every frame, from where things are at the first."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64


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
    """The rigid motions that best take points onto others (Kabsch 1976, reweighted by Geman-McClure).

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
    w = weight.astype(float)
    for k in range(refinements + 1):
        share = (w / np.maximum(w.sum(-1, keepdims=True), 1e-12))[..., None]
        center_a, center_b = (share * a).sum(-2), (share * b).sum(-2)
        H = np.swapaxes(share * (a - center_a[..., None, :]), -1, -2) @ (b - center_b[..., None, :])
        U, _, Vt = np.linalg.svd(H + 1e-12 * np.eye(3))
        flip = np.ones((*U.shape[:-2], 3))
        flip[..., 2] = np.sign(np.linalg.det(U @ Vt))
        R = np.swapaxes(U * flip[..., None, :] @ Vt, -1, -2)
        t = center_b - (R @ center_a[..., None])[..., 0]
        if k < refinements:
            off = np.linalg.norm(a @ np.swapaxes(R, -1, -2) + t[..., None, :] - b, axis=-1)
            w = weight / (1 + (off / scale) ** 2) ** 2
    return R, t


def nearest_rotation(R: Float64[np.ndarray, "*batch 3 3"]) -> Float64[np.ndarray, "*batch 3 3"]:
    """The orthogonal matrices nearest to some that are nearly rotations."""
    U, _, Vt = np.linalg.svd(R)
    return U @ Vt
