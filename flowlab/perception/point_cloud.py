"""From a depth picture to the points of its pixels in the world."""

import numba
import numpy as np


def pad(xyz: np.ndarray, size: int, padding: str = "repeat") -> np.ndarray:
    """``xyz`` (k, 3) filled up to (size, 3) by its own points in turn, or by zeros."""
    if len(xyz) == size:
        return xyz
    if padding == "repeat":
        return xyz[np.arange(size) % len(xyz)]
    return np.concatenate([xyz, np.zeros((size - len(xyz), 3), xyz.dtype)])


@numba.njit(cache=True)
def unproject_and_crop(depth, owner, kept, K, T_world_cam, low, high) -> tuple[np.ndarray, np.ndarray]:  # type: ignore[no-untyped-def]
    """Points of all kept pixels strictly inside the box: xyz (P, 3) float32, pixel (P,) int32."""
    height, width = depth.shape
    xyz = np.empty((height * width, 3), np.float32)
    pixel = np.empty(height * width, np.int32)
    owned = owner.shape == depth.shape
    n = 0
    for v in range(height):
        y = (v - K[1, 2]) / K[1, 1]
        for u in range(width):
            z = np.float64(depth[v, u])
            if not (z > 0.0) or (owned and not kept[owner[v, u]]):
                continue
            x = (u - K[0, 2]) / K[0, 0]
            inside = True
            for a in range(3):
                T = T_world_cam[a]
                w = (T[0] * x + T[1] * y + T[2]) * z + T[3]
                inside = inside and low[a] < w and w < high[a]
                xyz[n, a] = w
            if inside:
                pixel[n] = v * width + u
                n += 1
    return xyz[:n].copy(), pixel[:n].copy()
