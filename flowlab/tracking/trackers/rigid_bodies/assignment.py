"""Which body a pixel belongs to: the one that best explains its depth and color over all frames."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Float64, Int64, Num

from flowlab.tracking.trackers.rigid_bodies import _costs, _surfaces
from flowlab.tracking.trackers.rigid_bodies.features import ClipFeatures
from flowlab.tracking.trackers.rigid_bodies.motion_segmentation import STEP, MotionGrid
from flowlab.tracking.trackers.rigid_bodies.rigid_motion import RigidMotion

_FRAMES = 24
"""Frames that are looked at."""
MOTION_PENALTY = 0.08
"""What a motion costs for the share of frames in which it really moves the point: prefers stillness."""
_REFUTING_FRAMES, _REFUTED = 3, 0.3
"""In how many of the frames the camera looks through where a motion would put a point, so that it is another's
whatever the mean says, and what it costs."""
_NEEDED = 0.03, 0.10
"""How much more its cells must cost without a motion, in the mean, for it to be kept: the second where there are up to
a hundred, and less the more there are, as a mean over many errs less, down to the first. Where the camera's motion was
fitted, too, all cells share its error, and many tell no more."""
_UNKNOWN_COST = 0.9
_DOUBTFUL, _DOUBTED_COST, _SPREADS, _PLAIN_SCALE = 0.2, 0.5, 5, 0.08
"""Cells whose best motions differ by less, and of which one explains them, take the cost of their surroundings of the
same color: in so many rounds, with so narrow a width in color."""
_REACH, _DEPTH_SCALE, _COLOR_SCALE, _SPACE_SCALE = 3, 0.010, 0.35, 2.0
"""Of the mean over neighbors: cells to either side, and the widths in depth [m], color and cells."""


@dataclass(frozen=True, slots=True)
class BodyAssignment:
    """The cost of every motion in every cell; motion 0 is stillness."""

    raw: Float32[np.ndarray, "B h w"]
    cost: Float32[np.ndarray, "B h w"]
    """Averaged over neighbors that look alike; infinite where the cell has no depth."""

    @property
    def best_motion(self) -> Int64[np.ndarray, "h w"]:
        """The best motion of every cell, -1 where there is no depth."""
        return np.where(np.isfinite(self.cost[0]), self.cost.argmin(0), -1)

    @property
    def gain(self) -> Float64[np.ndarray, "B"]:
        """How much more the cells of each motion would cost with the next best one, in the mean; 0 if there is none."""
        return _gains(self.cost)[0] if len(self.cost) > 1 else np.zeros(1)

    def select(self, motions: Sequence[int]) -> "BodyAssignment":
        """The same with some of the motions only."""
        return BodyAssignment(self.raw[list(motions)], self.cost[list(motions)])


def motion_costs(
    pictures: ClipFeatures,
    grid: MotionGrid,
    motions: Sequence[RigidMotion],
    uv: Num[np.ndarray, "n 2"],
    xyz_cam: Float[np.ndarray, "n 3"],
    motion_penalty: float | Float[np.ndarray, "n"] = MOTION_PENALTY,
) -> Float32[np.ndarray, "B n"]:
    """How badly each motion explains points of the first frame, in the mean over the frames.

    Args:
        pictures: The clip.
        grid: What of its first frame stands still: where the pictures show that, nothing else is.
        motions: B of them.
        uv: The points' pixels.
        xyz_cam: Their positions [m].
        motion_penalty: Cost of moving a point, or each of them, by more than 1 cm in all frames.
    """
    what, shown = _compared(pictures, grid, uv, xyz_cam)
    frames = looked_at(pictures)
    from_first = np.zeros(len(motions), int)
    cost, moved, through = _costs.motion_costs(*what, frames, from_first, *_poses(motions), *shown)
    refuted = through * len(frames) >= _REFUTING_FRAMES
    return cost + np.asarray(motion_penalty, np.float32) * moved + np.float32(_REFUTED) * refuted


def frame_costs(
    pictures: ClipFeatures,
    grid: MotionGrid,
    motions: Sequence[RigidMotion],
    uv: Num[np.ndarray, "n 2"],
    xyz_cam: Float[np.ndarray, "n 3"],
    frames: Int64[np.ndarray, "F"],
    since: Int64[np.ndarray, "B"] | None = None,
) -> Float32[np.ndarray, "B F"]:
    """How badly each motion explains points of the first frame in each of some frames, in the mean over the points; 0
    up to the frames ``since``, which are not looked at."""
    what, shown = _compared(pictures, grid, uv, xyz_cam)
    since = np.zeros(len(motions), int) if since is None else since
    return np.asarray(_costs.frame_costs(*what, frames, since, *_poses(motions), *shown))


def looked_at(pictures: ClipFeatures) -> Int64[np.ndarray, "F"]:
    """The frames by which motions are judged."""
    return np.unique(np.linspace(1, len(pictures) - 1, min(len(pictures) - 1, _FRAMES)).round().astype(int))


def _poses(motions: Sequence[RigidMotion]) -> tuple[Float64[np.ndarray, "B T 3 3"], Float64[np.ndarray, "B T 3"]]:
    return np.stack([m.R for m in motions]), np.stack([m.t for m in motions])


def _compared(
    pictures: ClipFeatures, grid: MotionGrid, uv: np.ndarray, xyz_cam: np.ndarray
) -> tuple[tuple[np.ndarray, ...], tuple[np.ndarray, ...]]:
    """What is compared, points with their features, and with what: the pictures, and what stands still in them."""
    features = _costs.features_at(pictures.feature[0], uv.astype(np.float32))
    static = grid.in_pixels(grid.static, pictures.depth.shape[1:])
    still = pictures.stillness
    return (xyz_cam, features), (still.R, still.t, static, pictures.depth, pictures.feature, pictures.K)


class CellCosts:
    """What motions cost the cells of a clip's first frame whose motion is undecided; each is computed once."""

    def __init__(self, pictures: ClipFeatures, grid: MotionGrid) -> None:
        self.pictures = pictures
        self.grid = grid
        self.stillness = pictures.stillness
        self._known: dict[int, tuple[RigidMotion, np.ndarray]] = {}  # by the identity of the motion

    def of(self, motions: Sequence[RigidMotion]) -> Float32[np.ndarray, "B n"]:
        """The cost of each motion, see :func:`motion_costs`."""
        if new := [m for m in motions if id(m) not in self._known]:
            uv = self.grid.pixels(self.grid.undecided)
            xyz = self.pictures.unproject(uv.astype(float), self.grid.depth[self.grid.undecided].astype(float))
            cost = motion_costs(self.pictures, self.grid, new, uv, xyz)
            self._known.update({id(m): (m, c) for m, c in zip(new, cost, strict=True)})
        return np.stack([self._known[id(m)][1] for m in motions])


