"""The motion of a camera whose poses nobody knows, against scenes in which it is known."""

import numpy as np
from rigid_body_scenes import still_camera_moves, two_plates

from flowlab.tracking.trackers.rigid_bodies.camera_motion import with_camera_motion
from flowlab.tracking.trackers.rigid_bodies.motion_segmentation import segment_motion


def test_a_camera_that_moves_is_told_from_what_stands_still() -> None:
    scene = still_camera_moves()
    pictures, grid = with_camera_motion(scene.pictures, segment_motion(scene.pictures), np.random.default_rng(0))
    uv = scene.some_pixels(0, 100)
    found, true = (m.apply(scene.points(uv)) for m in (pictures.stillness, scene.motion(0)))
    assert np.linalg.norm(true[-1] - true[0], axis=-1).max() > 0.1
    np.testing.assert_allclose(found, true, atol=0.003)
    assert grid.static.sum() > 0.5 * grid.valid.sum()


def test_a_camera_that_stands_still_is_left_alone() -> None:
    scene = two_plates()
    grid = segment_motion(scene.pictures)
    assert with_camera_motion(scene.pictures, grid, np.random.default_rng(0)) == (scene.pictures, grid)
