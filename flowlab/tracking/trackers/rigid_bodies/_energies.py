"""How badly poses of bodies explain one frame, compiled.

Positions are meters in the camera frame; pixels have integer centers.
"""

# mypy: ignore-errors
import numba
import numpy as np

from flowlab.tracking.trackers.rigid_bodies._costs import color_cost, tolerance

SEEN_BEHIND, HIDDEN, HOLE = 2.5, 1.2, 0.6
"""Cost of a body's point where the camera looks through it, where something is in front, and where depth is missing."""


@numba.njit(cache=True, fastmath=True)
def energies(points, point_features, R, t, depth, feature, K, every, base, best) -> tuple[np.ndarray, np.ndarray]:
    """How badly each body at each candidate pose explains a frame.

    points (B, n, 3), point_features (B, n, 4), R (B, C, 3, 3), t (B, C, 3), base (B, C): what a pose costs in any
    case; of the points each ``every``-th is looked at. Returns the mean energy (B, C) and the share of points seen in
    place (B, C). With ``best``, only the least energy of each body is wanted: another pose is left once it is worse.
    """
    bodies, candidates = R.shape[:2]
    height, width = depth.shape
    n = points.shape[1]
    energy = np.empty((bodies, candidates))
    seen = np.empty((bodies, candidates))
    count = (n + every - 1) // every
    for b in range(bodies):
        limit = np.inf
        for c in range(candidates):
            Q, s = R[b, c], t[b, c]
            total, fits = base[b, c] * count, 0
            for k in range(0, n, every):
                if total > limit:
                    break
                p = points[b, k]
                z = Q[2, 0] * p[0] + Q[2, 1] * p[1] + Q[2, 2] * p[2] + s[2]
                if z <= 0.05:
                    total += HIDDEN
                    continue
                near = 1 / z
                u = (Q[0, 0] * p[0] + Q[0, 1] * p[1] + Q[0, 2] * p[2] + s[0]) * near * K[0, 0] + K[0, 2]
                v = (Q[1, 0] * p[0] + Q[1, 1] * p[1] + Q[1, 2] * p[2] + s[1]) * near * K[1, 1] + K[1, 2]
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
            if best:
                limit = min(limit, total)
            energy[b, c] = total / count
            seen[b, c] = fits / count
    return energy, seen


@numba.njit(cache=True)
def facing(points, normals, R, t, grazing) -> np.ndarray:
    """Which points (n, 3) with normals (n, 3) a pose turns to the camera, seen at an angle whose cosine is above
    ``grazing``; one whose normal is 0 counts as if it did."""
    out = np.empty(len(points), np.bool_)
    x, m = np.empty(3), np.empty(3)
    for k in range(len(points)):
        for a in range(3):
            x[a] = R[a, 0] * points[k, 0] + R[a, 1] * points[k, 1] + R[a, 2] * points[k, 2] + t[a]
            m[a] = R[a, 0] * normals[k, 0] + R[a, 1] * normals[k, 1] + R[a, 2] * normals[k, 2]
        toward = -(m[0] * x[0] + m[1] * x[1] + m[2] * x[2])
        flat = normals[k, 0] == 0 and normals[k, 1] == 0 and normals[k, 2] == 0
        out[k] = flat or toward > grazing * np.sqrt(x[0] ** 2 + x[1] ** 2 + x[2] ** 2)
    return out
