"""The simulation against MetaWorld itself: same episode for the same seed, always; fresh poses; undisturbed physics."""

import copy
import functools
import hashlib
import json
import subprocess
import sys
import warnings
from typing import Any

import metaworld
import mujoco
import numpy as np
import pytest
from metaworld import policies

from flowlab.errors import FlowlabError
from flowlab.sim.expert import Expert
from flowlab.sim.recorder import ExpertSettings, Rollout, TaskSimulator
from flowlab.sim.scene import Poses
from flowlab.sim.scene_settings import CameraSettings, SceneSettings
from flowlab.sim.simulation import Simulation
from flowlab.sim.tasks import TASKS

LEAKY = ["box-close", "dial-turn", "drawer-open", "faucet-open"]
"""Tasks where MetaWorld's own double reset lets the first layout leak into the episode."""


def digest(simulation: Simulation, seed: int, steps: int = 40) -> str:
    """Hash of every joint position and action of an expert's first steps."""
    simulation.reset(seed)
    expert, found = Expert(simulation), hashlib.sha256(simulation.rand_vec.tobytes())
    for _ in range(steps):
        found.update(simulation.data.qpos.tobytes())
        action = expert.act()
        found.update(action.tobytes())
        simulation.step(action)
    return found.hexdigest()


def digests_of_another_process(tasks: list[str]) -> dict[str, str]:
    result = subprocess.run([sys.executable, __file__, *tasks], capture_output=True, text=True, check=True)
    return dict(json.loads(result.stdout))


def metaworld_env(task: str) -> Any:
    """MetaWorld's environment with the goal in view, and nothing of flowlab."""
    env = metaworld.ALL_V3_ENVIRONMENTS[f"{task}-v3"]()
    env._partially_observable = False
    del env.sawyer_observation_space
    env._set_task_called = True
    return env


def lay_out(env: Any, rand_vec: np.ndarray) -> np.ndarray:
    """Reset to a given layout; the first observation."""
    env._last_rand_vec, env._freeze_rand_vec = np.array(rand_vec), True
    return np.asarray(env.reset()[0])


def forwarded(model: mujoco.MjModel, data: mujoco.MjData) -> mujoco.MjData:
    """A copy of the data after mj_forward: the poses as they should be."""
    fresh = copy.copy(data)
    mujoco.mj_forward(model, fresh)
    return fresh


def staleness(model: mujoco.MjModel, data: mujoco.MjData) -> float:
    """How far any geom, site, body or camera is from where mj_forward puts it [m]."""
    fresh = forwarded(model, data)
    return max(float(np.abs(getattr(fresh, n) - getattr(data, n)).max()) for n in POSITIONS)


POSITIONS = ("geom_xpos", "site_xpos", "xpos", "cam_xpos", "geom_xmat", "site_xmat", "xmat", "cam_xmat")


@functools.cache
def rollout(task: str, **settings: Any) -> Rollout:
    return TaskSimulator(task, SceneSettings()).record_expert(0, ExpertSettings(**settings))


def assert_an_episode_is_a_function_of_task_and_seed(tasks: list[str]) -> None:
    elsewhere = digests_of_another_process(tasks)
    for task in tasks:
        simulation = Simulation(task, SceneSettings())
        fresh = digest(simulation, 3)
        other = [digest(simulation, seed, steps=15) for seed in (4, 11)]
        assert digest(simulation, 3) == fresh, f"{task}: the past of the environment leaks in"
        assert elsewhere[task] == fresh, f"{task}: another process makes another episode"
        assert len({fresh, *other}) == 3


def test_an_episode_is_a_function_of_task_and_seed_bit_for_bit() -> None:
    assert_an_episode_is_a_function_of_task_and_seed(["box-close", "drawer-open", "hammer", "stick-pull"])


@pytest.mark.slow
def test_an_episode_of_any_task_is_a_function_of_task_and_seed() -> None:
    assert_an_episode_is_a_function_of_task_and_seed(list(TASKS))


@pytest.mark.parametrize("task", ["window-open", "drawer-open", "peg-insert-side", "reach"])
def test_the_first_frame_shows_the_layout_of_its_own_seed(task: str) -> None:
    simulation = Simulation(task, SceneSettings())
    for seed in (0, 7):
        simulation.reset(seed)
        assert staleness(simulation.model, simulation.data) == 0.0


