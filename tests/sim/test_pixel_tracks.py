"""True tracks and visibility in a small world whose every distance is known."""

import mujoco
import numpy as np
import pytest

from flowlab.geometry.camera import Camera
from flowlab.geometry.transforms import rigid
from flowlab.records import Role
from flowlab.sim.pixel_tracks import surface_tracks, visible_by_rays
from flowlab.sim.recorder import Rollout
from flowlab.sim.render.zbuffer import ZBuffer
from flowlab.sim.scene import Poses, Scene

WORLD = """
<mujoco><worldbody>
  <geom name="wall" type="box" size="2 2 .1" pos="0 0 -.1"/>
  <body name="slab" pos="-1 0 .5"><joint name="along" type="slide" axis="1 0 0"/>
    <geom name="slab" type="box" size=".3 .3 .05"/></body>
  <body name="dice" pos=".8 .4 .2"><joint name="turn" type="hinge" axis="0 1 0"/>
    <geom name="dice" type="box" size=".1 .1 .1"/></body>
  <geom name="glass" type="box" size="2 2 .01" pos="0 0 1" rgba="1 1 1 0"/>
  <geom name="collision" type="box" size="2 2 .01" pos="0 0 1.2" group="4"/>
</worldbody></mujoco>"""
"""A wall at z = 0; a slab 0.55 m before it, which slides along x; a die that turns; and two unseen panes."""
LOOKING_DOWN = np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 3], [0, 0, 0, 1]])
CAMERA = Camera(101, 81, np.array([[100.0, 0, 50], [0, 100, 40], [0, 0, 1]]), LOOKING_DOWN)
STEPS = 21


def make_rollout(T_world_sim: np.ndarray = np.eye(4)) -> Rollout:
    """The slab slides from x = -1 to 1, the die turns once around; 0.1 m and 18 degrees a step."""
    model = mujoco.MjModel.from_xml_string(WORLD)
    data, instants = mujoco.MjData(model), []
    for t in range(STEPS):
        data.joint("along").qpos[:], data.joint("turn").qpos[:] = 0.1 * t, np.deg2rad(18 * t)
        mujoco.mj_kinematics(model, data)
        instants.append(Poses.of(data))
    scene = Scene(model)
    camera = Camera(CAMERA.width, CAMERA.height, CAMERA.K, T_world_sim @ LOOKING_DOWN)
    nothing = np.zeros((STEPS, 0), np.float32)
    return Rollout(
        task="slide", seed=0, camera=camera, time_s=np.arange(STEPS) / 10, state=nothing, action=nothing,
        success=np.zeros(STEPS, bool), poses=Poses.stack(instants), scene=scene,
        renderer=ZBuffer(scene, CAMERA, instants[0]), T_world_sim=T_world_sim,
    )  # fmt: skip


def pixel_of(x: float, y: float, z: float) -> tuple[int, int]:
    """Where the camera sees a point of the world; chosen so that these are whole numbers."""
    u, v = 50 + 100 * x / (3 - z), 40 - 100 * y / (3 - z)
    assert abs(u - round(u)) < 1e-9
    assert abs(v - round(v)) < 1e-9
    return round(u), round(v)


OTHER_WORLD = rigid(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([1.0, 2, 3]))
"""Where the dataset's world is not MuJoCo's, camera coordinates and visibility stay the same."""


@pytest.mark.parametrize("T_world_sim", [np.eye(4), OTHER_WORLD], ids=["same world", "other world"])
def test_points_go_with_what_they_lie_on(T_world_sim: np.ndarray) -> None:
    rollout = make_rollout(T_world_sim)
    pixels = np.array([pixel_of(-0.98, 0.0, 0.55), pixel_of(0.3, 0.3, 0.0), pixel_of(0.81, 0.405, 0.3)])
    tracks, visible, role = surface_tracks(rollout, rollout.frame(0), pixels)
    assert role.tolist() == [Role.OBJECT, Role.BACKGROUND, Role.OBJECT]
    t = np.arange(STEPS)
    slab = np.stack([-0.98 + 0.1 * t, 0 * t, np.full(STEPS, 2.45)], -1)
    wall = np.tile([0.3, -0.3, 3.0], (STEPS, 1))
    angle = np.deg2rad(18 * t)
    x = 0.8 + 0.01 * np.cos(angle) + 0.1 * np.sin(angle)
    z = 0.2 - 0.01 * np.sin(angle) + 0.1 * np.cos(angle)
    die = np.stack([x, np.full(STEPS, -0.405), 3 - z], -1)
    np.testing.assert_allclose(tracks, np.stack([slab, wall, die], 1), atol=2e-6)
    assert visible[:, 0].all(), "unseen panes hide nothing"


@pytest.mark.parametrize("T_world_sim", [np.eye(4), OTHER_WORLD], ids=["same world", "other world"])
def test_out_of_sight_behind_things_and_behind_itself(T_world_sim: np.ndarray) -> None:
    rollout = make_rollout(T_world_sim)
    pixels = np.array([pixel_of(0.3, 0.3, 0.0), pixel_of(0.81, 0.405, 0.3)])
    _, visible, _ = surface_tracks(rollout, rollout.frame(0), pixels)
    # The ray to (0.3, 0.3, 0) meets the slab's top or bottom where its x is between 0.245 and 0.255, and its y is
    # within 0.3; so it is hidden while the slab's center is within 0.3 of that: from t = 10 to 15.
    assert np.flatnonzero(~visible[:, 0]).tolist() == list(range(10, 16))
    # The top of the die turns away from the camera, which is above and to its left, and comes back.
    hidden = np.flatnonzero(~visible[:, 1])
    assert hidden[0] in (4, 5, 6)
    assert set(range(6, 14)) <= set(hidden.tolist())
    assert visible[0, 1]
    assert visible[-1, 1]


def test_out_of_sight_outside_the_picture() -> None:
    rollout = make_rollout()
    on_the_wall = np.array([[1.4, 0.0], [1.6, 0.0], [0.0, 1.1], [0.0, 1.3], [0.0, -1.1], [0.0, -1.3]])
    xyz = np.tile(np.append(on_the_wall, np.zeros((6, 1)), 1), (STEPS, 1, 1))
    seen = visible_by_rays(rollout, xyz)
    assert seen[0].tolist() == [True, False, True, False, True, False]
    behind_camera = xyz + np.array([0, 0, 4.0])
    assert not visible_by_rays(rollout, behind_camera).any()
