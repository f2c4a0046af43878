"""Rigid motions: a rotation and a translation for every frame, from where things are at the first."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64


@dataclass(frozen=True, slots=True)
class RigidMotion:
    """``x(t) = R[t] @ x(0) + t[t]``, in the camera frame [m]; the identity at frame 0."""

    R: Float64[np.ndarray, "T 3 3"]
    t: Float64[np.ndarray, "T 3"]

    @classmethod
    def still(cls, frames: int) -> "RigidMotion":
        """No motion at all."""
        return cls(np.tile(np.eye(3), (frames, 1, 1)), np.zeros((frames, 3)))

    def carry(self, xyz_cam: np.ndarray) -> Float64[np.ndarray, "T n 3"]:
        """Where the motion takes points (n, 3) of frame 0."""
        return xyz_cam @ self.R.swapaxes(1, 2) + self.t[:, None]


def best_rigid(
    a: np.ndarray, b: np.ndarray, weight: np.ndarray, refinements: int, scale: float = 0.006
) -> tuple[np.ndarray, np.ndarray]:
    """The rigid motions that best take points a onto b, robustly (Kabsch 1976, reweighted by Geman-McClure).

    a (..., n, 3), b (..., n, 3), weight (..., n), ``scale`` [m] of a residual that still counts.
    Returns R (..., 3, 3) and t (..., 3).
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


def orthonormal(R: np.ndarray) -> np.ndarray:
    """The nearest rotations to matrices (..., 3, 3)."""
    U, _, Vt = np.linalg.svd(R)
    return U @ Vt