@pytest.mark.parametrize("task", ["window-open", "peg-insert-side", "reach"])
def test_metaworlds_own_first_frame_is_stale(task: str) -> None:
    """The control: left alone, MetaWorld shows the layout before, so the test above has power."""
    env = metaworld_env(task)
    env._freeze_rand_vec, env.seeded_rand_vec = False, True
    env.seed(0)
    env.reset()
    assert staleness(env.model, env.data) > 0.01


@pytest.mark.parametrize("task", ["window-open", "drawer-open"])
def test_even_the_frozen_layout_is_stale_without_the_refresh(task: str) -> None:
    """The same control with flowlab's own recipe: the layout's random vector frozen, two resets."""
    simulation = Simulation(task, SceneSettings())
    simulation.reset(0)
    env = metaworld_env(task)
    lay_out(env, simulation.rand_vec)
    assert staleness(env.model, env.data) > 1e-4


@pytest.mark.parametrize("task", ["window-open", "box-close", "reach"])
def test_refreshing_the_poses_does_not_disturb_the_trajectory(task: str) -> None:
    simulation = Simulation(task, SceneSettings())
    simulation.reset(2)
    env, expert = metaworld_env(task), Expert(simulation)
    observation = lay_out(env, simulation.rand_vec)
    policy = getattr(policies, TASKS[task].expert)()
    for _ in range(50):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            action = np.clip(policy.get_action(observation), -1, 1).astype(np.float32)
        observation, _, _, _, info = env.step(action)
        assert simulation.step(expert.act()) == bool(info["success"])
    np.testing.assert_array_equal(simulation.data.qpos, env.data.qpos)
    np.testing.assert_array_equal(simulation.data.qvel, env.data.qvel)


@pytest.mark.parametrize("task", ["hammer", "drawer-open"])
def test_recorded_actions_are_the_executed_ones(task: str) -> None:
    recorded = rollout(task)
    assert np.abs(recorded.action).max() <= 1
    env = metaworld_env(task)
    lay_out(env, recorded.extras["rand_vec"])
    for t, action in enumerate(recorded.action):
        body_pos = forwarded(env.model, env.data).xpos if t == 0 else env.data.xpos
        np.testing.assert_array_equal(recorded.poses.body_pos[t], body_pos)
        assert env.step(action)[4]["success"] == recorded.success[t]


def test_the_expert_wants_more_than_it_may_so_clipping_matters() -> None:
    simulation = Simulation("hammer", SceneSettings())
    simulation.reset(0)
    policy = getattr(policies, TASKS["hammer"].expert)()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        wanted = policy.get_action(simulation.observation)
    assert np.abs(wanted).max() > 1
    np.testing.assert_array_equal(Expert(simulation).act(), np.clip(wanted, -1, 1).astype(np.float32))


def test_recording_leaves_no_warnings_to_the_user() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        TaskSimulator("hammer", SceneSettings()).record_expert(0, ExpertSettings(max_steps=5))


@pytest.mark.parametrize("hold", [1, 7])
def test_stop_at_success_records_exactly_the_held_steps(hold: int) -> None:
    recorded = rollout("drawer-open", stop="success", hold=hold)
    assert recorded.success.sum() == hold
    assert recorded.success[-1]
    assert len(recorded) < 200


def test_full_records_every_step_and_begins_like_the_short_one() -> None:
    full, short = rollout("drawer-open", stop="full", max_steps=130), rollout("drawer-open", hold=1)
    assert len(full) == len(full.state) == len(full.poses.body_pos) == 130
    assert full.success.sum() > 1
    np.testing.assert_array_equal(full.action[: len(short)], short.action)


def test_an_expert_that_does_not_get_there_is_cut_off() -> None:
    recorded = rollout("hammer", max_steps=12)
    assert len(recorded) == 12
    assert not recorded.success.any()


