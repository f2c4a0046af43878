"""What of the first frame stays, what moves away, and what cannot be told: by the depth of all frames."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int32
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from flowlab.tracking.trackers.rigid_bodies.features import ClipFeatures

STEP = 2
"""Every how many pixels, both ways, the first frame is labeled."""
_LATE = 0.85
"""What is still must still be there in the last frames."""
_STILL_SCENE = 0.25
"""A camera that stands still sees at least this share of the scene stay."""
_BAND = 6
"""Cells around what moves in which labels are decided by cost, not by having stayed."""


@dataclass(frozen=True, slots=True)
class Grid:
    """The cells of the first frame that get a label: every second pixel of every second row."""

    v: Int32[np.ndarray, "h w"]
    u: Int32[np.ndarray, "h w"]
    depth: Float32[np.ndarray, "h w"]
    """At the first frame [m]."""
    valid: Bool[np.ndarray, "h w"]
    """Has depth."""
    edge: Bool[np.ndarray, "h w"]
    """Lies at a depth edge."""
    moved: Bool[np.ndarray, "h w"]
    """The camera later looks through where it was."""
    still: Bool[np.ndarray, "h w"]
    """Looks the same and is as deep to the end."""
    open: Bool[np.ndarray, "h w"]
    """Not still, or near something that moved: its motion is to be found."""

    def pixels(self, mask: np.ndarray) -> Int32[np.ndarray, "n 2"]:
        """(u, v) of the cells of a mask."""
        return np.stack([self.u[mask], self.v[mask]], 1)

    def components(self, mask: np.ndarray) -> list[np.ndarray]:
        """The connected parts of a mask, the largest first; depth jumps divide."""
        cell = np.arange(mask.size).reshape(mask.shape)
        joins = []
        for near, far in (np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:]):
            same = np.abs(self.depth[near] - self.depth[far]) < 0.03 * np.maximum(1, self.depth[near])
            both = mask[near] & mask[far] & same
            joins.append(np.stack([cell[near][both], cell[far][both]]))
        a, b = np.concatenate(joins, 1)
        label = connected_components(coo_matrix((np.ones(len(a)), (a, b)), (mask.size, mask.size)), False)[1]
        label = np.where(mask, label.reshape(mask.shape), -1)
        names, counts = np.unique(label[mask], return_counts=True)
        return [label == name for name in names[np.argsort(-counts, kind="stable")]]


def divide(pictures: ClipFeatures) -> Grid:
    """Sort the cells of the first frame into still, moved and unknown, by what every later frame shows there.

    Free space seen where a surface was means that it moved; something in front of it only hides it.
    """
    height, width = pictures.depth.shape[1:]
    v, u = (x.astype(np.int32) for x in np.mgrid[0:height:STEP, 0:width:STEP])
    nearest0, farthest0 = _extremes(pictures.depth[0])
    edge = (farthest0 - nearest0) > 0.02 * np.maximum(pictures.depth[0], 0.1) + 0.01
    z = pictures.depth[0, ::STEP, ::STEP]
    within = 0.010 * np.maximum(1, z * z)
    through, near, unlike, late = np.zeros((4, *z.shape))
    for t in range(1, len(pictures)):
        low, high = (x[::STEP, ::STEP] for x in _extremes(pictures.depth[t]))
        d = pictures.depth[t, ::STEP, ::STEP]
        seen_through = (high > 0) & (low > z + within)
        there = (high > 0) & ~seen_through
        there &= (np.abs(d - z) < within) | (np.abs(low - z) < within) | (np.abs(high - z) < within)
        through += seen_through
        near += there
        late += there & (t >= _LATE * len(pictures))
        change = cv2.blur(cv2.absdiff(pictures.feature[t, :, :, 0], pictures.feature[0, :, :, 0]), (5, 5))
        unlike += there * change[::STEP, ::STEP]
    valid = z > 0
    moved = valid & (through >= max(2, 0.03 * len(pictures)))
    moved &= cv2.boxFilter(moved.astype(np.float32), -1, (3, 3), normalize=False) >= 3
    steps = len(pictures) - 1
    looks_different = (unlike / np.maximum(near, 1) > 64) & _textured(pictures)[::STEP, ::STEP]
    still = valid & ~moved & (near >= 0.25 * steps) & (late >= 0.5 * (1 - _LATE) * steps) & ~looks_different
    if still.sum() < _STILL_SCENE * valid.sum():
        still[:] = False  # the camera moves: what looks the same does so by chance
    grid = Grid(v, u, z, valid, edge[::STEP, ::STEP], moved, still, valid & ~still)
    return Grid(v, u, z, valid, grid.edge, moved, still, grid.open | _grow(grid, moved))


def _extremes(depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Least and greatest reading in the 3x3 pixels around each; 99 and 0 where there is none."""
    k = np.ones((3, 3), np.uint8)
    return cv2.erode(np.where(depth > 0, depth, np.float32(99)), k), cv2.dilate(depth, k)


def _textured(pictures: ClipFeatures) -> np.ndarray:
    """Where the first frame has texture to recognize."""
    gray = pictures.lightness(0)
    mean = cv2.blur(gray, (9, 9))
    return cv2.blur(gray * gray, (9, 9)) - mean * mean > 64


def _grow(grid: Grid, mask: np.ndarray) -> np.ndarray:
    """The mask and the cells within reach of it over unbroken surface."""
    for _ in range(_BAND):
        grown = mask.copy()
        for near, far in (np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:]):
            same = np.abs(grid.depth[near] - grid.depth[far]) < 0.02 * np.maximum(1, grid.depth[far])
            grown[near] |= mask[far] & same
            grown[far] |= mask[near] & same
        mask = grown & grid.valid
    return mask
