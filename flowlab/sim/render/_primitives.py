"""The z-buffer's inner loops for primitives: every pixel's ray against the shape itself."""

import math

import numba
import numpy as np

from flowlab.sim.render._raster import local_to_cam, pixel_box

PLANE, SPHERE, CAPSULE, CYLINDER, BOX = 0, 2, 3, 5, 6
"""MuJoCo's geom types (mjtGeom)."""


@numba.njit(cache=True)
def draw_primitives(entity, kind, size, pos, mat, K, T_cam_world, nearest, inverse_depth, owner) -> None:  # type: ignore[no-untyped-def]  # fmt: skip
    """Draw the first entry of every pixel's ray into each primitive; parameters as in ``_Primitives``."""
    height, width = inverse_depth.shape
    origin, center = np.empty(3), np.zeros(3)
    for g in range(len(entity)):
        R, t = local_to_cam(pos[entity[g]], mat[entity[g]], T_cam_world)
        for a in range(3):
            origin[a] = -(R[0, a] * t[0] + R[1, a] * t[1] + R[2, a] * t[2])
        if kind[g] == PLANE:
            u0, u1, v0, v1 = 0, width - 1, 0, height - 1
        else:
            bounds = pixel_box(R, t, center, _half_size(kind[g], size[g]), K, width, height)
            u0, u1, v0, v1 = bounds[0], bounds[1], bounds[2], bounds[3]
        for v in range(v0, v1 + 1):
            y = (v - K[1, 2]) / K[1, 1]
            for u in range(u0, u1 + 1):
                x = (u - K[0, 2]) / K[0, 0]
                # A direction with z = 1 in the camera's frame makes the ray's parameter the z-depth.
                dx = R[0, 0] * x + R[1, 0] * y + R[2, 0]
                dy = R[0, 1] * x + R[1, 1] * y + R[2, 1]
                dz = R[0, 2] * x + R[1, 2] * y + R[2, 2]
                depth = _first_entry(kind[g], size[g], origin, dx, dy, dz)
                if depth > 0 and inverse_depth[v, u] < 1.0 / depth <= nearest:
                    inverse_depth[v, u], owner[v, u] = 1.0 / depth, entity[g]


@numba.njit(cache=True)
def _half_size(kind, size) -> np.ndarray:  # type: ignore[no-untyped-def]
    """Half size of a primitive's bounding box in its own frame."""
    half = size.copy()
    if kind == SPHERE:
        half[1] = half[2] = size[0]
    elif kind == CYLINDER:
        half[1], half[2] = size[0], size[1]
    elif kind == CAPSULE:
        half[1], half[2] = size[0], size[1] + size[0]
    return half


@numba.njit(cache=True)
def _sphere_entry(o, radius, dx, dy, dz, oz) -> float:  # type: ignore[no-untyped-def]
    """First entry into a sphere at height -oz above the local origin; infinite if the ray misses it."""
    a = dx * dx + dy * dy + dz * dz
    b = o[0] * dx + o[1] * dy + oz * dz
    c = o[0] * o[0] + o[1] * o[1] + oz * oz - radius * radius
    root = b * b - a * c
    return (-b - math.sqrt(root)) / a if root >= 0 else math.inf


@numba.njit(cache=True)
def _first_entry(kind, size, o, dx, dy, dz) -> float:  # type: ignore[no-untyped-def]
    """Parameter at which the ray o + s d enters a primitive from outside; 0 if it does not."""
    best = math.inf
    if kind == BOX:
        enter, leave = -math.inf, math.inf
        for axis in range(3):
            d = dx if axis == 0 else (dy if axis == 1 else dz)
            if abs(d) < 1e-15:
                if abs(o[axis]) > size[axis]:
                    return 0.0
                continue
            near, far = (-size[axis] - o[axis]) / d, (size[axis] - o[axis]) / d
            enter, leave = max(enter, min(near, far)), min(leave, max(near, far))
        return enter if 0 < enter <= leave else 0.0
    if kind == PLANE:
        s = -o[2] / dz if dz < 0 < o[2] else 0.0
        inside_x = size[0] <= 0 or abs(o[0] + s * dx) <= size[0]
        inside_y = size[1] <= 0 or abs(o[1] + s * dy) <= size[1]
        return s if inside_x and inside_y else 0.0
    if kind == SPHERE:
        best = _sphere_entry(o, size[0], dx, dy, dz, o[2])
    else:
        radius, half = size[0], size[1]
        a, b = dx * dx + dy * dy, o[0] * dx + o[1] * dy
        root = b * b - a * (o[0] * o[0] + o[1] * o[1] - radius * radius)
        if root >= 0 and a > 1e-15:
            s = (-b - math.sqrt(root)) / a
            if s > 0 and abs(o[2] + s * dz) <= half:
                best = s
        for end in (-1.0, 1.0):
            if kind == CYLINDER and dz * end < 0:
                s = (end * half - o[2]) / dz
                x, y = o[0] + s * dx, o[1] + s * dy
                if 0 < s < best and x * x + y * y <= radius * radius:
                    best = s
            elif kind == CAPSULE:
                s = _sphere_entry(o, radius, dx, dy, dz, o[2] - end * half)
                if 0 < s < best and end * (o[2] + s * dz) >= half:
                    best = s
    return best if 0 < best < math.inf else 0.0
