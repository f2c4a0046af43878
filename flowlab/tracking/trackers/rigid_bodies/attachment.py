"""Things that others take along, and put down: what holds a thing tells how it moves, though it hides it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, Num

from flowlab.tracking.trackers.rigid_bodies.assignment import BodyAssignment, frame_costs, looked_at, motion_costs
from flowlab.tracking.trackers.rigid_bodies.bodies import changed_body
from flowlab.tracking.trackers.rigid_bodies.features import ClipFeatures
from flowlab.tracking.trackers.rigid_bodies.motion_segmentation import MotionGrid
from flowlab.tracking.trackers.rigid_bodies.pose_tracking import RigidBody
from flowlab.tracking.trackers.rigid_bodies.rigid_motion import RigidMotion

_EXPLAINED, _GAIN, _PUT_DOWN_GAIN = 0.25, 0.01, 0.03
"""Regions whose motion costs less in the mean are left alone; how much less one must cost with which another body goes
on; and how much less yet one that rests in the end."""
_REGIONS, _LEAST_CELLS, _CELLS = 12, 6, 32
"""Regions that are looked at, the largest first; cells of the smallest, and how many of each are looked at."""
_MOMENTS = 24
"""Moments that are tried at most."""
_LOST, _SLACK = 0.5, 1.5
"""In a frame that costs more a motion explains a region no longer; and by how much more than the least the sum of what
frames cost beyond that may be at a moment that is tried."""
_OPEN = 0.65
"""What a frame costs for which another motion may be found yet, a little more than to be hidden."""
_TAKEN = 6
"""Of the ways in which a thing may have been taken, how many are tried as put down later."""


def attached_bodies(
    pictures: ClipFeatures, grid: MotionGrid, bodies: Sequence[RigidBody], assignment: BodyAssignment
) -> list[RigidBody]:
    """Bodies that from some moment on move with another one, as if they were attached to it.

    Args:
        pictures: The clip.
        grid: The cells of its first frame.
        bodies: Those found. What stands still is one more: attached to it, a thing that was let go rests.
        assignment: What their motions cost.
    """
    motions = [pictures.stillness, *(b.motion for b in bodies)]
    found = []
    for owner, cells in _regions(grid, assignment):
        if motion := _attached(_Region.of(pictures, grid, cells), motions, owner):
            found.append(changed_body(pictures, grid, cells, motion))
    return found


def attach(before: RigidMotion, after: RigidMotion, frame: int) -> RigidMotion:
    """The motion ``before`` up to a frame, and from then on as a thing moves that is attached to one that moves as
    ``after`` says."""
    R, t, later = before.R.copy(), before.t.copy(), slice(frame + 1, None)
    back = after.R[frame].T
    R[later] = after.R[later] @ (back @ before.R[frame])
    t[later] = after.R[later] @ (back @ (before.t[frame] - after.t[frame])) + after.t[later]
    return RigidMotion(R, t)


def _regions(grid: MotionGrid, assignment: BodyAssignment) -> list[tuple[int, Bool[np.ndarray, "h w"]]]:
    """Connected cells that one motion explains best, yet not well, with that motion, the largest first."""
    owner, found = assignment.best_motion, []
    for k, cost in enumerate(assignment.cost):
        parts = grid.components(owner == k)[:2] if k else grid.components((owner == 0) & grid.moved)[:6]
        found += [(k, p) for p in parts if p.sum() >= _LEAST_CELLS and cost[p].mean() > _EXPLAINED]
    return sorted(found, key=lambda part: -int(part[1].sum()))[:_REGIONS]


@dataclass(frozen=True, slots=True)
class _Region:
    """Some cells that move as one."""

    pictures: ClipFeatures
    grid: MotionGrid
    uv: Num[np.ndarray, "n 2"]
    xyz_cam: Float64[np.ndarray, "n 3"]

    @classmethod
    def of(cls, pictures: ClipFeatures, grid: MotionGrid, cells: Bool[np.ndarray, "h w"]) -> "_Region":
        """Evenly many of the cells, without depth edges if enough remains."""
        inner = cells & ~grid.edge
        places = np.argwhere(inner if inner.sum() >= _LEAST_CELLS else cells)
        i, j = places[np.linspace(0, len(places) - 1, min(len(places), _CELLS)).astype(int)].T
        uv = np.stack([grid.u[i, j], grid.v[i, j]], 1)
        return cls(pictures, grid, uv, pictures.unproject(uv.astype(float), grid.depth[i, j].astype(float)))

    def costs(self, motions: Sequence[RigidMotion]) -> Float32[np.ndarray, "B"]:
        """What each motion costs in the mean."""
        return np.asarray(motion_costs(self.pictures, self.grid, motions, self.uv, self.xyz_cam).mean(1))

    def unfinished_costs(
        self, first: RigidMotion, motions: Sequence[RigidMotion], since: Int64[np.ndarray, "B"]
    ) -> Float64[np.ndarray, "B"]:
        """What each motion costs in the mean, if from its best moment on another might explain the region badly. Up to
        the frames ``since`` they all are as one is that comes ``first``."""
        frames, of = looked_at(self.pictures), (self.uv, self.xyz_cam)
        cost = frame_costs(self.pictures, self.grid, motions, *of, frames, since)
        begin = frame_costs(self.pictures, self.grid, [first], *of, frames)
        cost = np.where(frames <= since[:, None], begin, cost)
        return np.asarray((np.cumsum(cost - _OPEN, 1).min(1) / len(frames)).astype(float))

    def moments(self, motion: RigidMotion) -> list[int]:
        """The frames up to which a motion explains the region, and little less well a few before and after."""
        frames = np.arange(1, len(self.pictures) - 1)
        cost = frame_costs(self.pictures, self.grid, [motion], self.uv, self.xyz_cam, frames)[0]
        lost = np.cumsum(cost - _LOST)
        near = frames[lost <= lost.min() + _SLACK]
        return near[np.unique(np.linspace(0, len(near) - 1, min(len(near), _MOMENTS)).round().astype(int))].tolist()


def _attached(region: _Region, motions: Sequence[RigidMotion], owner: int) -> RigidMotion | None:
    """The motion that costs a region least of those that begin as stillness or as one that explains it best, go on
    attached to another, and perhaps rest in the end; None where that is no better than the motions themselves."""
    alone = region.costs(motions)
    begin = [motions[k] for k in dict.fromkeys((0, owner, int(alone.argmin())))]
    taken, cost = list[RigidMotion](), list[Float64[np.ndarray, "n"]]()
    for first in begin:
        moments = region.moments(first)
        after = [(then, t) for then in motions for t in moments]
        held = [attach(first, then, t) for then, t in after]
        cost.append(region.unfinished_costs(first, held, np.array([t for _, t in after])))
        taken += held
    taken = [taken[k] for k in np.argsort(np.concatenate(cost), kind="stable")[:_TAKEN]]
    put_down = [attach(held, motions[0], t) for held in taken for t in region.moments(held)]
    found = taken + put_down
    total = region.costs(found) + np.where(np.arange(len(found)) < len(taken), 0, _PUT_DOWN_GAIN)
    best = int(total.argmin())
    return found[best] if total[best] <= alone.min() - _GAIN else None
