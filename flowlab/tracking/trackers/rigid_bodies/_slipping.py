"""How much worse pictures fit a surface once it is moved, compiled.

Positions are meters in the camera frame; pixels have integer centers.
"""

# mypy: ignore-errors
import numba
import numpy as np

from flowlab.tracking.trackers.rigid_bodies._costs import color_cost, tolerance
from flowlab.tracking.trackers.rigid_bodies._readings import nearest_reading

_THROUGH = 1.2
"""What a point costs through whose place the camera looks."""
_HIDDEN = -2.0
"""Of a point that something nearer covers."""
_FITS = 0.4
"""A point that costs more fits badly as it is: what it would cost elsewhere tells nothing."""
_KNOWN_SHARE = 0.25
"""Of the points in sight before, so many must be in sight still for a motion to be judged by them."""


@numba.njit(cache=True)
def cost_rise(points, point_features, R, t, depth, feature, K, may_hide) -> np.ndarray:
    """How much more each motion but the first costs than that one (B - 1,), in the mean over points and frames.

    points (n, 3), point_features (n, 4), R (B, F, 3, 3), t (B, F, 3), depth (F, H, W), feature (F, H, W, 4). Where
    either motion takes a point out of sight, or the first fits badly, nothing is compared; where that is so for most,
    the rise is 1. Unless they ``may_hide``, points that only the other motion puts behind something fit badly.
    """
    bodies, frames, n = len(R), R.shape[1], len(points)
    total, both, before = np.zeros(bodies), np.zeros(bodies), 0
    for f in range(frames):
        for k in range(n):
            own = _cost(points[k], point_features[k], R[0, f], t[0, f], depth[f], feature[f], K)
            if own < 0 or own > _FITS:
                continue
            before += 1
            for b in range(1, bodies):
                cost = _cost(points[k], point_features[k], R[b, f], t[b, f], depth[f], feature[f], K)
                if cost == _HIDDEN and not may_hide:
                    cost = 1.0
                if cost >= 0:
                    total[b] += cost - own
                    both[b] += 1
    rise = np.ones(bodies - 1)
    for b in range(1, bodies):
        if both[b] > 0 and both[b] >= _KNOWN_SHARE * before:
            rise[b - 1] = total[b] / both[b]
    return rise


@numba.njit(cache=True)
def _cost(p, point_feature, R, t, depth, feature, K) -> float:
    """How badly a frame fits a point where a pose takes it; below 0 where it is out of sight, or nothing is read."""
    height, width = depth.shape
    z = R[2, 0] * p[0] + R[2, 1] * p[1] + R[2, 2] * p[2] + t[2]
    if z <= 0.05:
        return -1.0
    u = (R[0, 0] * p[0] + R[0, 1] * p[1] + R[0, 2] * p[2] + t[0]) / z * K[0, 0] + K[0, 2]
    v = (R[1, 0] * p[0] + R[1, 1] * p[1] + R[1, 2] * p[2] + t[1]) / z * K[1, 1] + K[1, 2]
    if not (u >= 1 and v >= 1 and u < width - 1 and v < height - 1):
        return -1.0
    off, nearest, farthest = nearest_reading(depth, u, v, z)
    if farthest == 0:
        return -1.0
    if off < tolerance(z):
        return 0.7 * color_cost(feature, u, v, point_feature) + 0.3 * off / tolerance(z)
    return _THROUGH if nearest > z else _HIDDEN
