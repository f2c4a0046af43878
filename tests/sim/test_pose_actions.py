"""Actions of eight numbers against MuJoCo's own poses: what they say, what they do, and what is refused."""

import mujoco
import numpy as np
import pytest

from flowlab.errors import DataError
from flowlab.sim.expert import Expert
from flowlab.sim.pose_actions import PoseActions, PoseArm
from flowlab.sim.scene_settings import SceneSettings
from flowlab.sim.simulation import Simulation
from flowlab.sim.tasks import TASKS

STEPS = 96
GRIP = (0.0, 0.6)
UNTURNED = (0.0, 0.5**0.5, 0.0, 0.5**0.5)


@pytest.fixture(scope="module")
def assembly() -> Simulation:
    return Simulation("assembly", SceneSettings())


def an_arm(simulation: Simulation, position: str = "absolute", every: int = 3) -> PoseArm:
    simulation.reset(0)
    return PoseArm(simulation, PoseActions(position=position, every=every, efforts=GRIP))


def expert_steps(arm: PoseArm) -> list[np.ndarray]:
    """MetaWorld's own actions, the gripper open or closed."""
    expert, found = Expert(arm.simulation), []
    for _ in range(STEPS):
        found.append(arm.binary(expert.act()))
        arm.simulation.step(found[-1])
    return found


def object_pose(simulation: Simulation) -> np.ndarray:
    return np.concatenate([simulation.data.body("RoundNut").xpos, simulation.data.body("RoundNut").xmat])


@pytest.mark.parametrize(
    ("position", "every", "off_m"),
    [("absolute", 1, 1e-5), ("relative", 1, 1e-4), ("absolute", 3, 0.01), ("relative", 3, 0.01)],
)
def test_a_demonstration_carried_out_by_poses_ends_as_with_metaworlds_own_actions(
    assembly: Simulation, position: str, every: int, off_m: float
) -> None:
    arm = an_arm(assembly, position, every)
    steps = expert_steps(arm)
    ends, success = object_pose(assembly), assembly.step(steps[-1])
    assert success
    assembly.reset(0)
    actions = []
    for t in range(0, STEPS, every):
        start = arm.target
        for step in steps[t : t + every]:
            assembly.step(step)
        actions.append(arm.action(start, float(steps[t + every - 1][3])))
    assert np.array_equal(object_pose(assembly), ends)
    assembly.reset(0)
    for action in actions:
        for step in arm.steps(action):
            assembly.step(step)
    assert np.abs(object_pose(assembly) - ends)[:3].max() < off_m
    assert assembly.step(steps[-1])


def test_the_state_is_mujocos_pose_of_the_hand(assembly: Simulation) -> None:
    arm, data = an_arm(assembly), assembly.data
    for step in expert_steps(arm)[:5]:
        assembly.step(step)
    x, y, z, w = arm.state[3:7].astype(float)
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, np.array([w, x, y, z]))
    assert np.allclose(matrix, data.body("hand").xmat, atol=1e-5)
    assert np.allclose(arm.state[:3], data.body("hand").xpos)
    fingers = data.site("rightEndEffector").xpos, data.site("leftEndEffector").xpos
    assert np.isclose(arm.state[7], np.linalg.norm(np.subtract(*fingers)))
    assert w >= 0


def test_a_turn_has_one_quaternion(assembly: Simulation) -> None:
    arm = an_arm(assembly)
    state, turn = arm.state, assembly.data.body("hand").xquat
    turn *= -1
    assert np.array_equal(arm.state, state)
    turn *= -1


