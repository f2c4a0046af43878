"""Motions proposed by points that were tracked: greedy RANSAC over whole trajectories."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32, Num
from scipy.spatial import cKDTree

from flowlab.tracking.trackers.rigid_bodies._costs import inlier_shares
from flowlab.tracking.trackers.rigid_bodies.features import ClipFeatures
from flowlab.tracking.trackers.rigid_bodies.rigid_motion import RigidMotion, fit_rigid

MIN_SEEDS = 8
"""Fewer trajectories prove no motion."""
_MAX_SEEDS = 1000
_FRAMES, _HYPOTHESES, _NEIGHBORS = 24, 60, 14
_INLIER = 0.75
"""Share of its known frames in which a trajectory must follow a motion to belong to it."""
_flow: Any = cv2.calcOpticalFlowPyrLK  # by its stub the guess could not be None
_LK = {"winSize": (15, 15), "maxLevel": 3, "criteria": (3, 20, 0.01)}


@dataclass(frozen=True, slots=True)
class MotionProposal:
    """A motion, and the frame-0 pixels that follow it."""

    pixels: Int32[np.ndarray, "n 2"]
    motion: RigidMotion
    known: Bool[np.ndarray, "T"]
    """Frames in which enough of the pixels were tracked to trust the motion."""


@dataclass(frozen=True, slots=True)
class Trajectories:
    """Points of the first frame, tracked by optical flow as far as it would go."""

    pixels: Int32[np.ndarray, "n 2"]
    xyz_cam: Float64[np.ndarray, "T n 3"]
    known: Bool[np.ndarray, "T n"]
    still: Float64[np.ndarray, "T n 3"]
    """Where they would be if they stood still."""


def flow(
    pictures: ClipFeatures, t: int, uv: Num[np.ndarray, "n 2"], least_texture: float = 1e-5
) -> tuple[Float32[np.ndarray, "n 2"], Bool[np.ndarray, "n"]]:
    """Where pixels (n, 2) of frame t - 1 are in frame t, and which of them come back when followed back.

    What has less texture, as OpenCV's least eigenvalue tells it, is not followed.
    """
    before, after = (pictures.feature[k, :, :, 1].copy() for k in (t - 1, t))
    p = np.ascontiguousarray(uv, np.float32)
    options = {**_LK, "minEigThreshold": least_texture}
    q, found, _ = _flow(before, after, p, None, **options)
    back, found_back, _ = _flow(after, before, q, None, **options)
    height, width = pictures.depth.shape[1:]
    inside = (q >= 0).all(1) & (q[:, 0] <= width - 1) & (q[:, 1] <= height - 1)
    return q, inside & (found[:, 0] > 0) & (found_back[:, 0] > 0) & (np.linalg.norm(back - p, axis=1) < 1)


def track_seeds(pictures: ClipFeatures, pixels: Int32[np.ndarray, "n 2"], rng: np.random.Generator) -> Trajectories:
    """Track pixels of the first frame through all frames, lifted by the depth that continues their own.

    Args:
        pictures: The clip.
        pixels: (u, v); each has depth. At most 1000 of them are tracked.
        rng: Chooses which.
    """
    if len(pixels) > _MAX_SEEDS:
        pixels = pixels[np.sort(rng.choice(len(pixels), _MAX_SEEDS, replace=False))]
    uv0 = pixels.astype(np.float32)
    z0 = pictures.depth[0, pixels[:, 1], pixels[:, 0]].astype(float)
    xyz = np.zeros((len(pictures), len(pixels), 3))
    known = np.zeros((len(pictures), len(pixels)), bool)
    xyz[0], known[0] = pictures.unproject(uv0, z0), True
    still = pictures.stillness.apply(xyz[0])
    still_uv = pictures.project(still).astype(np.float32)
    uv, z, alive, resting = uv0.copy(), z0.copy(), known[0].copy(), known[0].copy()
    for t in range(1, len(pictures)):
        # A point that has not moved yet is where it was: flow would only let it drift.
        at, deep = still_uv[t], still[t, :, 2]
        resting &= _rests(pictures, t, pixels, at, deep)
        uv[resting], z[resting] = at[resting], deep[resting]
        going = np.flatnonzero(alive & ~resting)
        if len(going):
            q, ok = flow(pictures, t, uv[going])
            alive[going[~ok]] = False
            uv[going[ok]] = q[ok]
        reading, found = _nearest_around(pictures.depth[t], uv, z)
        known[t] = alive & found
        z = np.where(known[t], reading, z)
        xyz[t] = pictures.unproject(uv, z)
    return Trajectories(pixels, xyz, known, still)


def _rests(pictures: ClipFeatures, t: int, pixels: np.ndarray, at: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Whether frame t shows at pixels (n, 2) and depths (n,) [m] what the first frame shows at other pixels (n, 2)."""
    height, width = pictures.depth.shape[1:]
    j, i = np.clip(np.rint(at), 0, [width - 1, height - 1]).astype(int).T
    inside = (at >= 0).all(1) & (at[:, 0] <= width - 1) & (at[:, 1] <= height - 1)
    near = np.abs(pictures.depth[t, i, j] - z) < 0.010 * np.maximum(1, z * z)
    then, now = pictures.feature[0, :, :, 0], pictures.feature[t, :, :, 0]
    change = np.zeros(len(z))
    for y, x in np.argwhere(np.ones((5, 5))) - 2:
        a, b = np.clip(i + y, 0, height - 1), np.clip(j + x, 0, width - 1)
        c, d = np.clip(pixels[:, 1] + y, 0, height - 1), np.clip(pixels[:, 0] + x, 0, width - 1)
        change += np.abs(now[a, b].astype(float) - then[c, d])
    return inside & near & (change / 25 < 30)


