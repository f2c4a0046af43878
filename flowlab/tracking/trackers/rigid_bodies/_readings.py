"""Readings of depth around a pixel, compiled: one of them alone may be of what lies beside a surface."""

# mypy: ignore-errors
import numba
import numpy as np


@numba.njit(cache=True)
def nearest_reading(depth, u, v, z) -> tuple[float, float, float]:
    """Of the readings in the 3x3 pixels around (u, v): how near the closest comes to z (among the center's,
    the least and the greatest), the least, and the greatest; 0 where there is none."""
    height, width = depth.shape
    i, j = min(max(int(v + 0.5), 0), height - 1), min(max(int(u + 0.5), 0), width - 1)
    nearest, farthest = extremes_at(depth, i, j)
    return nearest_of(depth[i, j], nearest, farthest, z), nearest, farthest


@numba.njit(cache=True, inline="always")
def nearest_of(center, least, greatest, z) -> float:
    """How near to z the closest of three readings comes, of which the first may be 0, for none."""
    off = min(abs(least - z), abs(greatest - z))
    return min(off, abs(center - z)) if center > 0 else off


@numba.njit(cache=True, inline="always")
def extremes_at(depth, i, j) -> tuple[float, float]:
    """The least and the greatest of the readings in the 3x3 pixels around one; 99 and 0 where there is none."""
    height, width = depth.shape
    nearest, farthest = 99.0, 0.0
    for y in range(max(i - 1, 0), min(i + 2, height)):
        for x in range(max(j - 1, 0), min(j + 2, width)):
            d = depth[y, x]
            if d > 0:
                nearest, farthest = min(nearest, d), max(farthest, d)
    return nearest, farthest


@numba.njit(cache=True)
def extremes(depth, out) -> None:
    """The least and the greatest of the readings in the 3x3 pixels around each (H, W), into ``out`` (2, H, W); 99 and
    0 where there is none."""
    height, width = depth.shape
    least, most = np.empty((3, width), np.float32), np.empty((3, width), np.float32)
    for y in range(height + 1):
        if y < height:
            row = y % 3
            for x in range(width):
                least[row, x], most[row, x] = 99.0, 0.0
                for k in range(max(x - 1, 0), min(x + 2, width)):
                    d = depth[y, k]
                    if d > 0:
                        least[row, x], most[row, x] = min(least[row, x], d), max(most[row, x], d)
        if y > 0:
            for x in range(width):
                low, high = least[(y - 1) % 3, x], most[(y - 1) % 3, x]
                for other in range(max(y - 2, 0), min(y + 1, height)):
                    low, high = min(low, least[other % 3, x]), max(high, most[other % 3, x])
                out[0, y - 1, x], out[1, y - 1, x] = low, high
