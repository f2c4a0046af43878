"""The whole fit: from pictures to the few rigid motions that explain them."""

from dataclasses import replace

import numpy as np

from flowlab.tracking.trackers.rigid_bodies.assignment import CellCosts, assign
from flowlab.tracking.trackers.rigid_bodies.attachment import attached_bodies
from flowlab.tracking.trackers.rigid_bodies.bodies import RigidBodyFit, changed_body, new_body
from flowlab.tracking.trackers.rigid_bodies.camera_motion import with_camera_motion
from flowlab.tracking.trackers.rigid_bodies.features import ClipFeatures
from flowlab.tracking.trackers.rigid_bodies.merging import merge
from flowlab.tracking.trackers.rigid_bodies.motion_segmentation import MotionGrid, segment_motion
from flowlab.tracking.trackers.rigid_bodies.pose_tracking import RigidBody, track_poses
from flowlab.tracking.trackers.rigid_bodies.proposals import propose_motions, track_seeds

_MAX_BODIES, _MAX_PROPOSALS = 20, 10
_ROUNDS, _MERGE_ROUNDS = 3, 2
_MIN_CELLS = 6
"""Fewer cells are no body."""
_UNEXPLAINED = 0.42
"""Cost above which no body explains a cell that moved."""


def fit_bodies(pictures: ClipFeatures, seed: int) -> RigidBodyFit:
    """Find the rigid bodies of a clip, their motions and which pixels are theirs.

    Args:
        pictures: The clip, of three frames at least.
        seed: Of the random choices; the same seed gives the same fit.
    """
    rng = np.random.default_rng(seed)
    pictures, grid = with_camera_motion(pictures, segment_motion(pictures), rng)
    seeds = track_seeds(pictures, grid.pixels(grid.valid & ~grid.static & ~grid.edge), rng)
    proposed = [RigidBody(p.pixels, p.motion, p.known) for p in propose_motions(seeds, _MAX_PROPOSALS, rng)]
    bodies = track_poses(pictures, [*_small_moved_bodies(pictures, grid), *proposed], rng)
    cells = CellCosts(pictures, grid)
    for k in range(_ROUNDS):
        fit = RigidBodyFit.with_needed(cells, bodies)
        bodies = refit(fit, rng)
        if k < _ROUNDS - 1:
            room = max(_MAX_BODIES - len(fit.bodies), 0)
            bodies += track_poses(pictures, _bodies_of_unexplained(cells, bodies, room), rng)
            bodies += _taken_along(cells, bodies, rng)
    fit = RigidBodyFit.with_needed(cells, bodies)
    for _ in range(_MERGE_ROUNDS):
        merged = merge(fit, rng)
        if merged is None:
            break
        fit = merged
    return RigidBodyFit.with_needed(cells, refit(fit, rng))


def _small_moved_bodies(pictures: ClipFeatures, grid: MotionGrid) -> list[RigidBody]:
    """Small connected things that moved are rigid bodies to begin with, with and without undecided cells around."""
    parts = [m for m in grid.components(grid.moved) if 7 <= m.sum() <= 900][:6]
    for whole in grid.components(grid.valid & ~grid.static)[:12]:
        moved = (whole & grid.moved).sum()
        if moved >= 7 and 1.25 * moved < whole.sum() <= 1200:
            parts.append(whole)
    changed = [m for m in grid.components(grid.changed & ~grid.moved) if 7 <= m.sum() <= 1200][:5]
    return [new_body(pictures, grid, m) for m in [*parts[:9], *changed]]


def _bodies_of_unexplained(cells: CellCosts, bodies: list[RigidBody], room: int) -> list[RigidBody]:
    """The largest connected things that moved and that no body explains, as many as there is room for."""
    assignment = assign(cells, [b.motion for b in bodies])
    unexplained = cells.grid.moved & (assignment.cost.min(0) > _UNEXPLAINED)
    parts = [m for m in cells.grid.components(unexplained) if m.sum() >= 7][: min(6, room)]
    return [new_body(cells.pictures, cells.grid, m) for m in parts]


def _taken_along(cells: CellCosts, bodies: list[RigidBody], rng: np.random.Generator) -> list[RigidBody]:
    """Things that others take along: moving as these do, and aligned to what pictures show of them, too."""
    found = attached_bodies(cells.pictures, cells.grid, bodies, assign(cells, [b.motion for b in bodies]))
    return [*found, *track_poses(cells.pictures, found, rng)]


def refit(fit: RigidBodyFit, rng: np.random.Generator) -> list[RigidBody]:
    """Every body on the largest connected part of the cells it won; where these are others, once tracked anew and once
    as it was, for by other cells it may be lost. Where the camera's motion was fitted, too, what motions cost errs too
    much to tell the two apart, and it is tracked anew only.

    Args:
        fit: The bodies, and which cells they won.
        rng: Chooses the pixels by which a body is tracked.
    """
    owner, kept, changed = fit.assignment.best_motion, [], []
    for k, body in enumerate(fit.bodies):
        parts = fit.grid.components(owner == k + 1)
        if not parts or parts[0].sum() < _MIN_CELLS:
            continue
        region = parts[0]
        same = body.region is not None and (body.region & region).sum() >= 0.8 * (body.region | region).sum()
        if same:
            kept.append(replace(body, region=region))
        else:
            changed.append(changed_body(fit.pictures, fit.grid, region, body.motion))
    as_they_were = [] if fit.pictures.still_is_fitted else changed
    return [*kept, *track_poses(fit.pictures, changed, rng), *as_they_were]