def _nearest_around(depth: np.ndarray, uv: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of the readings around pixels (n, 2) the nearest to depths z (n,) [m], and whether it is within 3 cm."""
    height, width = depth.shape
    j, i = np.rint(uv).astype(int).T
    window = np.stack(
        [depth[np.clip(i + y, 0, height - 1), np.clip(j + x, 0, width - 1)] for y in (-1, 0, 1) for x in (-1, 0, 1)]
    )
    off = np.where(window > 0, np.abs(window - z), np.inf)
    best = off.argmin(0), np.arange(len(z))
    return window[best].astype(float), off[best] < 0.03


def propose_motions(paths: Trajectories, most: int, rng: np.random.Generator) -> list[MotionProposal]:
    """Motions that many trajectories follow: RANSAC, whose winner is refined and its inliers set aside, over again.

    Args:
        paths: The trajectories.
        most: How many motions to propose at most.
        rng: Chooses the points whose surroundings are tried.

    Returns:
        The motions, in the order in which they were found, the best supported first.
    """
    ransac = _Ransac(paths)
    free, misses = ransac.length >= 3, 0
    proposals: list[MotionProposal] = []
    while free.sum() >= MIN_SEEDS and len(proposals) < most and misses < 4:
        index = np.flatnonzero(free)
        neighbors, (R, t) = ransac.best_hypothesis(index, rng)
        fits = ransac.refine(index, R, t)
        if len(fits) < MIN_SEEDS:
            free[neighbors] = False
            misses += 1
            continue
        all_known = paths.known[:, fits]
        motion = RigidMotion(*fit_rigid(ransac.start[fits], paths.xyz_cam[:, fits], all_known + 1e-9, refinements=3))
        proposals.append(MotionProposal(paths.pixels[fits], motion, all_known.sum(1) >= 6))
        free[fits] = False
    return proposals


class _Ransac:
    """Trajectories in a sample of the frames, and the motions that few or many of them follow."""

    def __init__(self, paths: Trajectories) -> None:
        steps = len(paths.known)
        frames = np.unique(np.linspace(0, steps - 1, min(steps, _FRAMES)).round().astype(int))
        self.start, self._path, self._known = paths.xyz_cam[0], paths.xyz_cam[frames], paths.known[frames]
        self._within = 0.010 * np.maximum(1, self._path[..., 2] ** 2)
        self.length = self._known.sum(0)
        self._reach = np.where(self._known, np.linalg.norm(self._path - paths.still[frames], axis=-1), 0).max(0)

    def best_hypothesis(
        self, index: np.ndarray, rng: np.random.Generator
    ) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
        """Of the motions of some points and their neighbors among ``index`` the one that most follow, and of whom."""
        start, path, known = self.start, self._path, self._known
        chance = self.length[index] * np.minimum(self._reach[index], 0.1) + 1e-9
        center = rng.choice(len(index), min(_HYPOTHESES, len(index)), replace=False, p=chance / chance.sum())
        _, near = cKDTree(start[index]).query(start[index[center]], k=min(_NEIGHBORS, len(index)))
        near = index[near]
        weight = known[:, near].transpose(1, 0, 2) + 1e-9
        R, t = fit_rigid(start[near][:, None], path[:, near].transpose(1, 0, 2, 3), weight, refinements=1)
        votes = [self.length[index][self._shares(R[k], t[k], index) > _INLIER].sum() for k in range(len(near))]
        best = int(np.argmax(votes))
        return near[best], (R[best], t[best])

    def refine(self, index: np.ndarray, R: np.ndarray, t: np.ndarray) -> np.ndarray:
        """Those of ``index`` that follow a motion, once it is fitted to those who do."""
        for least in (0.6, 0.6, _INLIER, _INLIER):
            fits = index[self._shares(R, t, index) > least]
            if len(fits) < 4:
                break
            R, t = fit_rigid(self.start[fits], self._path[:, fits], self._known[:, fits] + 1e-9, refinements=2)
        return index[self._shares(R, t, index) > _INLIER]

    def _shares(self, R: np.ndarray, t: np.ndarray, of: np.ndarray) -> np.ndarray:
        """Share of their frames in which trajectories follow a motion."""
        return inlier_shares(R, t, self.start[of], self._path[:, of], self._known[:, of], self._within[:, of])
