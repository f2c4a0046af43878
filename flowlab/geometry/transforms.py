"""Rigid transforms as 4x4 matrices, and the 6D rotation of the MBA baseline."""

import numpy as np
from jaxtyping import Float


def rigid(R: Float[np.ndarray, "*batch 3 3"], t: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 4 4"]:
    """The 4x4 matrix of x -> R x + t."""
    T = np.zeros((*t.shape[:-1], 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = R, t, 1.0
    return T


def inverse(T: Float[np.ndarray, "*batch 4 4"]) -> Float[np.ndarray, "*batch 4 4"]:
    """The inverse of a rigid transform (exact for an orthonormal rotation)."""
    R = np.swapaxes(T[..., :3, :3], -1, -2)
    return rigid(R, -np.einsum("...ij,...j->...i", R, T[..., :3, 3]))


def apply(T: Float[np.ndarray, "*#batch 4 4"], xyz: Float[np.ndarray, "*#batch 3"]) -> Float[np.ndarray, "*out 3"]:
    """Transform points [m]; the batch dimensions broadcast."""
    return np.einsum("...ij,...j->...i", T[..., :3, :3], xyz) + T[..., :3, 3]


def pose_9d(T: Float[np.ndarray, "*batch 4 4"]) -> Float[np.ndarray, "*batch 9"]:
    """Position [m] and 6D rotation (first two columns of the rotation matrix, Zhou et al. 2019)."""
    return np.concatenate([T[..., :3, 3], T[..., :3, 0], T[..., :3, 1]], -1)


def rotation_from_6d(r: Float[np.ndarray, "*batch 6"]) -> Float[np.ndarray, "*batch 3 3"]:
    """The rotation matrix of a (not necessarily orthonormal) 6D rotation, by Gram-Schmidt."""
    x = r[..., :3] / np.linalg.norm(r[..., :3], axis=-1, keepdims=True)
    y = r[..., 3:] - (x * r[..., 3:]).sum(-1, keepdims=True) * x
    y = y / np.linalg.norm(y, axis=-1, keepdims=True)
    return np.stack([x, y, np.cross(x, y)], -1)
