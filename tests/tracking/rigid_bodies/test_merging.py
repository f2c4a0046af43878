"""Bodies that are one are merged, and others are not."""

from dataclasses import replace

import moving_planes
import numpy as np
from rigid_body_scenes import Scene, scene, two_plates

from flowlab.tracking.trackers.rigid_bodies.assignment import BodyAssignment, CellCosts
from flowlab.tracking.trackers.rigid_bodies.bodies import RigidBodyFit, new_body, region_pixels
from flowlab.tracking.trackers.rigid_bodies.fit import fit_bodies, refit
from flowlab.tracking.trackers.rigid_bodies.merging import merge, neighbors
from flowlab.tracking.trackers.rigid_bodies.motion_segmentation import MotionGrid, segment_motion
from flowlab.tracking.trackers.rigid_bodies.pose_tracking import RigidBody
from flowlab.tracking.trackers.rigid_bodies.rigid_motion import RigidMotion


def fit_of(scene: Scene, owner: np.ndarray, motions: list[RigidMotion]) -> RigidBodyFit:
    """A fit whose cells belong to the bodies that ``owner`` says, 0 for none."""
    grid = segment_motion(scene.pictures)
    frames = len(scene.pictures)
    bodies = tuple(
        RigidBody(grid.pixels(owner == k + 1), motion, np.ones(frames, bool), owner == k + 1)
        for k, motion in enumerate(motions)
    )
    cost = np.ones((len(motions) + 1, *owner.shape), np.float32)
    for k in range(len(cost)):
        cost[k][owner == k] = 0
    return RigidBodyFit(CellCosts(scene.pictures, grid), bodies, BodyAssignment(cost, cost))


def halves(scene: Scene) -> np.ndarray:
    """The cells of the first plate as two bodies, left and right; the second plate's as a third."""
    owner = scene.owner_of_cell.copy()
    owner[owner == 2] = 3
    column = np.broadcast_to(np.arange(owner.shape[1]), owner.shape)
    middle = np.median(column[owner == 1])
    owner[(owner == 1) & (column > middle)] = 2
    return owner


def test_touching_halves_are_neighbors_and_separate_plates_are_not() -> None:
    plates = two_plates()
    fit = fit_of(plates, halves(plates), [plates.motion(1), plates.motion(1), plates.motion(2)])
    assert neighbors(fit) == [(1, 2)]


def test_touching_halves_that_move_apart_are_no_neighbors() -> None:
    plates = two_plates()
    apart = RigidMotion(plates.motion(1).R, plates.motion(1).t + np.linspace(0, 0.2, len(plates.pictures))[:, None])
    assert neighbors(fit_of(plates, halves(plates), [plates.motion(1), apart, plates.motion(2)])) == []


def test_halves_of_a_plate_are_made_one() -> None:
    plates = two_plates()
    fit = fit_of(plates, halves(plates), [plates.motion(1), plates.motion(1), plates.motion(2)])
    merged = merge(fit, np.random.default_rng(0))
    assert merged is not None
    assert len(merged.bodies) == 2
    points = plates.points(plates.some_pixels(1, 50))
    truth = plates.motion(1).apply(points)
    off = [np.linalg.norm(b.motion.apply(points) - truth, axis=-1).max() for b in merged.bodies]
    assert min(off) < 0.006
    best = merged.assignment.best_motion
    shown = best[plates.owner_of_cell == 1]
    assert (shown == np.bincount(shown[shown >= 0]).argmax()).mean() > 0.9


def test_bodies_that_do_not_touch_are_left_as_they_are() -> None:
    plates = two_plates()
    assert (
        merge(fit_of(plates, plates.owner_of_cell, [plates.motion(1), plates.motion(2)]), np.random.default_rng(0))
        is None
    )


def test_neighbors_that_one_motion_does_not_explain_stay_two() -> None:
    """They begin side by side, and one goes 5 cm farther: little enough to be tried as one."""
    frames = 16
    seen = scene([
        moving_planes.wall(1.2, frames),
        moving_planes.moving((0.2, 0.2), (-0.1, 0, 0.8), np.array([0.008, 0, 0]), np.zeros(3), frames, 1),
        moving_planes.moving((0.2, 0.2), (0.1, 0, 0.8), np.array([0.0113, 0, 0]), np.zeros(3), frames, 2),
    ])  # fmt: skip
    fit = fit_of(seen, seen.owner_of_cell, [seen.motion(1), seen.motion(2)])
    assert neighbors(fit) == [(1, 2)]
    assert merge(fit, np.random.default_rng(0)) is None


def test_a_small_region_is_all_of_its_pixels_and_a_large_one_keeps_off_edges() -> None:
    plates = two_plates()
    grid = segment_motion(plates.pictures)
    plate = plates.owner_of_cell == 1
    pixels = region_pixels(plates.pictures, grid, plate)
    assert not grid.edge[pixels[:, 1] // 2, pixels[:, 0] // 2].any()
    small = np.zeros_like(plate)
    v, u = plates.some_pixels(1, 1, border=10)[0][::-1] // 2
    small[v : v + 3, u : u + 3] = True
    found = region_pixels(plates.pictures, grid, small)
    assert len(found) == 36
    assert len(np.unique(found, axis=0)) == 36
    body = new_body(plates.pictures, grid, small)
    assert not body.guessed.any()
    np.testing.assert_array_equal(body.pixels, found)


def test_a_body_that_won_cells_of_what_stands_still_keeps_its_motion() -> None:
    plates = two_plates()
    wrong = np.where(plates.owner_of_cell == 0, 1, 0)
    fit = fit_of(plates, wrong, [plates.motion(1)])
    fit = replace(fit, bodies=(replace(fit.bodies[0], region=plates.owner_of_cell == 1),))
    bodies = refit(fit, np.random.default_rng(0))
    assert len(bodies) == 2  # as it is tracked by them, and as it was
    points = plates.points(plates.some_pixels(1, 50))
    truth = plates.motion(1).apply(points)
    needed = RigidBodyFit.with_needed(fit.cells, bodies)
    off = [np.linalg.norm(m.apply(points) - truth, axis=-1).max() for m in needed.motions]
    assert min(off) < 1e-9
    fitted = replace(fit, cells=CellCosts(replace(plates.pictures, still_is_fitted=True), fit.grid))
    assert len(refit(fitted, np.random.default_rng(0))) == 1


def test_the_whole_fit_finds_the_plates_and_which_cells_are_theirs() -> None:
    plates = two_plates(0.002)
    fit = fit_bodies(plates.pictures, seed=0)
    assert len(fit.motions) == len(fit.bodies) + 1
    best = fit.assignment.best_motion
    for k in (1, 2):
        inner = plates.some_pixels(k, 80)
        cells = best[inner[:, 1] // 2, inner[:, 0] // 2]
        mine = int(np.bincount(cells).argmax())
        assert mine > 0
        assert (cells == mine).mean() > 0.9, k
        points = plates.points(inner)
        off = np.linalg.norm(fit.motions[mine].apply(points) - plates.motion(k).apply(points), axis=-1)
        assert np.median(off, 1).max() < 0.006, k
    assert isinstance(fit.grid, MotionGrid)
