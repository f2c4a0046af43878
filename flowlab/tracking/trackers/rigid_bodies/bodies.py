"""The bodies that explain a clip, and the regions of its first frame that are theirs."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Integer

from flowlab.tracking.trackers.rigid_bodies.assignment import BodyAssignment, CellCosts, assign, select_needed
from flowlab.tracking.trackers.rigid_bodies.features import ClipFeatures
from flowlab.tracking.trackers.rigid_bodies.motion_segmentation import STEP, MotionGrid
from flowlab.tracking.trackers.rigid_bodies.pose_tracking import RigidBody
from flowlab.tracking.trackers.rigid_bodies.rigid_motion import RigidMotion


@dataclass(frozen=True, slots=True)
class RigidBodyFit:
    """What explains a clip; motion k of the assignment is body k - 1, and 0 is stillness."""

    cells: CellCosts
    bodies: tuple[RigidBody, ...]
    assignment: BodyAssignment

    @classmethod
    def with_needed(cls, cells: CellCosts, bodies: Sequence[RigidBody]) -> "RigidBodyFit":
        """The fit by those of some bodies that explain what the others do not."""
        assignment = assign(cells, [b.motion for b in bodies])
        kept = select_needed(assignment, many_tell_more=not cells.pictures.still_is_fitted)
        return cls(cells, tuple(bodies[k - 1] for k in kept[1:]), assignment.select(kept))

    @property
    def pictures(self) -> ClipFeatures:
        """The clip."""
        return self.cells.pictures

    @property
    def grid(self) -> MotionGrid:
        """The cells of its first frame."""
        return self.cells.grid

    @property
    def motions(self) -> list[RigidMotion]:
        """Stillness, then the motion of every body."""
        return [self.pictures.stillness, *(b.motion for b in self.bodies)]


def new_body(pictures: ClipFeatures, grid: MotionGrid, region: Bool[np.ndarray, "h w"]) -> RigidBody:
    """A body of a region of cells, of whose motion nothing is known."""
    frames = len(pictures)
    pixels = region_pixels(pictures, grid, region)
    return RigidBody(pixels, RigidMotion.identity(frames), np.zeros(frames, bool), region)


def changed_body(
    pictures: ClipFeatures, grid: MotionGrid, region: Bool[np.ndarray, "h w"], guess: RigidMotion
) -> RigidBody:
    """A body of a region of cells that may move like another."""
    pixels = region_pixels(pictures, grid, region)
    return RigidBody(pixels, guess, np.ones(len(pictures), bool), region)


def region_pixels(
    pictures: ClipFeatures, grid: MotionGrid, region: Bool[np.ndarray, "h w"]
) -> Integer[np.ndarray, "n 2"]:
    """Pixels of a region of cells; without depth edges if enough remains, and all of them if it is small."""
    inner = region & ~grid.edge
    pixels = grid.pixels(inner if inner.sum() >= 10 else region)
    if len(pixels) >= 150:
        return pixels
    height, width = pictures.depth.shape[1:]
    within = np.array([(x, y) for x in range(STEP) for y in range(STEP)])
    near = np.minimum((pixels[:, None] + within).reshape(-1, 2), [width - 1, height - 1])
    z = np.repeat(pictures.depth[0, pixels[:, 1], pixels[:, 0]], len(within))
    d = pictures.depth[0, near[:, 1], near[:, 0]]
    return near[(d > 0) & (np.abs(d - z) < 0.02)]
