"""The inner loops of the rigid-body fit, compiled.

Positions are meters in the camera frame; pixels have integer centers.
"""

# mypy: ignore-errors
import numba
import numpy as np

SURFACE_TOLERANCE = 0.010
"""A depth this near a claimed surface [m, at up to 1 m; growing with the square of the distance] is that surface."""
LCN, L, A, B = 0.25 * 3 / 255, 1 / 70, 1 / 30, 1 / 30
"""What one count of each feature channel costs; costs add up to at most 1."""
SEEN_BEHIND, HIDDEN, HOLE = 2.5, 1.2, 0.6
"""Cost of a body's point where the camera looks through it, where something is in front, and where depth is missing."""
_GRAY_SCALE, _DEPTH_SCALE = 12.0, 0.004
"""Residuals that count as one standard deviation: lightness [counts], distance to the surface [m]."""


@numba.njit(cache=True, inline="always")
def tolerance(z):
    """How far a depth reading may lie from a surface at depth z [m]."""
    return SURFACE_TOLERANCE * max(1.0, z * z)


@numba.njit(cache=True)
def color_cost(feature, u, v, f0):
    """Difference, 0 to 1, between a feature picture (H, W, 4) at a sub-pixel position and four channel values."""
    height, width = feature.shape[:2]
    u = min(max(u, 0.0), width - 1.001)
    v = min(max(v, 0.0), height - 1.001)
    j, i = int(u), int(v)
    a, b = u - j, v - i
    w00, w01, w10, w11 = (1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b
    p, q, r, s = feature[i, j], feature[i, j + 1], feature[i + 1, j], feature[i + 1, j + 1]
    cost = abs(w00 * p[0] + w01 * q[0] + w10 * r[0] + w11 * s[0] - f0[0]) * LCN
    cost += abs(w00 * p[1] + w01 * q[1] + w10 * r[1] + w11 * s[1] - f0[1]) * L
    cost += abs(w00 * p[2] + w01 * q[2] + w10 * r[2] + w11 * s[2] - f0[2]) * A
    cost += abs(w00 * p[3] + w01 * q[3] + w10 * r[3] + w11 * s[3] - f0[3]) * B
    return min(cost, 1.0)


@numba.njit(cache=True)
def features_at(feature, uv):
    """The four channels (n, 4) at sub-pixel positions (n, 2)."""
    height, width = feature.shape[:2]
    out = np.empty((len(uv), 4), np.float32)
    for k in range(len(uv)):
        u = min(max(uv[k, 0], 0.0), width - 1.001)
        v = min(max(uv[k, 1], 0.0), height - 1.001)
        j, i = int(u), int(v)
        a, b = u - j, v - i
        for c in range(4):
            top = (1 - a) * feature[i, j, c] + a * feature[i, j + 1, c]
            out[k, c] = (1 - b) * top + b * ((1 - a) * feature[i + 1, j, c] + a * feature[i + 1, j + 1, c])
    return out


@numba.njit(cache=True, fastmath=True)
def energies(points, point_features, R, t, depth, feature, K, every):
    """How badly each body at each candidate pose explains a frame.

    points (B, n, 3), point_features (B, n, 4), R (B, C, 3, 3), t (B, C, 3); of the points each ``every``-th is
    looked at. Returns the mean energy (B, C) and the share of points seen in place (B, C).
    """
    bodies, candidates = R.shape[:2]
    height, width = depth.shape
    n = points.shape[1]
    energy = np.empty((bodies, candidates))
    seen = np.empty((bodies, candidates))
    for b in range(bodies):
        for c in range(candidates):
            Q, s = R[b, c], t[b, c]
            total, fits, looked = 0.0, 0, 0
            for k in range(0, n, every):
                p = points[b, k]
                looked += 1
                z = Q[2, 0] * p[0] + Q[2, 1] * p[1] + Q[2, 2] * p[2] + s[2]
                if z <= 0.05:
                    total += HIDDEN
                    continue
                u = (Q[0, 0] * p[0] + Q[0, 1] * p[1] + Q[0, 2] * p[2] + s[0]) / z * K[0, 0] + K[0, 2]
                v = (Q[1, 0] * p[0] + Q[1, 1] * p[1] + Q[1, 2] * p[2] + s[1]) / z * K[1, 1] + K[1, 2]
                if not (u > 0 and v > 0 and u < width - 1 and v < height - 1):
                    total += HIDDEN
                    continue
                d = depth[int(v + 0.5), int(u + 0.5)]
                if d == 0:
                    total += HOLE + 0.7 * color_cost(feature, u, v, point_features[b, k])
                    continue
                off = abs(d - z) / (0.6 * tolerance(z))
                if off < 2.5:
                    total += color_cost(feature, u, v, point_features[b, k]) + 0.4 * off
                    fits += 1
                else:
                    total += SEEN_BEHIND if d > z else HIDDEN
            energy[b, c] = total / looked
            seen[b, c] = fits / looked
    return energy, seen


@numba.njit(cache=True)
def _rotation(w):
    """The rotation (3, 3) by a rotation vector."""
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


@numba.njit(cache=True)
def align(points, lightness, R, t, lightness_picture, smooth, normal, K, iterations):
    """Gauss-Newton of every body's pose against one frame: lightness and distance to the surface, robustly.

    points (B, n, 3), lightness (B, n), R (B, 3, 3), t (B, 3); ``lightness_picture`` and ``smooth`` (H, W)
    float32, ``normal`` (H, W, 3) int8 in 1/127. Returns the new R and t.
    """
    height, width = smooth.shape
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    bodies, n = lightness.shape
    R, t = R.copy(), t.copy()
    X = np.empty((n, 3))
    gray, gx, gy = np.empty(n), np.empty(n), np.empty(n)
    for b in range(bodies):
        for _ in range(iterations):
            m = 0
            index = np.empty(n, np.int64)
            center = np.zeros(3)
            for k in range(n):
                p = points[b, k]
                for a in range(3):
                    X[m, a] = R[b, a, 0] * p[0] + R[b, a, 1] * p[1] + R[b, a, 2] * p[2] + t[b, a]
                z = X[m, 2]
                if z < 0.05:
                    continue
                u, v = X[m, 0] / z * fx + cx, X[m, 1] / z * fy + cy
                if not (u > 1 and v > 1 and u < width - 2 and v < height - 2):
                    continue
                d = smooth[int(v + 0.5), int(u + 0.5)]
                if d == 0 or abs(d - z) > 0.02 * max(1.0, z * z):
                    continue
                index[m] = k
                center += X[m]
                i, j = int(v), int(u)
                fa, fb = u - j, v - i
                p00, p01 = lightness_picture[i, j], lightness_picture[i, j + 1]
                p10, p11 = lightness_picture[i + 1, j], lightness_picture[i + 1, j + 1]
                gray[m] = (1 - fb) * ((1 - fa) * p00 + fa * p01) + fb * ((1 - fa) * p10 + fa * p11) - lightness[b, k]
                # Central differences, interpolated like the picture.
                gx[m] = 0.5 * (
                    (1 - fb)
                    * ((1 - fa) * (p01 - lightness_picture[i, j - 1]) + fa * (lightness_picture[i, j + 2] - p00))
                    + fb
                    * (
                        (1 - fa) * (p11 - lightness_picture[i + 1, j - 1])
                        + fa * (lightness_picture[i + 1, j + 2] - p10)
                    )
                )
                gy[m] = 0.5 * (
                    (1 - fa)
                    * ((1 - fb) * (p10 - lightness_picture[i - 1, j]) + fb * (lightness_picture[i + 2, j] - p00))
                    + fa
                    * (
                        (1 - fb) * (p11 - lightness_picture[i - 1, j + 1])
                        + fb * (lightness_picture[i + 2, j + 1] - p01)
                    )
                )
                m += 1
            if m < 6:
                break
            center /= m
            brighter = np.median(gray[:m])  # the light may change as a whole
            H, g, spread = np.zeros((6, 6)), np.zeros(6), 0.0
            for k in range(m):
                x, y, z = X[k, 0], X[k, 1], X[k, 2]
                rx, ry, rz = x - center[0], y - center[1], z - center[2]
                spread += rx * rx + ry * ry + rz * rz
                r = gray[k] - brighter
                w = 1 / _GRAY_SCALE**2 / (1 + (r / _GRAY_SCALE) ** 2) ** 2
                jx, jy = gx[k] * fx / z, gy[k] * fy / z
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
            extent = max(np.sqrt(spread / m / 3), 0.01)
            for a in range(3):  # damped, so that what the frame does not tell stays as it was
                H[a, a] += m * 0.001 * (extent / _DEPTH_SCALE) ** 2 + 1
                H[3 + a, 3 + a] += m * 0.002 / _DEPTH_SCALE**2 + 1
            step = -np.linalg.solve(H, g)
            turn = np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
            if turn > 0.1:
                step *= 0.1 / turn
            dR = _rotation(step[:3])
            t[b] = dR @ (t[b] - center) + center + step[3:]
            R[b] = dR @ R[b]
            if turn < 2e-4 and np.sqrt((step[3:] ** 2).sum()) < 5e-5:
                break
    return R, t


@numba.njit(cache=True, inline="always")
def _accumulate(H, g, rx, ry, rz, jx, jy, jz, r, w):
    """Add one residual, whose derivative by the point's position is (jx, jy, jz), to the normal equations."""
    a = (ry * jz - rz * jy, rz * jx - rx * jz, rx * jy - ry * jx, jx, jy, jz)
    for i in range(6):
        g[i] += w * a[i] * r
        for j in range(6):
            H[i, j] += w * a[i] * a[j]


@numba.njit(cache=True)
def label_costs(points, point_features, frames, R, t, depth, feature, K):
    """How badly each of B motions explains each of n frame-0 points, over some frames.

    points (n, 3), point_features (n, 4), frames (F,), R (B, T, 3, 3), t (B, T, 3), depth (T, H, W),
    feature (T, H, W, 4).
    Returns the mean cost (B, n) and the share of frames (B, n) in which the motion takes the point more than 1 cm.
    """
    bodies = len(R)
    height, width = depth.shape[1:]
    cost = np.zeros((bodies, len(points)), np.float32)
    moved = np.zeros((bodies, len(points)), np.float32)
    share = 1 / len(frames)
    for b in range(bodies):
        for f in frames:
            Q, s = R[b, f], t[b, f]
            for k in range(len(points)):
                p = points[k]
                x = Q[0, 0] * p[0] + Q[0, 1] * p[1] + Q[0, 2] * p[2] + s[0]
                y = Q[1, 0] * p[0] + Q[1, 1] * p[1] + Q[1, 2] * p[2] + s[1]
                z = Q[2, 0] * p[0] + Q[2, 1] * p[1] + Q[2, 2] * p[2] + s[2]
                if (x - p[0]) ** 2 + (y - p[1]) ** 2 + (z - p[2]) ** 2 > 1e-4:
                    moved[b, k] += share
                if z <= 0.05:
                    cost[b, k] += 0.55
                    continue
                u, v = x / z * K[0, 0] + K[0, 2], y / z * K[1, 1] + K[1, 2]
                if not (u >= 0 and v >= 0 and u <= width - 1 and v <= height - 1):
                    cost[b, k] += 0.55
                    continue
                off, nearest, farthest = layers(depth[f], u, v, z)
                if farthest == 0:
                    cost[b, k] += 0.35 + 0.5 * color_cost(feature[f], u, v, point_features[k])
                elif off < tolerance(z):
                    cost[b, k] += 0.7 * color_cost(feature[f], u, v, point_features[k])
                    cost[b, k] += 0.35 * min(off / (0.6 * tolerance(z)), 1.0)
                else:
                    cost[b, k] += 1.4 if nearest > z else 0.6
    return cost * np.float32(share), moved


@numba.njit(cache=True)
def layers(depth, u, v, z):
    """Of the readings in the 3x3 pixels around (u, v): how near the closest comes to z (among the center's,
    the least and the greatest), the least, and the greatest; 0 where there is none."""
    height, width = depth.shape
    i, j = min(max(int(v + 0.5), 0), height - 1), min(max(int(u + 0.5), 0), width - 1)
    nearest, farthest = 99.0, 0.0
    for y in range(max(i - 1, 0), min(i + 2, height)):
        for x in range(max(j - 1, 0), min(j + 2, width)):
            d = depth[y, x]
            if d > 0:
                nearest, farthest = min(nearest, d), max(farthest, d)
    off = min(abs(nearest - z), abs(farthest - z))
    if depth[i, j] > 0:
        off = min(off, abs(depth[i, j] - z))
    return off, nearest, farthest


@numba.njit(cache=True)
def smooth_depth(depth):
    """3x3 mean over readings within 1.5 cm [at up to 1 m] of the center; holes stay holes."""
    height, width = depth.shape
    out = np.zeros_like(depth)
    for i in range(height):
        for j in range(width):
            d = depth[i, j]
            if d == 0:
                continue
            total, n = 0.0, 0
            for y in range(max(i - 1, 0), min(i + 2, height)):
                for x in range(max(j - 1, 0), min(j + 2, width)):
                    if depth[y, x] > 0 and abs(depth[y, x] - d) < 0.015 * max(1.0, d):
                        total += depth[y, x]
                        n += 1
            out[i, j] = total / n
    return out


@numba.njit(cache=True)
def surface_normals(depth, K, reach=2):
    """Normals (H, W, 3) in 1/127 of a depth picture, by differences over ``reach`` pixels; 0 at edges and holes."""
    height, width = depth.shape
    out = np.zeros((height, width, 3), np.int8)
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    for i in range(reach, height - reach):
        for j in range(reach, width - reach):
            d, a, b = depth[i, j], depth[i, j - reach], depth[i, j + reach]
            c, e = depth[i - reach, j], depth[i + reach, j]
            jump = max(max(abs(a - d), abs(b - d)), max(abs(c - d), abs(e - d)))
            if d == 0 or a == 0 or b == 0 or c == 0 or e == 0 or jump > 0.04:
                continue
            ux = (j + reach - cx) / fx * b - (j - reach - cx) / fx * a
            uy, uz = (i - cy) / fy * (b - a), b - a
            vx = (j - cx) / fx * (e - c)
            vy, vz = (i + reach - cy) / fy * e - (i - reach - cy) / fy * c, e - c
            nx, ny, nz = vy * uz - vz * uy, vz * ux - vx * uz, vx * uy - vy * ux
            length = np.sqrt(nx * nx + ny * ny + nz * nz)
            if length > 1e-12:
                out[i, j, 0] = round(127 * nx / length)
                out[i, j, 1] = round(127 * ny / length)
                out[i, j, 2] = round(127 * nz / length)
    return out


@numba.njit(cache=True, fastmath=True)
def aggregate(cost, wanted, valid, depth, feature, reach, depth_scale, color_scale, space_scale):
    """Bilateral mean of a cost volume (B, h, w) over neighbors at the same depth and of the same color.

    depth (h, w), feature (h, w, 4) uint8, valid and wanted (h, w). Returns (B, h, w): infinite where not valid,
    the cost as it was where not wanted.
    """
    bodies, height, width = cost.shape
    out = np.full(cost.shape, np.inf, np.float32)
    for i in range(height):
        for j in range(width):
            if not valid[i, j]:
                continue
            if not wanted[i, j]:
                out[:, i, j] = cost[:, i, j]
                continue
            total = np.zeros(bodies)
            weights = 0.0
            for y in range(max(i - reach, 0), min(i + reach + 1, height)):
                for x in range(max(j - reach, 0), min(j + reach + 1, width)):
                    if not valid[y, x]:
                        continue
                    color = abs(np.float64(feature[y, x, 1]) - feature[i, j, 1]) * L
                    color += abs(np.float64(feature[y, x, 2]) - feature[i, j, 2]) * A
                    color += abs(np.float64(feature[y, x, 3]) - feature[i, j, 3]) * B
                    far = abs(depth[y, x] - depth[i, j]) / (depth_scale * max(1.0, depth[i, j]))
                    away = ((y - i) ** 2 + (x - j) ** 2) / (2 * space_scale**2)
                    w = np.exp(-min(far, 20.0) - color / color_scale - away)
                    weights += w
                    for b in range(bodies):
                        total[b] += w * cost[b, y, x]
            for b in range(bodies):
                out[b, i, j] = total[b] / weights
    return out


@numba.njit(cache=True)
def inlier_share(R, t, start, path, known, within):
    """Share of a point's known frames (N,) in which a motion R (F, 3, 3), t (F, 3) carries it along its path.

    start (N, 3), path (F, N, 3), known (F, N), within (F, N) [m].
    """
    frames, n = known.shape
    out = np.zeros(n)
    for k in range(n):
        p, fits, total = start[k], 0, 0
        for f in range(frames):
            if not known[f, k]:
                continue
            total += 1
            off = 0.0
            for a in range(3):
                x = R[f, a, 0] * p[0] + R[f, a, 1] * p[1] + R[f, a, 2] * p[2] + t[f, a] - path[f, k, a]
                off += x * x
            fits += off < within[f, k] ** 2
        out[k] = fits / max(total, 1)
    return out


@numba.njit(cache=True)
def shown(depth, uv, z):
    """Whether depth pictures (T, H, W) have a reading like z (T, M) [m] around pixels (T, M, 2), or none at all."""
    height, width = depth.shape[1:]
    out = np.zeros(z.shape, np.bool_)
    for t in range(z.shape[0]):
        for k in range(z.shape[1]):
            i, j = int(np.rint(uv[t, k, 1])), int(np.rint(uv[t, k, 0]))
            empty = True
            for y in range(max(i - 1, 0), min(i + 2, height)):
                for x in range(max(j - 1, 0), min(j + 2, width)):
                    if depth[t, y, x] > 0:
                        empty = False
                        out[t, k] |= abs(depth[t, y, x] - z[t, k]) < 2 * tolerance(z[t, k])
            out[t, k] |= empty
    return out


@numba.njit(cache=True)
def above_surface(depth, uv, z):
    """How far beyond points at pixels (T, M, 2) and depths (T, M) [m] the surface is read: the mean of the readings
    around that are nearly as deep, not a number where there is none."""
    height, width = depth.shape[1:]
    out = np.full(z.shape, np.nan)
    for t in range(z.shape[0]):
        for k in range(z.shape[1]):
            i, j = int(np.rint(uv[t, k, 1])), int(np.rint(uv[t, k, 0]))
            total, n = 0.0, 0
            for y in range(max(i - 1, 0), min(i + 2, height)):
                for x in range(max(j - 1, 0), min(j + 2, width)):
                    off = depth[t, y, x] - z[t, k]
                    if depth[t, y, x] > 0 and abs(off) < 0.6 * tolerance(z[t, k]):
                        total += off
                        n += 1
            if n:
                out[t, k] = total / n
    return out


@numba.njit(cache=True)
def misfit(depth, feature, point_features, uv, z):
    """How badly color and depth fit points at pixels (T, M, 2) and depths (T, M) [m]: 0 to 1, -1 where no depth."""
    out = np.full(z.shape, -1.0)
    for t in range(z.shape[0]):
        for k in range(z.shape[1]):
            off, _, farthest = layers(depth[t], uv[t, k, 0], uv[t, k, 1], z[t, k])
            if farthest > 0:
                color = color_cost(feature[t], uv[t, k, 0], uv[t, k, 1], point_features[k])
                out[t, k] = 0.7 * color + 0.3 * min(off / tolerance(z[t, k]), 1.0)
    return out
