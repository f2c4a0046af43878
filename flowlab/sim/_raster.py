"""The z-buffer's inner loops. Inverse z-depth [1/m] is linear over a triangle in the image; larger wins."""

import math

import numba
import numpy as np

PLANE, SPHERE, CAPSULE, CYLINDER, BOX = 0, 2, 3, 5, 6
"""MuJoCo's geom types (mjtGeom)."""


@numba.njit(cache=True)
def to_depth(inverse_depth):  # type: ignore[no-untyped-def]
    """z-depth [m] float32 of inverse z-depth [1/m]; 0 stays 0."""
    height, width = inverse_depth.shape
    depth = np.empty((height, width), np.float32)
    for v in range(height):
        for u in range(width):
            depth[v, u] = 1.0 / inverse_depth[v, u] if inverse_depth[v, u] > 0 else 0.0
    return depth


@numba.njit(cache=True)
def _local_to_cam(pos, mat, T_cam_world):  # type: ignore[no-untyped-def]
    """Rotation and translation from a thing's own frame to the camera's."""
    R, t = np.empty((3, 3)), np.empty(3)
    for i in range(3):
        t[i] = T_cam_world[i, 3]
        for k in range(3):
            t[i] += T_cam_world[i, k] * pos[k]
        for j in range(3):
            s = 0.0
            for k in range(3):
                s += T_cam_world[i, k] * mat[3 * k + j]
            R[i, j] = s
    return R, t


@numba.njit(cache=True)
def _pixel_box(R, t, centre, half, K, width, height):  # type: ignore[no-untyped-def]
    """Inclusive pixel bounds of a box in its own frame and its least z-depth; all pixels if it reaches behind."""
    u0, u1, v0, v1, z0 = math.inf, -math.inf, math.inf, -math.inf, math.inf
    for corner in range(8):
        x = centre[0] + (half[0] if corner & 1 else -half[0])
        y = centre[1] + (half[1] if corner & 2 else -half[1])
        z = centre[2] + (half[2] if corner & 4 else -half[2])
        cz = R[2, 0] * x + R[2, 1] * y + R[2, 2] * z + t[2]
        if cz <= 1e-6:
            return 0, width - 1, 0, height - 1, 1e-6
        u = K[0, 0] * (R[0, 0] * x + R[0, 1] * y + R[0, 2] * z + t[0]) / cz + K[0, 2]
        v = K[1, 1] * (R[1, 0] * x + R[1, 1] * y + R[1, 2] * z + t[1]) / cz + K[1, 2]
        u0, u1, v0, v1, z0 = min(u0, u), max(u1, u), min(v0, v), max(v1, v), min(z0, cz)
    return (
        int(max(0.0, math.floor(u0))),
        int(min(width - 1.0, math.ceil(u1))),
        int(max(0.0, math.floor(v0))),
        int(min(height - 1.0, math.ceil(v1))),
        z0,
    )


@numba.njit(cache=True)
def _hidden(bounds, inverse_depth):  # type: ignore[no-untyped-def]
    """Whether everything drawn so far stands in front of the nearest point of a box."""
    u0, u1, v0, v1, z0 = bounds
    nearest = 1.0 / z0
    for v in range(v0, v1 + 1):
        for u in range(u0, u1 + 1):
            if inverse_depth[v, u] < nearest:
                return False
    return True


@numba.njit(cache=True)
def draw_meshes(vertices, faces, planes, span, boxes, entity, pos, mat, K, T_cam_world, nearest, inverse_depth, owner):  # type: ignore[no-untyped-def]  # fmt: skip
    """Draw front faces into ``inverse_depth`` (H, W) and ``owner`` (H, W); parameters as in ``_Meshes``."""
    height, width = inverse_depth.shape
    if len(entity) == 0:
        return
    screen = np.empty((3, span[:, 1].max()))  # u, v, 1/z of every vertex of one mesh
    front = np.empty(span[:, 3].max(), np.int64)
    for g in range(len(entity)):
        R, t = _local_to_cam(pos[entity[g]], mat[entity[g]], T_cam_world)
        bounds = _pixel_box(R, t, boxes[g, :3], boxes[g, 3:], K, width, height)
        if bounds[0] > bounds[1] or bounds[2] > bounds[3] or _hidden(bounds, inverse_depth):
            continue
        first_vertex, n_vertices, first_face, n_faces = span[g]
        for i in range(n_vertices):
            x, y, z = vertices[first_vertex + i, 0], vertices[first_vertex + i, 1], vertices[first_vertex + i, 2]
            iz = 1.0 / (R[2, 0] * x + R[2, 1] * y + R[2, 2] * z + t[2])
            screen[0, i] = K[0, 0] * (R[0, 0] * x + R[0, 1] * y + R[0, 2] * z + t[0]) * iz + K[0, 2]
            screen[1, i] = K[1, 1] * (R[1, 0] * x + R[1, 1] * y + R[1, 2] * z + t[1]) * iz + K[1, 2]
            screen[2, i] = iz
        # The camera in the mesh's own frame tells front faces from back ones before any is projected.
        ex = -(R[0, 0] * t[0] + R[1, 0] * t[1] + R[2, 0] * t[2])
        ey = -(R[0, 1] * t[0] + R[1, 1] * t[1] + R[2, 1] * t[2])
        ez = -(R[0, 2] * t[0] + R[1, 2] * t[1] + R[2, 2] * t[2])
        n_front = 0
        for f in range(first_face, first_face + n_faces):
            front[n_front] = f
            n_front += planes[0, f] * ex + planes[1, f] * ey + planes[2, f] * ez > planes[3, f]
        for f in front[:n_front]:
            _draw_triangle(screen, faces[f, 0], faces[f, 1], faces[f, 2], entity[g], nearest, inverse_depth, owner)


