"""Farthest-point sampling: exact, in order, fast."""

import math

import numba
import numpy as np
from jaxtyping import Float, Int

POINTS_PER_CELL = 96
"""Cell occupancy the grid aims at: smaller cells prune better but cost more boxes to look at."""


def farthest_points(
    xyz: Float[np.ndarray, "N 3"], k: int, chosen: Int[np.ndarray, "C"] | None = None
) -> Int[np.ndarray, "K"]:
    """Indices of ``min(k, N)`` points in farthest-point order, starting at point 0.

    Each next point is the one farthest from all before it; among equals, the lowest index. The result is
    nested (the first m of k are the answer for m), equal to the textbook O(N k) loop on float32
    coordinates, and the same on every machine: no fast-math, no fused operations.

    ``chosen`` are indices taken already, from which the sampling goes on. Where every point that is left
    coincides with a chosen one, indices repeat, as in the textbook loop; depth pictures give no such points.

    Method: points are sorted into grid cells; a cell whose bounding box is farther from the new point
    than every one of its points is from the old ones cannot change and is skipped.
    """
    xyz = np.ascontiguousarray(xyz, np.float32)
    taken = np.asarray(chosen if chosen is not None else [], np.int64)
    k = min(k, len(xyz) - len(taken))
    if k <= 0:
        return np.empty(0, np.int64)
    return _farthest(xyz, k, taken)


@numba.njit(cache=True)
def _cells(xyz, cells_per_axis) -> tuple[np.ndarray, np.ndarray]:  # type: ignore[no-untyped-def]
    """Counting sort of the points into cubic cells: order (N,), start (C+1,) of the occupied cells."""
    n = len(xyz)
    low, high = xyz[0].copy(), xyz[0].copy()
    for i in range(n):
        for a in range(3):
            low[a] = min(low[a], xyz[i, a])
            high[a] = max(high[a], xyz[i, a])
    edge = max((high - low).max() / cells_per_axis, np.float32(1e-9))
    size = ((high - low) / edge).astype(np.int64) + 1
    cell = np.empty(n, np.int64)
    count = np.zeros(size[0] * size[1] * size[2] + 1, np.int64)
    for i in range(n):
        x = min(int((xyz[i, 0] - low[0]) / edge), size[0] - 1)
        y = min(int((xyz[i, 1] - low[1]) / edge), size[1] - 1)
        z = min(int((xyz[i, 2] - low[2]) / edge), size[2] - 1)
        cell[i] = (x * size[1] + y) * size[2] + z
        count[cell[i] + 1] += 1
    start = np.empty(n + 1, np.int64)
    start[0] = 0
    occupied = 0
    for c in range(1, len(count)):
        if count[c]:
            occupied += 1
            start[occupied] = start[occupied - 1] + count[c]
        count[c] += count[c - 1]
    order = np.empty(n, np.int64)
    for i in range(n):
        order[count[cell[i]]] = i
        count[cell[i]] += 1
    return order, start[: occupied + 1]


@numba.njit(cache=True)
def _by_cell(xyz, order, start) -> tuple[np.ndarray, np.ndarray]:  # type: ignore[no-untyped-def]
    """Points (3, N) in cell order, and the bounding boxes (6, C) of the cells: lows, then highs."""
    cells = len(start) - 1
    points, box = np.empty((3, len(xyz)), np.float32), np.empty((6, cells), np.float32)
    for c in range(cells):
        for a in range(3):
            low = high = xyz[order[start[c]], a]
            for j in range(start[c], start[c + 1]):
                points[a, j] = xyz[order[j], a]
                low, high = min(low, points[a, j]), max(high, points[a, j])
            box[a, c], box[3 + a, c] = low, high
    return points, box


@numba.njit(cache=True)
def _farthest(xyz, k, taken) -> np.ndarray:  # type: ignore[no-untyped-def]
    order, start = _cells(xyz, max(1, int(math.sqrt(len(xyz) / POINTS_PER_CELL) * 1.25)))
    points, box = _by_cell(xyz, order, start)
    cells = len(start) - 1
    gap = np.full(len(xyz), np.float32(np.inf))  # squared distance of each point to the nearest chosen one
    far = np.full(cells, np.float32(np.inf))  # the largest gap in each cell, and whose it is
    far_index = order[start[:-1]].astype(np.int32)
    bound = np.empty(cells, np.float32)
    out = np.empty(k, np.int64)
    for step in range(len(taken) + k):
        if step < len(taken):
            new = taken[step]
        else:
            new = 0 if step == 0 else _lowest_of_farthest(far.view(np.int32), far_index)
            out[step - len(taken)] = new
        x, y, z = xyz[new, 0], xyz[new, 1], xyz[new, 2]
        _bound(box, x, y, z, bound)
        for c in range(cells):
            if bound[c] < far[c]:
                s, e = start[c], start[c + 1]
                far[c], first = _update(points[0, s:e], points[1, s:e], points[2, s:e], gap[s:e], x, y, z)
                far_index[c] = order[s + first]
    return out


# Squared distances are never negative, and such float32 are ordered like their bits taken as integers, of
# which, unlike of floats, the compiler finds the largest of many at once.


@numba.njit(cache=True)
def _lowest_of_farthest(far_bits, far_index) -> np.int64:  # type: ignore[no-untyped-def]
    """The lowest point index among the cells with the largest gap."""
    best = np.int32(-1)
    for c in range(len(far_bits)):
        best = max(best, far_bits[c])
    lowest = np.int32(np.iinfo(np.int32).max)
    for c in range(len(far_bits)):
        lowest = min(lowest, far_index[c] if far_bits[c] == best else lowest)
    return np.int64(lowest)


@numba.njit(cache=True)
def _bound(box, x, y, z, bound) -> None:  # type: ignore[no-untyped-def]
    """Squared distance to each box; rounding is monotonic, so no point inside is computed to be nearer."""
    zero = np.float32(0)
    x0, y0, z0, x1, y1, z1 = box[0], box[1], box[2], box[3], box[4], box[5]
    for c in range(len(bound)):
        dx = max(max(x0[c] - x, x - x1[c]), zero)
        dy = max(max(y0[c] - y, y - y1[c]), zero)
        dz = max(max(z0[c] - z, z - z1[c]), zero)
        bound[c] = dx * dx + dy * dy + dz * dz


@numba.njit(cache=True)
def _update(px, py, pz, gap, x, y, z) -> tuple[np.float32, int]:  # type: ignore[no-untyped-def]
    """Lower the gaps of one cell's points to their distance from a new one; the largest left, and its place."""
    for j in range(len(gap)):
        dx, dy, dz = px[j] - x, py[j] - y, pz[j] - z
        gap[j] = min(gap[j], dx * dx + dy * dy + dz * dz)
    bits = gap.view(np.int32)
    most = np.int32(-1)
    for j in range(len(bits)):
        most = max(most, bits[j])
    first = 0
    while bits[first] != most:
        first += 1
    return gap[first], first
