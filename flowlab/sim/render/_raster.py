"""The z-buffer's inner loops for meshes. Inverse z-depth [1/m] is linear over a triangle in the image; larger wins."""

import math

import numba
import numpy as np


@numba.njit(cache=True)
def to_depth(inverse_depth) -> np.ndarray:  # type: ignore[no-untyped-def]
    """z-depth [m] float32 of inverse z-depth [1/m]; 0 stays 0."""
    height, width = inverse_depth.shape
    depth = np.empty((height, width), np.float32)
    for v in range(height):
        for u in range(width):
            depth[v, u] = 1.0 / inverse_depth[v, u] if inverse_depth[v, u] > 0 else 0.0
    return depth


@numba.njit(cache=True)
def local_to_cam(pos, mat, T_cam_world) -> tuple[np.ndarray, np.ndarray]:  # type: ignore[no-untyped-def]
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
def pixel_box(R, t, center, half, K, width, height) -> tuple[int, int, int, int, float]:  # type: ignore[no-untyped-def]
    """Inclusive pixel bounds of a box in its own frame and its least z-depth; all pixels if it reaches behind."""
    u0, u1, v0, v1, z0 = math.inf, -math.inf, math.inf, -math.inf, math.inf
    for corner in range(8):
        x = center[0] + (half[0] if corner & 1 else -half[0])
        y = center[1] + (half[1] if corner & 2 else -half[1])
        z = center[2] + (half[2] if corner & 4 else -half[2])
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
def _hidden(bounds, inverse_depth) -> bool:  # type: ignore[no-untyped-def]
    """Whether everything drawn so far stands in front of the nearest point of a box."""
    u0, u1, v0, v1, z0 = bounds
    nearest = 1.0 / z0
    for v in range(v0, v1 + 1):
        for u in range(u0, u1 + 1):
            if inverse_depth[v, u] < nearest:
                return False
    return True


@numba.njit(cache=True, error_model="numpy")  # a vertex may lie in the camera's own plane
def draw_meshes(  # type: ignore[no-untyped-def]
    vertices, faces, planes, span, boxes, entity, pos, mat, K, T_cam_world, nearest, inverse_depth, owner
) -> None:
    """Draw front faces into ``inverse_depth`` (H, W) and ``owner`` (H, W); parameters as in ``_Meshes``."""
    height, width = inverse_depth.shape
    if len(entity) == 0:
        return
    screen = np.empty((3, span[:, 1].max()))  # u, v, 1/z of every vertex of one mesh
    front = np.empty(span[:, 3].max(), np.int64)
    clipped = np.empty((3, 4))
    for g in range(len(entity)):
        R, t = local_to_cam(pos[entity[g]], mat[entity[g]], T_cam_world)
        bounds = pixel_box(R, t, boxes[g, :3], boxes[g, 3:], K, width, height)
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
            a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
            if min(screen[2, a], screen[2, b], screen[2, c]) > 0:
                _draw_triangle(screen, a, b, c, entity[g], nearest, inverse_depth, owner)
            elif max(screen[2, a], screen[2, b], screen[2, c]) > 0:
                n = _clip(vertices[first_vertex:], (a, b, c), R, t, K, nearest, clipped)
                for k in range(2, n):
                    _draw_triangle(clipped, 0, k - 1, k, entity[g], nearest, inverse_depth, owner)


@numba.njit(cache=True)
def _clip(vertices, corners, R, t, K, nearest, clipped) -> int:  # type: ignore[no-untyped-def]
    """The part of a triangle beyond the near plane, as a polygon of up to 4 screen corners; their number."""
    near = 1.0 / nearest
    cam = np.empty((3, 3))
    for i in range(3):
        for axis in range(3):
            cam[i, axis] = t[axis]
            for k in range(3):
                cam[i, axis] += R[axis, k] * vertices[corners[i], k]
    n = 0
    for i in range(3):
        p, q = cam[i], cam[(i + 1) % 3]
        for share in (0.0, (near - p[2]) / (q[2] - p[2]) if (p[2] < near) != (q[2] < near) else -1.0):
            if share > 0.0 or (share == 0.0 and p[2] >= near):
                x, y, z = p[0] + share * (q[0] - p[0]), p[1] + share * (q[1] - p[1]), p[2] + share * (q[2] - p[2])
                clipped[0, n], clipped[1, n] = K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]
                clipped[2, n] = 1.0 / z
                n += 1
    return n


@numba.njit(cache=True, inline="always")
def _draw_triangle(screen, a, b, c, who, nearest, inverse_depth, owner) -> None:  # type: ignore[no-untyped-def]
    height, width = inverse_depth.shape
    ax, bx, cx = screen[0, a], screen[0, b], screen[0, c]
    ay, by, cy = screen[1, a], screen[1, b], screen[1, c]
    left, right = min(ax, bx, cx), max(ax, bx, cx)
    top, bottom = min(ay, by, cy), max(ay, by, cy)
    if (np.floor(right) < left) | (np.floor(bottom) < top):  # most triangles lie between the pixel centers
        return
    # Unsigned, or numba looks out for indices counted from the end.
    x0, x1 = np.uint32(max(0, math.ceil(left))), np.uint32(max(0, min(width, math.floor(right) + 1)))
    y0, y1 = np.uint32(max(0, math.ceil(top))), np.uint32(max(0, min(height, math.floor(bottom) + 1)))
    if x1 <= x0 or y1 <= y0:
        return
    az, bz, cz = screen[2, a], screen[2, b], screen[2, c]
    area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
    if area == 0.0:
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