@numba.njit(cache=True, inline="always")
def _draw_triangle(screen, a, b, c, who, nearest, inverse_depth, owner):  # type: ignore[no-untyped-def]
    height, width = inverse_depth.shape
    ax, bx, cx = screen[0, a], screen[0, b], screen[0, c]
    ay, by, cy = screen[1, a], screen[1, b], screen[1, c]
    left, right = min(ax, bx, cx), max(ax, bx, cx)
    top, bottom = min(ay, by, cy), max(ay, by, cy)
    if (np.floor(right) < left) | (np.floor(bottom) < top):  # most triangles lie between the pixel centres
        return
    # Unsigned, or numba looks out for indices counted from the end.
    x0, x1 = np.uint32(max(0, math.ceil(left))), np.uint32(max(0, min(width, math.floor(right) + 1)))
    y0, y1 = np.uint32(max(0, math.ceil(top))), np.uint32(max(0, min(height, math.floor(bottom) + 1)))
    if x1 <= x0 or y1 <= y0:
        return
    az, bz, cz = screen[2, a], screen[2, b], screen[2, c]
    area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
    if area == 0.0 or az <= 0 or bz <= 0 or cz <= 0:
        return
    per_area = 1.0 / area
    for y in range(y0, y1):
        dy = np.float64(y) - ay
        for x in range(x0, x1):
            dx = np.float64(x) - ax
            wb = (dx * (cy - ay) - dy * (cx - ax)) * per_area
            wc = ((bx - ax) * dy - (by - ay) * dx) * per_area
            wa = 1.0 - wb - wc
            if min(wa, wb, wc) >= -1e-12:
                iz = wa * az + wb * bz + wc * cz
                if inverse_depth[y, x] < iz <= nearest:
                    inverse_depth[y, x], owner[y, x] = iz, who


@numba.njit(cache=True)
def draw_primitives(entity, kind, size, pos, mat, K, T_cam_world, nearest, inverse_depth, owner):  # type: ignore[no-untyped-def]  # fmt: skip
    """Draw the first entry of every pixel's ray into each primitive; parameters as in ``_Primitives``."""
    height, width = inverse_depth.shape
    origin, centre = np.empty(3), np.zeros(3)
    for g in range(len(entity)):
        R, t = _local_to_cam(pos[entity[g]], mat[entity[g]], T_cam_world)
        for a in range(3):
            origin[a] = -(R[0, a] * t[0] + R[1, a] * t[1] + R[2, a] * t[2])
        if kind[g] == PLANE:
            u0, u1, v0, v1 = 0, width - 1, 0, height - 1
        else:
            bounds = _pixel_box(R, t, centre, _half_size(kind[g], size[g]), K, width, height)
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
def _half_size(kind, size):  # type: ignore[no-untyped-def]
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
def _sphere_entry(o, radius, dx, dy, dz, oz):  # type: ignore[no-untyped-def]
    """First entry into a sphere at height -oz above the local origin; infinite if the ray misses it."""
    a = dx * dx + dy * dy + dz * dz
    b = o[0] * dx + o[1] * dy + oz * dz
    c = o[0] * o[0] + o[1] * o[1] + oz * oz - radius * radius
    root = b * b - a * c
    return (-b - math.sqrt(root)) / a if root >= 0 else math.inf


@numba.njit(cache=True)
def _first_entry(kind, size, o, dx, dy, dz):  # type: ignore[no-untyped-def]
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
