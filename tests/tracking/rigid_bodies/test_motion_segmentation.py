"""What of the first frame stays and what moved, against scenes in which that is known."""

import numpy as np
from rigid_body_scenes import still_camera_moves, two_plates

from flowlab.tracking.trackers.rigid_bodies.motion_segmentation import STEP, MotionGrid, segment_motion


def grid_of(depth: np.ndarray) -> MotionGrid:
    """A grid of cells of these depths, of which nothing else is known."""
    v, u = (STEP * x.astype(np.int32) for x in np.indices(depth.shape))
    nothing = np.zeros(depth.shape, bool)
    return MotionGrid(v, u, depth.astype(np.float32), depth > 0, nothing, nothing, nothing, nothing, nothing)


def test_plates_moved_and_the_wall_stayed() -> None:
    scene = two_plates()
    grid = segment_motion(scene.pictures)
    owner = scene.owner_of_cell
    slid = np.zeros(owner.shape, bool)
    slid[scene.pixels(1)[:, 1] // STEP, scene.pixels(1)[:, 0] // STEP] = True
    wall = np.zeros(owner.shape, bool)
    wall[scene.pixels(0, border=10)[:, 1] // STEP, scene.pixels(0, border=10)[:, 0] // STEP] = True
    assert grid.valid.all()
    assert (owner[grid.moved] > 0).mean() > 0.98, "free space behind tells what moved"
    assert grid.moved[slid].mean() > 0.3, "it slid by more than half of its width"
    assert grid.static[slid].mean() < 0.02
    assert grid.static[wall].mean() > 0.8
    assert not (grid.moved & grid.static).any()
    assert (grid.undecided | grid.static).all()


def test_edges_of_depth_are_told() -> None:
    scene = two_plates()
    grid = segment_motion(scene.pictures)
    border = np.zeros(scene.owner.shape, bool)
    for axis in (0, 1):
        border |= np.roll(scene.owner, 1, axis) != scene.owner
        border |= np.roll(scene.owner, -1, axis) != scene.owner
    border[0], border[-1], border[:, 0], border[:, -1] = False, False, False, False
    assert grid.edge[border[::STEP, ::STEP]].mean() > 0.95
    assert grid.edge[~border[::STEP, ::STEP]].mean() < 0.05


def test_nothing_is_static_where_the_camera_moves() -> None:
    grid = segment_motion(still_camera_moves().pictures)
    assert not grid.static.any()
    assert (grid.undecided == grid.valid).all()


def test_what_only_was_hidden_did_not_move() -> None:
    """A plate passes before the other: that the wall is out of sight for a while says nothing of it."""
    scene = two_plates()
    grid = segment_motion(scene.pictures)
    later = scene.pictures.depth[:, ::STEP, ::STEP]
    hidden = (later < 0.9 * grid.depth).any(0) & (scene.owner_of_cell == 0)
    assert hidden.sum() > 50
    assert not grid.moved[hidden].any()


def test_components_are_divided_by_jumps_of_depth_the_largest_first() -> None:
    depth = np.ones((8, 12))
    depth[:, 6:] = 1.2
    mask = np.zeros((8, 12), bool)
    mask[1:4, 1:11] = mask[6, 2:4] = True
    parts = grid_of(depth).components(mask)
    expected = [
        mask & (depth == 1) & (np.arange(8) < 5)[:, None],
        mask & (depth > 1),
        mask & (np.arange(8) == 6)[:, None],
    ]
    assert sorted(p.sum() for p in parts) == [2, 15, 15]
    assert parts[-1].sum() == 2
    for part in expected:
        assert any((part == p).all() for p in parts)
    assert grid_of(depth).components(np.zeros((8, 12), bool)) == []


def test_cells_are_pixels() -> None:
    grid = grid_of(np.ones((4, 5)))
    mask = np.zeros((4, 5), bool)
    mask[2, 3] = mask[0, 1] = True
    np.testing.assert_array_equal(grid.pixels(mask), [[STEP, 0], [3 * STEP, 2 * STEP]])