def assign(cells: CellCosts, motions: Sequence[RigidMotion]) -> BodyAssignment:
    """Costs of stillness and of some motions, in all cells whose motion is undecided."""
    grid, every = cells.grid, [cells.stillness, *motions]
    raw = np.full((len(every), *grid.valid.shape), _UNKNOWN_COST, np.float32)
    raw[0] = 0
    raw[:, grid.undecided] = cells.of(every)
    feature = cells.pictures.feature[0, ::STEP, ::STEP]
    cost = _surfaces.aggregate(
        raw, grid.undecided, grid.valid, grid.depth, feature, _REACH, _DEPTH_SCALE, _COLOR_SCALE, _SPACE_SCALE
    )
    if len(every) > 1:
        _decide_by_surroundings(raw, cost, grid, feature)
    return BodyAssignment(raw, cost)


def _decide_by_surroundings(raw: np.ndarray, cost: np.ndarray, grid: MotionGrid, feature: np.ndarray) -> None:
    """Spread costs (B, h, w) over plain surfaces, in place: what slides along itself looks as if it stood still, but
    for its border."""
    best, second = np.partition(cost[:, grid.undecided], 1, axis=0)[:2]
    open_to_doubt = grid.undecided.copy()
    open_to_doubt[grid.undecided] = (second - best < _DOUBTFUL) & (best < _DOUBTED_COST)
    settled = np.where(np.isfinite(cost), cost, 0)
    for _ in range(_SPREADS):
        settled = _surfaces.aggregate(
            settled, open_to_doubt, grid.valid, grid.depth, feature, _REACH, _DEPTH_SCALE, _PLAIN_SCALE, _REACH
        )
        settled[~np.isfinite(settled)] = 0
    cost[:, open_to_doubt] = raw[:, open_to_doubt] = settled[:, open_to_doubt]


def _gains(cost: Float32[np.ndarray, "B h w"]) -> tuple[Float64[np.ndarray, "B"], Int64[np.ndarray, "B"]]:
    """How much more the cells of each of two or more motions would cost with the next best one, in the mean, and how
    many these are, at least 1."""
    found = cost[:, np.isfinite(cost[0])]
    best, second = np.partition(found, 1, axis=0)[:2]
    owner = found.argmin(0)
    cells = np.bincount(owner, minlength=len(cost)).clip(1)
    return np.bincount(owner, second - best, len(cost)) / cells, cells


def select_needed(assignment: BodyAssignment, many_tell_more: bool = True) -> list[int]:
    """The motions worth having: dropped, one by one, is what costs its cells little to do without.

    Args:
        assignment: What every motion costs.
        many_tell_more: Whether a motion of many cells is needed though each gains little by it.

    Returns:
        Indices of the motions to keep, stillness and at least one more among them, where there is one.
    """
    kept = list(range(len(assignment.cost)))
    while len(kept) > 2:
        worth, cells = (x[1:] for x in _gains(assignment.cost[kept]))
        needed = np.clip(1 / np.sqrt(cells), *_NEEDED) if many_tell_more else np.full(len(cells), _NEEDED[1])
        least = int(np.argmin(worth / needed))
        if worth[least] > needed[least]:
            break
        kept.pop(1 + least)
    return kept