def test_state_is_hand_and_fingers_as_mujoco_has_them() -> None:
    recorded = rollout("hammer")
    m, poses = recorded.scene.model, recorded.poses
    parts = [poses.body_pos[:, m.body("hand").id]]
    parts += [poses.site_pos[:, m.site(name).id] for name in ("rightEndEffector", "leftEndEffector")]
    np.testing.assert_array_equal(recorded.state, np.concatenate(parts, 1).astype(np.float32))


@pytest.mark.parametrize(("task", "geoms_on"), [("hammer", "hammer"), ("coffee-push", "mug"), ("stick-pull", "stick")])
def test_the_manipulated_body_is_the_one_meant_by_name(task: str, geoms_on: str) -> None:
    simulation = Simulation(task, SceneSettings())
    m = simulation.model
    assert m.body_weldid[m.body(geoms_on).id] == simulation.object_body
    assert len({m.body_weldid[b] for b in simulation.scene.movable}) > 1, "several bodies can move here"


@pytest.mark.parametrize("task", ["hammer", "coffee-push", "drawer-open"])
def test_solving_the_task_moves_the_manipulated_body(task: str) -> None:
    recorded = rollout(task)
    assert recorded.object_pose is not None
    assert np.linalg.norm(recorded.object_pose[-1, :3] - recorded.object_pose[0, :3]) > 0.05


@pytest.mark.slow
@pytest.mark.parametrize("task", sorted(TASKS))
def test_every_task_has_its_manipulated_body_and_the_same_camera(task: str) -> None:
    simulation = Simulation(task, SceneSettings())
    simulation.reset(0)
    m, d = simulation.model, simulation.data
    assert m.body_weldid[simulation.object_body] == simulation.object_body
    assert m.body_dofnum[simulation.object_body] > 0
    rooted = simulation.object_body
    while m.body_parentid[rooted] != 0:
        rooted = int(m.body_parentid[rooted])
    assert m.body(rooted).name != "base", "the manipulated body is part of the robot"
    camera = simulation.camera()
    np.testing.assert_allclose(camera.T_world_cam[:3, 3], [0.6, 0.295, 0.8], atol=1e-12)
    np.testing.assert_allclose(camera.T_world_cam[:3, :3] * [1, -1, -1], CORNER2, atol=1e-6)
    np.testing.assert_allclose(camera.K, [[F, 0, 63.5], [0, F, 63.5], [0, 0, 1]])
    assert staleness(m, d) == 0.0


CORNER2 = [[-0.549901, 0.376208, 0.745705], [-0.833183, -0.309549, -0.458242], [0.058438, -0.873297, 0.483671]]
"""Axes of the camera as columns, in OpenGL's convention, measured from MetaWorld's model."""
F = 64 / np.tan(np.pi / 6)


@pytest.mark.parametrize("name", ["gripperPOV", "behindGripper"])
def test_a_camera_that_moves_is_refused(name: str) -> None:
    """An episode has one camera pose, so a camera on the hand would make every label wrong without a word."""
    with pytest.raises(FlowlabError, match=name):
        TaskSimulator("reach", SceneSettings(camera=CameraSettings(name=name, position=None)))


def test_poses_are_copies() -> None:
    simulation = Simulation("reach", SceneSettings())
    simulation.reset(0)
    before = simulation.poses()
    remembered = Poses.stack([before]).at(0)
    for _ in range(5):
        simulation.step(np.ones(4, np.float32))
    np.testing.assert_array_equal(before.body_pos, remembered.body_pos)
    assert np.abs(simulation.poses().body_pos - before.body_pos).max() > 0.01


if __name__ == "__main__":
    print(json.dumps({task: digest(Simulation(task, SceneSettings()), 3) for task in sys.argv[1:]}))


@pytest.mark.parametrize("task", ["pick-place", "push"])
def test_what_the_fingers_hold_is_what_metaworld_says(task: str) -> None:
    simulation = Simulation(task, SceneSettings())
    simulation.reset(3)
    env, expert = simulation._env, Expert(simulation)
    geom = int(env._get_id_main_object())
    said = []
    for _ in range(70):
        simulation.step(expert.act())
        said.append(type(env).touching_object(env, geom))
        assert env.touching_object(geom) == said[-1]
    assert set(said) == {True, False}, "the episode shows both"
