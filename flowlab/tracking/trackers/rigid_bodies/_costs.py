"""How badly a rigid motion explains what the pictures show, compiled.

Positions are meters in the camera frame; pixels have integer centers.
"""

# mypy: ignore-errors
import numba
import numpy as np

from flowlab.tracking.trackers.rigid_bodies._readings import extremes, extremes_at, nearest_of, nearest_reading

SURFACE_TOLERANCE = 0.010
"""A depth this near a claimed surface [m, at up to 1 m; growing with the square of the distance] is that surface."""
LCN, L, A, B = 0.25 * 3 / 255, 1 / 70, 1 / 30, 1 / 30
"""What one count of each feature channel costs; costs add up to at most 1."""
SHADED, DARKEST = 0.5, 0.5
"""What it costs a point to be in another light, so that to be seen in shadow costs less than to be hidden; and the
least share to which that lets a color fall, the cube root of an eighth of the light. Poses do not have it, for a body
that is lost would rest in any shadow; nor residuals, by which stated errors were fitted."""
BLACK, GRAY = 16 * 2.55, 128
"""In another light L + 16, a and b of CIE 1976 change by one factor; here, L is in 255ths, and a and b begin at 128."""
UNSEEN, AS_WELL, COVERED = 0.6, 0.05, 0.4
"""Cost of a moved point that is hidden: as much as where the picture shows, as well but for so much, what stood there
before, and all that another color costs, for a finger may lie on it. And cost of a point that rests, beyond that at
which it was last seen, where something came in front."""


@numba.njit(cache=True, inline="always")
def tolerance(z) -> float:
    """How far a depth reading may lie from a surface at depth z [m]."""
    return SURFACE_TOLERANCE * max(1.0, z * z)


