"""Which body a pixel belongs to: the one that best explains its depth and color over all frames."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int64

from flowlab.tracking.trackers.rigid_bodies import _kernels
from flowlab.tracking.trackers.rigid_bodies.alignment import Body
from flowlab.tracking.trackers.rigid_bodies.features import ClipFeatures
from flowlab.tracking.trackers.rigid_bodies.motion import RigidMotion
from flowlab.tracking.trackers.rigid_bodies.segments import STEP, Grid

_FRAMES = 32
"""Frames that are looked at."""
_PRICE = 0.08
"""What a motion costs for the share of frames in which it really moves the point: prefers stillness."""
_UNDECIDED = 0.9
_REACH, _DEPTH_SCALE, _COLOR_SCALE, _SPACE_SCALE = 3, 0.010, 0.35, 2.0


@dataclass(frozen=True, slots=True)
class Labels:
    """The cost of every motion in every cell; motion 0 is stillness."""

    raw: Float32[np.ndarray, "B h w"]
    cost: Float32[np.ndarray, "B h w"]
    """Averaged over neighbors that look alike; infinite where the cell has no depth."""

    @property
    def of_cell(self) -> Int64[np.ndarray, "h w"]:
        """The best motion of every cell, -1 where there is no depth."""
        return np.where(np.isfinite(self.cost[0]), self.cost.argmin(0), -1)

    def keep(self, motions: Sequence[int]) -> "Labels":
        """The same with some of the motions only."""
        return Labels(self.raw[list(motions)], self.cost[list(motions)])


def point_costs(
    pictures: ClipFeatures, motions: Sequence[RigidMotion], uv: np.ndarray, xyz_cam: np.ndarray, price: float = _PRICE
) -> Float32[np.ndarray, "B n"]:
    """How badly each motion explains points, at pixels (n, 2) and positions (n, 3) of the first frame."""
    frames = np.unique(np.linspace(1, len(pictures) - 1, min(len(pictures) - 1, _FRAMES)).round().astype(int))
    features = _kernels.features_at(pictures.feature[0], uv.astype(np.float32))
    R, t = np.stack([m.R for m in motions]), np.stack([m.t for m in motions])
    cost, moved = _kernels.label_costs(xyz_cam, features, frames, R, t, pictures.depth, pictures.feature, pictures.K)
    return cost + price * moved


def label(pictures: ClipFeatures, grid: Grid, bodies: Sequence[Body]) -> Labels:
    """Costs of stillness and of every body, in all cells whose motion is open."""
    motions = [RigidMotion.still(len(pictures)), *(b.motion for b in bodies)]
    raw = np.full((len(motions), *grid.valid.shape), _UNDECIDED, np.float32)
    raw[0] = 0
    uv = grid.pixels(grid.open)
    xyz = pictures.unproject(uv.astype(float), grid.depth[grid.open].astype(float))
    raw[:, grid.open] = point_costs(pictures, motions, uv, xyz)
    feature = pictures.feature[0, ::STEP, ::STEP]
    cost = _kernels.aggregate(
        raw, grid.open, grid.valid, grid.depth, feature, _REACH, _DEPTH_SCALE, _COLOR_SCALE, _SPACE_SCALE
    )
    return Labels(raw, cost)


def needed(labels: Labels, margin: float = 0.10) -> list[int]:
    """The motions worth having: dropped, one by one, is what costs its cells little to do without."""
    kept = list(range(len(labels.cost)))
    while len(kept) > 2:
        cost = labels.cost[kept]
        valid = np.isfinite(cost[0])
        best, second = np.partition(cost[:, valid], 1, axis=0)[:2]
        owner, gain = cost[:, valid].argmin(0), second - best
        worth = [gain[owner == k].mean() if (owner == k).any() else 0.0 for k in range(1, len(kept))]
        least = int(np.argmin(worth))
        if worth[least] > margin:
            break
        kept.pop(1 + least)
    return kept