def test_an_action_sends_the_hand_where_it_says_at_a_centimeter_a_step(assembly: Simulation) -> None:
    arm = an_arm(assembly)
    start = arm.target
    near, far = start + np.array([0.02, -0.03, 0.01]), start + np.array([0.2, 0, 0])
    for k, step in enumerate(arm.steps(np.array([*near, *UNTURNED, 0])), 1):
        assembly.step(step)
        assert np.allclose(assembly.data.mocap_pos[0], start + (near - start) * k / 3, atol=1e-6)
    assembly.reset(0)
    for step in arm.steps(np.array([*far, *UNTURNED, 0])):
        assembly.step(step)
    assert np.allclose(assembly.data.mocap_pos[0], start + np.array([0.03, 0, 0]), atol=1e-6)


@pytest.mark.parametrize(("gripper", "effort"), [(0.0, 0.0), (0.49, 0.0), (0.5, 0.6), (1.2, 0.6)])
def test_the_gripper_opens_or_closes_with_the_efforts_of_the_settings(
    assembly: Simulation, gripper: float, effort: float
) -> None:
    arm = an_arm(assembly)
    steps = list(arm.steps(np.array([*arm.target, *UNTURNED, gripper])))
    assert [float(s[3]) for s in steps] == pytest.approx([effort] * 3)
    assert arm.closes(effort) == (effort > 0.3)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda a: a[:7], r"action has the shape \(7,\), expected \(8,\): x, y, z \[m\], quaternion x, y, z, w, and"),
        (lambda a: np.where(np.arange(8) == 2, np.nan, a), r"action\[2\] is nan, expected a finite number"),
        (lambda a: np.array([*a[:3], 0, 0, 0, 0, 0]), r"of length 0, expected a quaternion x, y, z, w of length 1"),
        (lambda a: np.array([*a[:3], 0, 2, 0, 2, 0]), r"of length 2\.83, expected a quaternion"),
        (
            lambda a: np.array([*a[:3], 0.5**0.5, 0, 0.5**0.5, 0, 0]),
            r"turned by 180 degrees.*\[0\.0, 0\.707, 0\.0, 0\.707\]",
        ),
    ],
)
def test_what_is_no_action_is_refused_before_the_arm_moves(assembly: Simulation, change, message: str) -> None:
    arm = an_arm(assembly)
    with pytest.raises(DataError, match=message):
        arm.steps(change(np.array([*arm.target, *UNTURNED, 0])))


def test_a_quaternion_of_the_other_sign_is_the_same_turn(assembly: Simulation) -> None:
    arm = an_arm(assembly)
    assert len(list(arm.steps(np.array([*arm.target, *(-q for q in UNTURNED), 0])))) == 3


def test_a_moved_layout_is_moved_by_what_is_said_and_leaves_no_trace(assembly: Simulation) -> None:
    assembly.reset(0)
    before, body = assembly.data.qpos.copy(), assembly.object_body
    place = assembly.data.xpos[body].copy()
    assembly.reset(0, (0.007, -0.004))
    assert np.allclose(assembly.data.xpos[body] - place, [0.007, -0.004, 0], atol=1e-3)
    assembly.reset(0)
    assert np.array_equal(assembly.data.qpos, before)


def test_a_layout_that_metaworld_would_never_take_is_refused(assembly: Simulation) -> None:
    with pytest.raises(DataError, match=r"assembly seed 0: the object, moved by .* is too near to its goal"):
        assembly.reset(0, (-0.1, 0.2))
    assembly.reset(0)


@pytest.mark.slow
@pytest.mark.parametrize("task", TASKS)
def test_in_every_task_the_object_moves_or_it_is_said_that_it_cannot(task: str) -> None:
    simulation = Simulation(task, SceneSettings())
    simulation.reset(0)
    place = simulation.data.xpos[simulation.object_body].copy()
    if task.startswith("plate-slide"):
        with pytest.raises(DataError, match="MetaWorld has its object in one place always"):
            simulation.reset(0, (0.004, -0.007))
        return
    simulation.reset(0, (0.004, -0.007))
    assert np.allclose((simulation.data.xpos[simulation.object_body] - place)[:2], [0.004, -0.007], atol=2e-3)
