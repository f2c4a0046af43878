"""Which body a pixel belongs to, against scenes in which that is known."""

from dataclasses import replace

import moving_planes
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from rigid_body_scenes import scene, two_plates

from flowlab.tracking.trackers.rigid_bodies.assignment import (
    BodyAssignment,
    CellCosts,
    assign,
    motion_costs,
    select_needed,
)
from flowlab.tracking.trackers.rigid_bodies.motion_segmentation import segment_motion


def test_cells_belong_to_the_plate_they_show() -> None:
    scene = two_plates()
    grid = segment_motion(scene.pictures)
    assignment = assign(CellCosts(scene.pictures, grid), [scene.motion(1), scene.motion(2)])
    assert assignment.raw.shape == assignment.cost.shape == (3, *grid.valid.shape)
    best, owner = assignment.best_motion, scene.owner_of_cell
    assert (best[grid.valid] == owner[grid.valid]).mean() > 0.95
    decided = grid.valid & ~grid.undecided
    assert (best[decided] == 0).all()
    assert (assignment.raw[0][decided] == 0).all()


def test_cells_without_depth_belong_to_nobody() -> None:
    scene = two_plates()
    grid = segment_motion(scene.pictures)
    holes = grid.valid.copy()
    holes[5:9, 5:9] = False
    grid = type(grid)(grid.v, grid.u, np.where(holes, grid.depth, 0), holes, grid.edge, grid.moved & holes,
                      grid.static & holes, grid.undecided & holes, grid.changed & holes)  # fmt: skip
    assignment = assign(CellCosts(scene.pictures, grid), [scene.motion(1)])
    np.testing.assert_array_equal(assignment.best_motion == -1, ~holes)


def test_what_a_motion_costs_cells_is_computed_once_whatever_comes_beside_it() -> None:
    scene = two_plates()
    grid, (one, other) = segment_motion(scene.pictures), (scene.motion(k) for k in (1, 2))
    cells, uv = CellCosts(scene.pictures, grid), grid.pixels(grid.undecided)
    first = cells.of([one])
    both = cells.of([other, one])
    expected = motion_costs(scene.pictures, grid, [other, one], uv, scene.points(uv))
    np.testing.assert_allclose(both, expected, atol=1e-6)
    np.testing.assert_array_equal(both[1], first[0])


def test_stillness_is_preferred_where_motions_explain_alike() -> None:
    scene = two_plates()
    uv = scene.some_pixels(1, 50)
    motions, grid = [scene.motion(1)], segment_motion(scene.pictures)
    free, priced = (motion_costs(scene.pictures, grid, motions, uv, scene.points(uv), p) for p in (0.0, 0.5))
    path = scene.motion(1).apply(scene.points(uv))
    away = (np.linalg.norm(path[1:] - path[0], axis=-1) > 0.01).mean(0)
    np.testing.assert_allclose(priced - free, 0.5 * away[None], atol=0.04)


def test_free_space_in_a_few_frames_refutes_stillness() -> None:
    """Whatever the mean says: here things rest until the last five frames."""
    frames, late = 24, np.maximum(np.arange(24) - 18, 0)[:, None]
    plate = moving_planes.moving((0.2, 0.2), (0, 0, 0.8), np.zeros(3), np.zeros(3), frames, 1)
    film = scene([moving_planes.wall(1.2, frames), replace(plate, t=plate.t + late * [0.03, 0, 0])])
    uv, grid = film.some_pixels(1, 60), segment_motion(film.pictures)
    still, moved = motion_costs(film.pictures, grid, [film.pictures.stillness, film.motion(1)], uv, film.points(uv))
    gone = uv[:, 0] < uv[:, 0].min() + 4
    assert gone.sum() >= 3
    assert (still - moved)[gone].min() > 0.3


def volume(*costs: float) -> BodyAssignment:
    """A cell for each row of costs of all motions."""
    cost = np.array(costs, np.float32).T[:, None]
    return BodyAssignment(cost, cost)


def test_a_motion_that_another_could_stand_in_for_is_not_needed() -> None:
    #                      still, a,   a again, b
    assignment = volume((0.9, 0.1, 0.12, 0.9), (0.9, 0.15, 0.1, 0.9), (0.9, 0.9, 0.9, 0.1), (0.1, 0.9, 0.9, 0.9))
    kept = select_needed(assignment)
    assert kept in ([0, 1, 3], [0, 2, 3])
    np.testing.assert_array_equal(assignment.select(kept).cost, assignment.cost[kept])


def test_a_motion_of_no_cell_is_not_needed() -> None:
    assert select_needed(volume((0.9, 0.1, 0.5), (0.1, 0.9, 0.5), (0.8, 0.2, 0.6))) == [0, 1]


def test_of_two_motions_of_many_cells_the_right_one_is_needed_though_each_costs_little_more_without_it() -> None:
    #                 still, right, wrong, which is another small thing's own
    rows = [(0.9, 0.30, 0.345)] * 600 + [(0.9, 0.6, 0.4)] * 30
    assert select_needed(volume(*rows)) == [0, 1, 2]
    assert select_needed(volume(*rows), many_tell_more=False) == [0, 2]
    assert select_needed(volume(*rows[:20], *rows[-30:])) == [0, 2]  # of few cells, so little says nothing


@settings(deadline=None)
@given(hnp.arrays(np.float32, st.tuples(st.integers(1, 6), st.just(3), st.just(4)), elements=st.floats(0, 1, width=32)))
def test_what_is_kept_is_stillness_and_what_gains_by_more_than_it_must(cost: np.ndarray) -> None:
    kept = select_needed(BodyAssignment(cost, cost))
    assert kept[0] == 0
    assert kept == sorted(set(kept))
    assert len(kept) >= min(2, len(cost))
    if len(kept) > 2:
        left = cost[kept]
        best, second = np.partition(left.reshape(len(kept), -1), 1, axis=0)[:2]
        owner = left.reshape(len(kept), -1).argmin(0)
        for k in range(1, len(kept)):
            assert (second - best)[owner == k].astype(float).mean() > 0.1  # of up to a hundred cells
