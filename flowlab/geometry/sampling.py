"""Farthest-point sampling: exact, in order, fast."""

import math

import numba
import numpy as np
from jaxtyping import Float, Int

POINTS_PER_CELL = 24
"""Cell occupancy the grid aims at: smaller cells prune better but cost more boxes to look at."""


def farthest_points(
    xyz: Float[np.ndarray, "N 3"], k: int, chosen: Int[np.ndarray, "C"] | None = None
) -> Int[np.ndarray, "K"]:
    """Indices of ``min(k, N)`` points in farthest-point order, starting at point 0.

    Each next point is the one farthest from all before it; among equals, the lowest index. The result is
    nested (the first m of k are the answer for m), equal to the textbook O(N k) loop on float32
    coordinates, and the same on every machine: no fast-math, no fused operations.

    ``chosen`` are indices taken already: the sampling goes on from them and does not return them.

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
def _cells(xyz, cells_per_axis):  # type: ignore[no-untyped-def]
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
def _farthest(xyz, k, taken):  # type: ignore[no-untyped-def]
    n = len(xyz)
    order, start = _cells(xyz, max(1, int(math.sqrt(n / POINTS_PER_CELL) * 1.25)))
    cells = len(start) - 1
    px, py, pz = np.empty(n, np.float32), np.empty(n, np.float32), np.empty(n, np.float32)
    box = np.empty((cells, 6), np.float32)
    for c in range(cells):
        for a in range(3):
            box[c, a], box[c, 3 + a] = xyz[order[start[c]], a], xyz[order[start[c]], a]
        for j in range(start[c], start[c + 1]):
            i = order[j]
            px[j], py[j], pz[j] = xyz[i, 0], xyz[i, 1], xyz[i, 2]
            for a in range(3):
                box[c, a] = min(box[c, a], xyz[i, a])
                box[c, 3 + a] = max(box[c, 3 + a], xyz[i, a])
    gap = np.full(n, np.float32(np.inf))  # squared distance to the nearest chosen point
    far_gap = np.full(cells, np.float32(np.inf))  # the largest gap of each cell, and whose it is
    far_index = np.empty(cells, np.int64)
    for c in range(cells):
        far_index[c] = order[start[c]]

    zero = np.float32(0)
    out = np.empty(k, np.int64)
    done = 0
    new = taken[0] if len(taken) else 0
    for step in range(len(taken) + k):
        if step >= len(taken):
            if step > 0:
                best = np.float32(-1)
                for c in range(cells):
                    if far_gap[c] > best or (far_gap[c] == best and far_index[c] < new):
                        best, new = far_gap[c], far_index[c]
            out[done] = new
            done += 1
        else:
            new = taken[step]
        x, y, z = xyz[new, 0], xyz[new, 1], xyz[new, 2]
        for c in range(cells):
            # Rounding is monotonic, so this bound never exceeds the distance computed for a point inside.
            dx = max(box[c, 0] - x, x - box[c, 3], zero)
            dy = max(box[c, 1] - y, y - box[c, 4], zero)
            dz = max(box[c, 2] - z, z - box[c, 5], zero)
            if dx * dx + dy * dy + dz * dz >= far_gap[c]:
                continue
            most = np.float32(-1)
            for j in range(start[c], start[c + 1]):
                dx, dy, dz = px[j] - x, py[j] - y, pz[j] - z
                gap[j] = min(gap[j], dx * dx + dy * dy + dz * dz)
                most = max(most, gap[j])
            for j in range(start[c], start[c + 1]):
                if gap[j] == most:
                    far_index[c] = order[j]
                    break
            far_gap[c] = most
    return out
