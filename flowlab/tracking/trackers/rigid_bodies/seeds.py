"""Motions proposed by points that were followed: greedy RANSAC over whole paths."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float64, Int32
from scipy.spatial import cKDTree

from flowlab.tracking.trackers.rigid_bodies import _kernels
from flowlab.tracking.trackers.rigid_bodies.features import ClipFeatures
from flowlab.tracking.trackers.rigid_bodies.motion import RigidMotion, best_rigid

LEAST_SEEDS = 8
"""Fewer points prove no motion."""
_MOST_SEEDS = 1000
_FRAMES, _HYPOTHESES, _NEIGHBORS = 24, 60, 14
_INLIER = 0.75
"""Share of its known frames in which a point must follow a motion to belong to it."""
_flow: Any = cv2.calcOpticalFlowPyrLK  # by its stub the guess could not be None
_LK = {"winSize": (15, 15), "maxLevel": 3, "criteria": (3, 20, 0.01), "minEigThreshold": 1e-5}


@dataclass(frozen=True, slots=True)
class Proposal:
    """A motion, and the frame-0 pixels that follow it."""

    pixels: Int32[np.ndarray, "n 2"]
    motion: RigidMotion
    known: Bool[np.ndarray, "T"]
    """Frames in which enough of the pixels were followed to trust the motion."""


@dataclass(frozen=True, slots=True)
class Paths:
    """Points of the first frame, followed by optical flow as far as it would go."""

    pixels: Int32[np.ndarray, "n 2"]
    xyz_cam: Float64[np.ndarray, "T n 3"]
    known: Bool[np.ndarray, "T n"]


def flow(pictures: ClipFeatures, t: int, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where pixels (n, 2) of frame t - 1 are in frame t, and which of them come back when followed back."""
    before, after = (pictures.feature[k, :, :, 1].copy() for k in (t - 1, t))
    p = np.ascontiguousarray(uv, np.float32)
    q, found, _ = _flow(before, after, p, None, **_LK)
    back, found_back, _ = _flow(after, before, q, None, **_LK)
    height, width = pictures.depth.shape[1:]
    inside = (q >= 0).all(1) & (q[:, 0] <= width - 1) & (q[:, 1] <= height - 1)
    return q, inside & (found[:, 0] > 0) & (found_back[:, 0] > 0) & (np.linalg.norm(back - p, axis=1) < 1)


def follow_seeds(pictures: ClipFeatures, pixels: np.ndarray, rng: np.random.Generator) -> Paths:
    """Follow some of the pixels (n, 2) through all frames, lifted by the depth that continues their own."""
    if len(pixels) > _MOST_SEEDS:
        pixels = pixels[np.sort(rng.choice(len(pixels), _MOST_SEEDS, replace=False))]
    uv0 = pixels.astype(np.float32)
    z0 = pictures.depth[0, pixels[:, 1], pixels[:, 0]].astype(float)
    xyz = np.zeros((len(pictures), len(pixels), 3))
    known = np.zeros((len(pictures), len(pixels)), bool)
    xyz[0], known[0] = pictures.unproject(uv0, z0), True
    uv, z, alive, resting = uv0.copy(), z0.copy(), known[0].copy(), known[0].copy()
    for t in range(1, len(pictures)):
        change = cv2.blur(cv2.absdiff(pictures.feature[t, :, :, 0], pictures.feature[0, :, :, 0]), (5, 5))
        d = pictures.depth[t, pixels[:, 1], pixels[:, 0]]
        # A point that has not moved yet is where it was: flow would only let it drift.
        resting &= (np.abs(d - z0) < 0.010 * np.maximum(1, z0 * z0)) & (change[pixels[:, 1], pixels[:, 0]] < 30)
        uv[resting] = uv0[resting]
        going = np.flatnonzero(alive & ~resting)
        if len(going):
            q, ok = flow(pictures, t, uv[going])
            alive[going[~ok]] = False
            uv[going[ok]] = q[ok]
        reading, found = _continued(pictures.depth[t], uv, z)
        known[t] = alive & found
        z = np.where(known[t], reading, z)
        xyz[t] = pictures.unproject(uv, z)
    return Paths(pixels, xyz, known)


def _continued(depth: np.ndarray, uv: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of the readings around pixels (n, 2) the nearest to depths z (n,) [m], and whether it is within 3 cm."""
    height, width = depth.shape
    j, i = np.rint(uv).astype(int).T
    window = np.stack(
        [depth[np.clip(i + y, 0, height - 1), np.clip(j + x, 0, width - 1)] for y in (-1, 0, 1) for x in (-1, 0, 1)]
    )
    off = np.where(window > 0, np.abs(window - z), np.inf)
    best = off.argmin(0), np.arange(len(z))
    return window[best].astype(float), off[best] < 0.03


def propose(pictures: ClipFeatures, paths: Paths, most: int, rng: np.random.Generator) -> list[Proposal]:
    """Up to ``most`` motions that many paths follow, the best supported first.

    Each hypothesis is the motion of a point and its neighbors; the one that most paths follow for most of
    their frames is refined on those, and they are set aside.
    """
    frames = np.unique(np.linspace(0, len(pictures) - 1, min(len(pictures), _FRAMES)).round().astype(int))
    start, path, known = paths.xyz_cam[0], paths.xyz_cam[frames], paths.known[frames]
    within = 0.010 * np.maximum(1, path[..., 2] ** 2)
    length = known.sum(0)
    reach = np.where(known, np.linalg.norm(path - start, axis=-1), 0).max(0)
    free, misses = length >= 3, 0
    proposals: list[Proposal] = []

    def share(R: np.ndarray, t: np.ndarray, of: np.ndarray) -> np.ndarray:
        return _kernels.inlier_share(R, t, start[of], path[:, of], known[:, of], within[:, of])

    while free.sum() >= LEAST_SEEDS and len(proposals) < most and misses < 4:
        index = np.flatnonzero(free)
        chance = length[index] * np.minimum(reach[index], 0.1) + 1e-9
        center = rng.choice(len(index), min(_HYPOTHESES, len(index)), replace=False, p=chance / chance.sum())
        _, near = cKDTree(start[index]).query(start[index[center]], k=min(_NEIGHBORS, len(index)))
        near = index[near]
        weight = known[:, near].transpose(1, 0, 2) + 1e-9
        R, t = best_rigid(start[near][:, None], path[:, near].transpose(1, 0, 2, 3), weight, refinements=1)
        votes = [length[index][share(R[k], t[k], index) > _INLIER].sum() for k in range(len(near))]
        best = int(np.argmax(votes))
        Rb, tb = R[best], t[best]
        for least in (0.6, 0.6, _INLIER, _INLIER):
            fits = index[share(Rb, tb, index) > least]
            if len(fits) < 4:
                break
            Rb, tb = best_rigid(start[fits], path[:, fits], known[:, fits] + 1e-9, refinements=2)
        fits = index[share(Rb, tb, index) > _INLIER]
        if len(fits) < LEAST_SEEDS:
            free[near[best]] = False
            misses += 1
            continue
        motion = RigidMotion(
            *best_rigid(start[fits], paths.xyz_cam[:, fits], paths.known[:, fits] + 1e-9, refinements=3)
        )
        proposals.append(Proposal(paths.pixels[fits], motion, paths.known[:, fits].sum(1) >= 6))
        free[fits] = False
    return proposals
