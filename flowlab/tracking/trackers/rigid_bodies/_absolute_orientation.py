"""The rigid motion that takes points onto others, compiled: by quaternions (Horn 1987), so never a reflection."""

# mypy: ignore-errors
import numba
import numpy as np

_SWEEPS = 12
"""Of Jacobi's rotations; six leave nothing of what is off the diagonal of a 4x4 matrix."""


@numba.njit(cache=True)
def fit_rigid(a, b, weight, refinements, scale) -> tuple[np.ndarray, np.ndarray]:
    """R (N, 3, 3) and t (N, 3) for points a, b (N, n, 3) and weights (N, n); see
    :func:`~flowlab.tracking.trackers.rigid_bodies.rigid_motion.fit_rigid`."""
    batch, n = weight.shape
    R, t, w = np.empty((batch, 3, 3)), np.empty((batch, 3)), np.empty(n)
    for k in range(batch):
        for i in range(n):
            w[i] = weight[k, i]
        for step in range(refinements + 1):
            _weighted_fit(a[k], b[k], w, R[k], t[k])
            if step < refinements:
                for i in range(n):
                    w[i] = weight[k, i] / (1 + _squared_residual(a[k, i], b[k, i], R[k], t[k]) / scale**2) ** 2
    return R, t


@numba.njit(cache=True)
def _weighted_fit(a, b, w, R, t) -> None:
    """The best motion for weights (n,), into R (3, 3) and t (3,)."""
    total = max(w.sum(), 1e-12)
    center, H = np.zeros((2, 3)), np.zeros((3, 3))
    for i in range(len(w)):
        for c in range(3):
            center[0, c] += w[i] / total * a[i, c]
            center[1, c] += w[i] / total * b[i, c]
    for i in range(len(w)):
        for c in range(3):
            left = w[i] / total * (a[i, c] - center[0, c])
            for d in range(3):
                H[c, d] += left * (b[i, d] - center[1, d])
    _rotation(H, R)
    for c in range(3):
        t[c] = center[1, c] - R[c, 0] * center[0, 0] - R[c, 1] * center[0, 1] - R[c, 2] * center[0, 2]


@numba.njit(cache=True, inline="always")
def _squared_residual(p, q, R, t) -> float:
    off = 0.0
    for c in range(3):
        off += (R[c, 0] * p[0] + R[c, 1] * p[1] + R[c, 2] * p[2] + t[c] - q[c]) ** 2
    return off


@numba.njit(cache=True)
def _rotation(H, R) -> None:
    """The rotation that a covariance (3, 3) of points and where they go asks for, into R (3, 3); the identity where it
    asks for none."""
    N, V = np.empty((4, 4)), np.eye(4)
    N[0, 0] = H[0, 0] + H[1, 1] + H[2, 2] + 1e-12
    N[0, 1] = N[1, 0] = H[1, 2] - H[2, 1]
    N[0, 2] = N[2, 0] = H[2, 0] - H[0, 2]
    N[0, 3] = N[3, 0] = H[0, 1] - H[1, 0]
    for i in range(3):
        N[i + 1, i + 1] = 2 * H[i, i] - (H[0, 0] + H[1, 1] + H[2, 2])
        for j in range(i):
            N[i + 1, j + 1] = N[j + 1, i + 1] = H[i, j] + H[j, i]
    for _ in range(_SWEEPS):
        if _sweep(N, V) == 0:
            break
    best = 0
    for i in range(1, 4):
        if N[i, i] > N[best, best]:
            best = i
    w, x, y, z = V[0, best], V[1, best], V[2, best], V[3, best]
    R[0, 0], R[0, 1], R[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    R[1, 0], R[1, 1], R[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    R[2, 0], R[2, 1], R[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)


@numba.njit(cache=True)
def _sweep(N, V) -> int:
    """Jacobi's rotations of a symmetric matrix (4, 4) by all its pairs, in place, and of its eigenvectors, the columns
    of V; how many there were to make."""
    made = 0
    for p in range(3):
        for q in range(p + 1, 4):
            if abs(N[p, q]) <= 1e-16 * (abs(N[p, p]) + abs(N[q, q])):
                continue
            made += 1
            theta = (N[q, q] - N[p, p]) / (2 * N[p, q])
            tangent = (1 if theta >= 0 else -1) / (abs(theta) + np.sqrt(theta * theta + 1))
            c = 1 / np.sqrt(tangent * tangent + 1)
            s = tangent * c
            for i in range(4):
                N[i, p], N[i, q] = c * N[i, p] - s * N[i, q], s * N[i, p] + c * N[i, q]
            for i in range(4):
                N[p, i], N[q, i] = c * N[p, i] - s * N[q, i], s * N[p, i] + c * N[q, i]
                V[i, p], V[i, q] = c * V[i, p] - s * V[i, q], s * V[i, p] + c * V[i, q]
            N[p, q] = N[q, p] = 0.0
    return made
