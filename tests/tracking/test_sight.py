"""Why a sensor sees a point or does not, where that is known in closed form."""

from dataclasses import replace

import numpy as np
import pytest

from flowlab.geometry.camera import Camera
from flowlab.records import Clip, Sight, Tracks3D
from flowlab.tracking.sight import sight_of

CAMERA = Camera(40, 30, np.array([[40.0, 0, 19.5], [0, 40, 14.5], [0, 0, 1]]), np.eye(4))
WALL_M, BOARD_M = 1.0, 0.6


def clip() -> Clip:
    """A wall; in the second of two frames a board before its right half, and no reading in its lowest rows."""
    depth = np.full((2, 30, 40), WALL_M, np.float32)
    depth[1, :, 20:] = BOARD_M
    depth[1, 24:] = 0
    return Clip(np.zeros((2, 30, 40, 3), np.uint8), depth, CAMERA)


def tracks(u: float, v: float, z: float, visible: bool) -> Tracks3D:
    """One point, at a pixel and a depth [m]."""
    xyz = np.broadcast_to(CAMERA.unproject(np.array([u, v]), np.array(z)), (2, 1, 3)).astype(np.float32)
    return Tracks3D(xyz, np.full((2, 1), visible), np.zeros(1, np.float32))


@pytest.mark.parametrize(
    ("u", "v", "z", "visible", "says"),
    [
        (5, 5, WALL_M, True, Sight.SEEN),
        (30, 5, WALL_M, False, Sight.COVERED),
        (5, 5, 0.7, False, Sight.SEEN_THROUGH),
        (30, 28, WALL_M, False, Sight.NO_READING),
        (5, 28, WALL_M, True, Sight.NO_READING),
        (45, 5, WALL_M, False, Sight.OUT_OF_VIEW),
        (5, -3, WALL_M, False, Sight.OUT_OF_VIEW),
        (5, 5, -1.0, False, Sight.OUT_OF_VIEW),
    ],
)
def test_it_says_why(u: float, v: float, z: float, visible: bool, says: Sight) -> None:
    assert sight_of(clip(), tracks(u, v, z, visible))[1, 0] == says


def test_the_camera_is_where_its_poses_say() -> None:
    """A camera that turns away leaves the point out of view."""
    away = np.diag([-1.0, 1, -1, 1])
    moving = replace(clip(), T_world_cam=np.stack([np.eye(4), away]))
    assert sight_of(moving, tracks(5, 5, WALL_M, False))[:, 0].tolist() == [Sight.SEEN_THROUGH, Sight.OUT_OF_VIEW]
