"""The surfaces that the first frame shows, told apart by color, motion and depth, and what others stand on."""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.spatial import cKDTree

from flowlab.tracking.trackers.rigid_bodies.bodies import RigidBodyFit
from flowlab.tracking.trackers.rigid_bodies.motion_segmentation import STEP

JUMP = 0.015
"""Neighbors whose depths differ by more [m, at up to 1 m] are not of one surface; something nearer covers it."""
_PLANES, _TRIED = 4, 60
"""So many planes are looked for, each among those through so many cells."""
_PLANE_SHARE, _ALONG, _OFF_PLANE = 0.05, 0.97, 0.01
"""A plane has more than this share of the scene; its cells are within this cosine of its normal, and this far from it
[m, at up to 1 m]."""
_AROUND = (5, 5)
"""Cells around one of which most are in a plane, if it is to be though its normal is not known."""
_FRAME, _RAGGED, _READ, _STRAY = 0.15, 3, 0.5, 0.02
"""A frame without depth is at most this share of the picture wide; within so many cells it gives way to rows of which
this share has depth, and before these hardly any has."""
_CURVED = 0.7
"""A plane curves less [1/m]: of a large ball, too, a part looks flat."""
_BESIDE, _BESIDE_UNLIKE = 2.5, 6.0
"""How many cells the color of a pixel reaches, and where the cells may be that a pixel is of which none is like."""
_UNLIKE = 25
"""A pixel is unlike cells whose lightness or color differs by more [counts]."""


@dataclass(frozen=True, slots=True)
class Patch:
    """Cells of the first frame that move as one."""

    cells: Int64[np.ndarray, "n 2"]
    pixels: Float64[np.ndarray, "n 2"]
    xyz_cam: Float64[np.ndarray, "n 3"]
    normals: Float64[np.ndarray, "n 3"]
    """Of length 0 where not known."""

    @classmethod
    def of(cls, fit: RigidBodyFit, cells: Int64[np.ndarray, "n 2"]) -> "Patch":
        """Some cells of the first frame."""
        i, j = cells.T
        pixels = np.stack([fit.grid.u[i, j], fit.grid.v[i, j]], 1)
        xyz = fit.pictures.unproject(pixels.astype(float), fit.grid.depth[i, j].astype(float))
        normals = np.where(fit.grid.edge[i, j, None], 0, fit.pictures.normal[0, pixels[:, 1], pixels[:, 0]] / 127)
        return cls(cells, pixels.astype(float), xyz, normals)


def surface_patches(fit: RigidBodyFit, resting: Bool[np.ndarray, "h w"], color: int, lightness: int) -> Iterator[Patch]:
    """What is of one color and one motion, without a jump in depth: neighbors differ by no more than so many counts.
    ``resting`` is left out."""
    grid, owner = fit.grid, fit.assignment.best_motion
    feature = fit.pictures.feature[0, ::STEP, ::STEP, 1:].astype(np.int16)
    most = np.array([lightness, color, color])
    label = grid.connect(
        (owner >= 0) & ~resting,
        JUMP,
        lambda near, far: (owner[near] == owner[far]) & (np.abs(feature[near] - feature[far]) <= most).all(-1),
    )
    at = np.argwhere(label >= 0)
    at = at[np.argsort(label[tuple(at.T)], kind="stable")]
    for cells in np.split(at, np.flatnonzero(np.diff(label[tuple(at.T)])) + 1) if len(at) else ():
        yield Patch.of(fit, cells)


def resting_planes(fit: RigidBodyFit) -> Bool[np.ndarray, "h w"]:
    """Which cells are of what things stand on or before: still planes, large and cut by the border of what is seen."""
    still = Patch.of(fit, np.argwhere(fit.assignment.best_motion == 0))
    found, left = np.zeros_like(fit.grid.valid), np.ones(len(still.cells), bool)
    first, last = _read_part(fit)
    for _ in range(_PLANES):
        mine = left & _filled(fit, still, _largest_plane(still, left))
        if mine.sum() <= _PLANE_SHARE * fit.grid.valid.sum():
            break
        cells = still.cells[mine]
        cut = ((cells <= first) | (cells >= last)).any()
        if cut and _curvature(still.xyz_cam[mine]) < _CURVED:
            found[tuple(cells.T)] = True
        left &= ~mine
    return found


def _read_part(fit: RigidBodyFit) -> tuple[Int64[np.ndarray, "2"], Int64[np.ndarray, "2"]]:
    """First and last row and column of the cells that the depth camera sees.

    These are the picture's, but where a frame of it never has depth, as in one that was brought to the color camera. A
    thing before what is too far away to have depth has no such straight border at the picture's own.
    """
    ever = fit.pictures.depth.max(0)[::STEP, ::STEP] > 0
    sides = [(_frame(ever.mean(axis)), _frame(ever.mean(axis)[::-1])) for axis in (1, 0)]
    return (
        np.array([before for before, _ in sides]),
        np.array([n - 1 - after for n, (_, after) in zip(ever.shape, sides, strict=True)]),
    )


