"""Surfaces in depth pictures, and points beside them, compiled.

Positions are meters in the camera frame; pixels have integer centers.
"""

# mypy: ignore-errors
import numba
import numpy as np

from flowlab.tracking.trackers.rigid_bodies._costs import A, B, L, tolerance

_MOST_OF_9 = 6
"""Of the 3x3 readings around a pixel."""


@numba.njit(cache=True)
def smooth_depth(depth) -> np.ndarray:
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
def surface_normals(depth, K, reach=2) -> np.ndarray:
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
def aggregate(cost, wanted, valid, depth, feature, reach, depth_scale, color_scale, space_scale) -> np.ndarray:
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
                for b in range(bodies):  # a slice would take 8 s to compile, for its message where shapes differ
                    out[b, i, j] = cost[b, i, j]
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
def is_seen(depth, uv, z) -> np.ndarray:
    """Whether depth pictures (T, H, W) show points at pixels (T, M, 2) and depths (T, M) [m].

    They do where a reading around is as deep, or where there is none at all, unless the reading at the very pixel and
    most around it are nearer: at the border of what covers a point, a reading of its own surface is no sight of it.
    """
    height, width = depth.shape[1:]
    out = np.zeros(z.shape, np.bool_)
    for t in range(z.shape[0]):
        for k in range(z.shape[1]):
            i, j = int(np.rint(uv[t, k, 1])), int(np.rint(uv[t, k, 0]))
            if not (z[t, k] > 0.05 and i >= 0 and j >= 0 and i < height and j < width):
                continue
            within = 2 * tolerance(z[t, k])
            read, like, nearer = 0, 0, 0
            for y in range(max(i - 1, 0), min(i + 2, height)):
                for x in range(max(j - 1, 0), min(j + 2, width)):
                    if depth[t, y, x] > 0:
                        off = depth[t, y, x] - z[t, k]
                        read += 1
                        like += abs(off) < within
                        nearer += off <= -within
            covered = nearer >= _MOST_OF_9 and 0 < depth[t, i, j] <= z[t, k] - within
            out[t, k] = read == 0 or (like > 0 and not covered)
    return out


@numba.njit(cache=True)
def depth_offsets(depth, uv, z) -> np.ndarray:
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