@numba.njit(cache=True)
def color_cost(feature, u, v, f0, shade=1.0) -> float:
    """Difference, 0 to 1, between a feature picture (H, W, 4) at a sub-pixel position and four channel values: of the
    colors as they are or, for ``shade`` more, as they would be in another light."""
    height, width = feature.shape[:2]
    u = min(max(u, 0.0), width - 1.001)
    v = min(max(v, 0.0), height - 1.001)
    j, i = int(u), int(v)
    x, y = u - j, v - i
    w00, w01, w10, w11 = (1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y
    p, q, r, s = feature[i, j], feature[i, j + 1], feature[i + 1, j], feature[i + 1, j + 1]
    texture = abs(w00 * p[0] + w01 * q[0] + w10 * r[0] + w11 * s[0] - f0[0]) * LCN
    light = w00 * p[1] + w01 * q[1] + w10 * r[1] + w11 * s[1]
    a = w00 * p[2] + w01 * q[2] + w10 * r[2] + w11 * s[2]
    b = w00 * p[3] + w01 * q[3] + w10 * r[3] + w11 * s[3]
    color = abs(light - f0[1]) * L + abs(a - f0[2]) * A + abs(b - f0[3]) * B
    share = (light + BLACK) / (f0[1] + BLACK)
    if shade < 1 and DARKEST < share < 1 / DARKEST:
        off = abs(a - GRAY - share * (f0[2] - GRAY)) * A + abs(b - GRAY - share * (f0[3] - GRAY)) * B
        color = min(color, shade + off)
    return min(texture + color, 1.0)


@numba.njit(cache=True)
def features_at(feature, uv) -> np.ndarray:
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


@numba.njit(cache=True)
def motion_costs(points, point_features, frames, since, R, t, still_R, still_t, static, depth, feature, K) -> tuple:
    """How badly each of B motions explains each of n frame-0 points, over some frames.

    points (n, 3), point_features (n, 4), frames (F,), since (B,): up to which frames a motion is not looked at, R
    (B, T, 3, 3), t (B, T, 3), still_R (T, 3, 3) and still_t (T, 3): how what stands still moves before the camera,
    static (H, W): what does of the first frame, depth (T, H, W), feature (T, H, W, 4).
    Returns the mean cost (B, n), and the shares of frames (B, n) in which the motion takes the point more than 1 cm
    away, and in which the camera looks through where it would be.
    """
    bodies, n = len(R), len(points)
    height, width = depth.shape[1:]
    cost, moved, through = np.zeros((3, bodies, n), np.float32)
    share = 1 / len(frames)
    x, still, last = np.zeros(3), np.zeros((n, 3)), np.zeros((bodies, n))
    dense = bodies * n > height * width  # so that it is worth it to look around every pixel, once
    around = np.empty((2, height, width) if dense else (2, 0, 0), np.float32)
    for f in frames:
        if dense:
            extremes(depth[f], around)
        for k in range(n):
            _carry(still_R[f], still_t[f], points[k], still[k])
        for b in range(bodies):
            if f <= since[b]:
                continue
            Q, s = R[b, f], t[b, f]
            for k in range(n):
                _carry(Q, s, points[k], x)
                away = (x[0] - still[k, 0]) ** 2 + (x[1] - still[k, 1]) ** 2 + (x[2] - still[k, 2]) ** 2 > 1e-4
                if away:
                    moved[b, k] += share
                z = x[2]
                if z <= 0.05:
                    cost[b, k] += 0.55
                    continue
                u, v = x[0] / z * K[0, 0] + K[0, 2], x[1] / z * K[1, 1] + K[1, 2]
                if not (u >= 0 and v >= 0 and u <= width - 1 and v <= height - 1):
                    cost[b, k] += 0.55
                    continue
                i, j = int(v + 0.5), int(u + 0.5)
                if dense:
                    nearest, farthest = around[0, i, j], around[1, i, j]
                else:
                    nearest, farthest = extremes_at(depth[f], i, j)
                off = nearest_of(depth[f, i, j], nearest, farthest, z)
                if farthest == 0:
                    cost[b, k] += 0.35 + 0.5 * color_cost(feature[f], u, v, point_features[k], SHADED)
                elif off < tolerance(z):
                    color = color_cost(feature[f], u, v, point_features[k], SHADED)
                    here = 0.7 * color + 0.35 * min(off / (0.6 * tolerance(z)), 1.0)
                    if away and here < UNSEEN:
                        before = _background_cost(x, still_R[f], still_t[f], static, depth[0], feature, f, u, v, K)
                        if before < color + AS_WELL:
                            here = UNSEEN
                    elif away:
                        here = UNSEEN
                    last[b, k] = here
                    cost[b, k] += here
                elif nearest > z:
                    cost[b, k] += 1.4
                    through[b, k] += share
                elif away:
                    cost[b, k] += UNSEEN
                else:
                    cost[b, k] += min(COVERED + last[b, k], UNSEEN)
    return cost * np.float32(share), moved, through


@numba.njit(cache=True)
def frame_costs(points, point_features, frames, since, R, t, still_R, still_t, static, depth, feature, K) -> np.ndarray:
    """The mean cost (B, F) of motions over the points in each of some frames: see :func:`motion_costs`."""
    cost = np.zeros((len(R), len(frames)), np.float32)
    for f in range(len(frames)):
        at = frames[f : f + 1]
        here = motion_costs(points, point_features, at, since, R, t, still_R, still_t, static, depth, feature, K)[0]
        for b in range(len(R)):
            cost[b, f] = here[b].mean()
    return cost


@numba.njit(cache=True, inline="always")
def _carry(R, t, p, out) -> None:
    """Where a pose takes a point, into ``out``."""
    for a in range(3):
        out[a] = R[a, 0] * p[0] + R[a, 1] * p[1] + R[a, 2] * p[2] + t[a]


@numba.njit(cache=True)
def _background_cost(x, R, t, static, depth, feature, f, u, v, K) -> float:
    """How unlike the static surface, of which x in frame f was a point already in the first frame, pixel (u, v) of
    frame f looks: 0 to 1, and 2 where x is no such point."""
    height, width = depth.shape
    dx, dy, dz = x[0] - t[0], x[1] - t[1], x[2] - t[2]  # no array: this is the innermost loop
    z = R[0, 2] * dx + R[1, 2] * dy + R[2, 2] * dz
    if z <= 0.05:
        return 2.0
    u0 = (R[0, 0] * dx + R[1, 0] * dy + R[2, 0] * dz) / z * K[0, 0] + K[0, 2]
    v0 = (R[0, 1] * dx + R[1, 1] * dy + R[2, 1] * dz) / z * K[1, 1] + K[1, 2]
    i, j = int(np.floor(v0 + 0.5)), int(np.floor(u0 + 0.5))
    if not (i >= 0 and j >= 0 and i < height and j < width and static[i, j]):
        return 2.0
    if abs(depth[i, j] - z) > tolerance(z):
        return 2.0
    return color_cost(feature[f], u, v, feature[0, i, j], SHADED)


@numba.njit(cache=True)
def residuals(depth, feature, point_features, uv, z) -> np.ndarray:
    """How badly color and depth fit points at pixels (T, M, 2) and depths (T, M) [m]: 0 to 1, -1 where no depth."""
    out = np.full(z.shape, -1.0)
    for t in range(z.shape[0]):
        for k in range(z.shape[1]):
            off, _, farthest = nearest_reading(depth[t], uv[t, k, 0], uv[t, k, 1], z[t, k])
            if farthest > 0:
                color = color_cost(feature[t], uv[t, k, 0], uv[t, k, 1], point_features[k])
                out[t, k] = 0.7 * color + 0.3 * min(off / tolerance(z[t, k]), 1.0)
    return out


@numba.njit(cache=True)
def inlier_shares(R, t, start, path, known, within) -> np.ndarray:
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