def _frame(share: Float64[np.ndarray, "n"]) -> int:
    """How many rows at the beginning have no depth, told by the share of each that has; 0 if that is no frame."""
    read = np.flatnonzero(share > _READ)
    if len(read) == 0 or read[0] > _FRAME * len(share) or (share[: max(read[0] - _RAGGED, 0)] > _STRAY).any():
        return 0
    return int(read[0])


def _largest_plane(patch: Patch, left: Bool[np.ndarray, "n"]) -> Bool[np.ndarray, "n"]:
    """Which of the cells that are left lie in the plane through one of them that has most."""
    known = np.linalg.norm(patch.normals, axis=1) > 0.5
    some = np.flatnonzero(known & left)
    best = np.zeros(len(left), bool)
    near = _OFF_PLANE * np.maximum(1, patch.xyz_cam[:, 2])
    for k in some[np.linspace(0, len(some) - 1, min(_TRIED, len(some))).astype(int)]:
        normal = patch.normals[k] / np.linalg.norm(patch.normals[k])
        along = ~known | (patch.normals @ normal > _ALONG)
        mine = left & along & (np.abs((patch.xyz_cam - patch.xyz_cam[k]) @ normal) < near)
        if mine.sum() > best.sum():
            best = mine
    return best


def _filled(fit: RigidBodyFit, patch: Patch, mine: Bool[np.ndarray, "n"]) -> Bool[np.ndarray, "n"]:
    """With the cells in the plane that look like most of those around, which are: noise turns normals any way."""
    if not mine.any():
        return mine
    center = patch.xyz_cam[mine].mean(0)
    normal = np.linalg.eigh(np.cov(patch.xyz_cam[mine] - center, rowvar=False, bias=True))[1][:, 0]
    at, mask = tuple(patch.cells.T), np.zeros(fit.grid.valid.shape, np.float32)
    mask[tuple(patch.cells[mine].T)] = 1
    color = fit.pictures.feature[0, ::STEP, ::STEP, 1:].astype(np.float32)
    share, total = cv2.blur(mask, _AROUND)[at], cv2.blur(mask[..., None] * color, _AROUND)[at]
    alike = (np.abs(color[at] - total / np.maximum(share, 1e-6)[:, None]) <= _UNLIKE).all(1)
    near = _OFF_PLANE * np.maximum(1, patch.xyz_cam[:, 2] ** 2)  # as a triangulating camera's noise grows
    return mine | ((share > 0.5) & alike & (np.abs((patch.xyz_cam - center) @ normal) < near))


def _curvature(xyz: Float64[np.ndarray, "n 3"]) -> float:
    """The largest curvature [1/m] of the paraboloid through points that lie about in a plane."""
    centered = xyz - xyz.mean(0)
    x, y, z = (centered @ np.linalg.svd(centered, full_matrices=False)[2].T).T
    terms = np.stack([np.ones_like(x), x, y, x * x / 2, x * y, y * y / 2], 1)
    _, _, _, xx, xy, yy = np.linalg.lstsq(terms, z, rcond=None)[0]
    return float(np.abs(np.linalg.eigvalsh([[xx, xy], [xy, yy]])).max())


def patches_beside(
    fit: RigidBodyFit, patches: list[Patch], xyz_cam: Float64[np.ndarray, "M 3"]
) -> Iterator[tuple[int, Int64[np.ndarray, "m"]]]:
    """Every patch that some points may be of, with these points.

    A point may be of the patch that is nearest to it, and of all that are as near as a pixel's color reaches: at the
    border of a thing nothing tells whether a point is of it or of what is beside; least of all where no cell near is
    like the pixel.
    """
    if not patches:
        return
    owner = np.repeat(np.arange(len(patches)), [len(p.cells) for p in patches])
    tree = cKDTree(np.concatenate([p.xyz_cam for p in patches]))
    nearest = np.asarray(tree.query(xyz_cam)[1])
    pixels = np.concatenate([p.pixels for p in patches]).astype(int)[nearest]
    feature = fit.pictures.feature[0, ..., 1:].astype(np.int16)
    height, width = feature.shape[:2]
    own = np.rint(fit.pictures.project(xyz_cam)).astype(int).clip(0, [width - 1, height - 1])
    unlike = (np.abs(feature[own[:, 1], own[:, 0]] - feature[pixels[:, 1], pixels[:, 0]]) > _UNLIKE).any(1)
    reach = np.where(unlike, _BESIDE_UNLIKE, _BESIDE) * STEP * xyz_cam[:, 2] / fit.pictures.K[0, 0]
    around = tree.query_ball_point(xyz_cam, reach)
    near = [np.unique(owner[[nearest[i], *around[i]]]) for i in range(len(xyz_cam))]
    point, patch = np.repeat(np.arange(len(near)), [len(mine) for mine in near]), np.concatenate(near)
    for k in np.unique(patch):
        yield int(k), point[patch == k]
