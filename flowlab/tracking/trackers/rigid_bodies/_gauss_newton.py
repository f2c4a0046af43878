"""Pose refinement by Gauss-Newton, compiled: lightness and distance to the surface, both robustly.

Positions are meters in the camera frame; pixels have integer centers.
"""

# mypy: ignore-errors
import numba
import numpy as np

_GRAY_SCALE, _DEPTH_SCALE = 12.0, 0.004
"""Residuals that count as one standard deviation: lightness [counts], distance to the surface [m]."""


@numba.njit(cache=True)
def align(points, lightness, R, t, lightness_picture, smooth, normal, K, iterations) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Newton of every body's pose against one frame: lightness and distance to the surface, robustly.

    points (B, n, 3), lightness (B, n), R (B, 3, 3), t (B, 3); ``lightness_picture`` and ``smooth`` (H, W)
    float32, ``normal`` (H, W, 3) int8 in 1/127. Returns the new R and t.
    """
    bodies, n = lightness.shape
    R, t = R.copy(), t.copy()
    X, gray = np.empty((n, 3)), np.empty((n, 3))
    for b in range(bodies):
        for _ in range(iterations):
            m, center = _compare(points[b], lightness[b], R[b], t[b], lightness_picture, smooth, K, X, gray)
            if m < 6:
                break
            step = _damped_step(*_normal_equations(X[:m], gray[:m], center, smooth, normal, K), m)
            turn = np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
            if turn > 0.1:
                for a in range(6):
                    step[a] *= 0.1 / turn
            _move(R[b], t[b], step, center)
            if turn < 2e-4 and np.sqrt(step[3] ** 2 + step[4] ** 2 + step[5] ** 2) < 5e-5:
                break
    return R, t


@numba.njit(cache=True)
def _move(R, t, step, center) -> None:
    """Turn a pose about the center and shift it, in place: number by number, which compiles in a fifth of the time."""
    dR, old_R, old_t = _rotation(step), R.copy(), t.copy()
    for i in range(3):
        t[i] = center[i] + step[3 + i]
        for k in range(3):
            t[i] += dR[i, k] * (old_t[k] - center[k])
        for j in range(3):
            R[i, j] = dR[i, 0] * old_R[0, j] + dR[i, 1] * old_R[1, j] + dR[i, 2] * old_R[2, j]


@numba.njit(cache=True)
def _compare(points, lightness, R, t, lightness_picture, smooth, K, X, gray) -> tuple[int, np.ndarray]:
    """Find the points that the pose puts on the surface that is seen there; how many, and their center.

    Fills in ``X`` (n, 3), where they are [m], and ``gray`` (n, 3): how much lighter the picture is there, and how
    that changes to the right and down [counts, counts/px].
    """
    height, width = smooth.shape
    m, center = 0, np.zeros(3)
    for k in range(len(points)):
        p = points[k]
        for a in range(3):
            X[m, a] = R[a, 0] * p[0] + R[a, 1] * p[1] + R[a, 2] * p[2] + t[a]
        z = X[m, 2]
        if z < 0.05:
            continue
        u, v = X[m, 0] / z * K[0, 0] + K[0, 2], X[m, 1] / z * K[1, 1] + K[1, 2]
        if not (u > 1 and v > 1 and u < width - 2 and v < height - 2):
            continue
        d = smooth[int(v + 0.5), int(u + 0.5)]
        if d == 0 or abs(d - z) > 0.02 * max(1.0, z * z):
            continue
        for a in range(3):
            center[a] += X[m, a]
        value, gray[m, 1], gray[m, 2] = _value_and_gradient(lightness_picture, u, v)
        gray[m, 0] = value - lightness[k]
        m += 1
    for a in range(3):
        center[a] /= max(m, 1)
    return m, center


@numba.njit(cache=True, inline="always")
def _value_and_gradient(picture, u, v) -> tuple[float, float, float]:
    """A picture between its pixels: its value, and its central differences interpolated alike."""
    i, j = int(v), int(u)
    a, b = u - j, v - i
    p00, p01, p10, p11 = picture[i, j], picture[i, j + 1], picture[i + 1, j], picture[i + 1, j + 1]
    value = (1 - b) * ((1 - a) * p00 + a * p01) + b * ((1 - a) * p10 + a * p11)
    top = (1 - a) * (p01 - picture[i, j - 1]) + a * (picture[i, j + 2] - p00)
    bottom = (1 - a) * (p11 - picture[i + 1, j - 1]) + a * (picture[i + 1, j + 2] - p10)
    left = (1 - b) * (p10 - picture[i - 1, j]) + b * (picture[i + 2, j] - p00)
    right = (1 - b) * (p11 - picture[i - 1, j + 1]) + b * (picture[i + 2, j + 1] - p01)
    return value, 0.5 * ((1 - b) * top + b * bottom), 0.5 * ((1 - a) * left + a * right)


@numba.njit(cache=True)
def _normal_equations(X, gray, center, smooth, normal, K) -> tuple[np.ndarray, np.ndarray, float]:
    """H (6, 6) and g (6,) of a rotation about the center and a translation, and the squared spread of the points."""
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    brighter = np.median(gray[:, 0])  # the light may change as a whole
    H, g, spread = np.zeros((6, 6)), np.zeros(6), 0.0
    for k in range(len(X)):
        x, y, z = X[k, 0], X[k, 1], X[k, 2]
        rx, ry, rz = x - center[0], y - center[1], z - center[2]
        spread += rx * rx + ry * ry + rz * rz
        r = gray[k, 0] - brighter
        w = 1 / _GRAY_SCALE**2 / (1 + (r / _GRAY_SCALE) ** 2) ** 2
        jx, jy = gray[k, 1] * fx / z, gray[k, 2] * fy / z
        jz = -(jx * x + jy * y) / z
        _accumulate(H, g, rx, ry, rz, jx, jy, jz, r, w)
        u, v = x / z * fx + cx, y / z * fy + cy
        i, j = int(v + 0.5), int(u + 0.5)
        nx, ny, nz = normal[i, j, 0] / 127.0, normal[i, j, 1] / 127.0, normal[i, j, 2] / 127.0
        if nx == 0 and ny == 0 and nz == 0:
            continue
        d = smooth[i, j]
        r = (x - (u - cx) / fx * d) * nx + (y - (v - cy) / fy * d) * ny + (z - d) * nz
        scale = _DEPTH_SCALE * max(1.0, z) ** 2
        w = 1 / scale**2 / (1 + (r / (2.5 * _DEPTH_SCALE)) ** 2) ** 2
        _accumulate(H, g, rx, ry, rz, nx, ny, nz, r, w)
    return H, g, spread


@numba.njit(cache=True)
def _damped_step(H, g, spread, m) -> np.ndarray:
    """The step (6,) of ``m`` points, damped, so that what the frame does not tell stays as it was."""
    extent = max(np.sqrt(spread / m / 3), 0.01)
    for a in range(3):
        H[a, a] += m * 0.001 * (extent / _DEPTH_SCALE) ** 2 + 1
        H[3 + a, 3 + a] += m * 0.002 / _DEPTH_SCALE**2 + 1
    return _solve(H, -g)


@numba.njit(cache=True)
def _solve(H, g) -> np.ndarray:
    """The x of H x = g for a positive definite H (n, n), by Cholesky: ``np.linalg.solve`` takes 11 s to compile."""
    n = len(g)
    L, x = np.zeros((n, n)), g.copy()
    for i in range(n):
        for j in range(i + 1):
            rest = H[i, j]
            for k in range(j):
                rest -= L[i, k] * L[j, k]
            L[i, j] = np.sqrt(rest) if i == j else rest / L[j, j]
    for i in range(n):
        for k in range(i):
            x[i] -= L[i, k] * x[k]
        x[i] /= L[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            x[i] -= L[k, i] * x[k]
        x[i] /= L[i, i]
    return x


@numba.njit(cache=True, inline="always")
def _accumulate(H, g, rx, ry, rz, jx, jy, jz, r, w) -> None:
    """Add one residual, whose derivative by the point's position is (jx, jy, jz), to the normal equations: to what is
    on and below the diagonal, which Cholesky reads."""
    a = (ry * jz - rz * jy, rz * jx - rx * jz, rx * jy - ry * jx, jx, jy, jz)
    for i in range(6):
        wa = w * a[i]
        g[i] += wa * r
        for j in range(i + 1):
            H[i, j] += wa * a[j]


@numba.njit(cache=True)
def _rotation(w) -> np.ndarray:
    """The rotation (3, 3) by a rotation vector, the first three numbers."""
    angle = np.sqrt(w[0] ** 2 + w[1] ** 2 + w[2] ** 2) + 1e-12
    x, y, z = w[0] / angle, w[1] / angle, w[2] / angle
    s, c = np.sin(angle), 1 - np.cos(angle)
    R = np.eye(3)
    R[0, 0] -= c * (y * y + z * z)
    R[1, 1] -= c * (x * x + z * z)
    R[2, 2] -= c * (x * x + y * y)
    R[0, 1] += c * x * y - s * z
    R[1, 0] += c * x * y + s * z
    R[0, 2] += c * x * z + s * y
    R[2, 0] += c * x * z - s * y
    R[1, 2] += c * y * z - s * x
    R[2, 1] += c * y * z + s * x
    return R
