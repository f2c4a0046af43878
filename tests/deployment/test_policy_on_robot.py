"""A robot's control loop gets from a policy what rollouts in simulation get, and is told plainly what it did wrong."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from builders import tiny_settings, tiny_spec
from synthetic import CAMERA, make_dataset, make_episode
from trained_runs import SMALL, make_rolls, make_run

import flowlab
from flowlab.data.batches import ObservationBatch
from flowlab.deployment.robot_policy import Policy
from flowlab.errors import DataError, FlowlabError, UsageError
from flowlab.evaluation.rollout import BATCH_SLOTS, PolicyRollout, SimulatorPool, roll_out
from flowlab.evaluation.trials import Trial
from flowlab.geometry.camera import Camera
from flowlab.perception.observer import Observer, ObserverSettings
from flowlab.perception.queries import QuerySettings
from flowlab.policies.base import ActionPlan, PolicyNetwork
from flowlab.policies.checkpoint import load_policy
from flowlab.policies.dp3 import DP3
from flowlab.policies.fdp import FDP
from flowlab.records import Frame
from flowlab.sim.scene_settings import SceneSettings

TRIAL, STEPS = Trial("hammer", 0, 2), 20


class Watched(PolicyNetwork):
    """Remembers what its plans were decided on; ``fixed`` plans do not depend on it, so that rounding plays no part."""

    fixed = False

    def plan(self, context: ObservationBatch, generators: Any = None) -> ActionPlan:
        self.__dict__.setdefault("seen", []).append(context)
        plan = super().plan(context, generators)
        ramp = torch.linspace(-0.9, 0.9, plan.action.shape[1])[None, :, None].expand_as(plan.action)
        return ActionPlan(ramp, plan.flow) if self.fixed else plan


class WatchedFDP(Watched, FDP):
    """Of 3D FDP."""


class WatchedDP3(Watched, DP3):
    """Of DP3."""


def network(name: str, **changes: Any) -> Watched:
    torch.manual_seed(0)
    settings = tiny_settings(name, "horizon=16", "n_action_steps=8", "encoder.points=64")
    values: dict[str, Any] = {
        "tasks": ("hammer",),
        "observer": ObserverSettings().model_dump(mode="json"),
        "queries": QuerySettings(points=6).model_dump(),
    }
    kind: Any = {"fdp": WatchedFDP, "dp3": WatchedDP3}[name]
    return kind(tiny_spec(settings, **values | changes))


@pytest.fixture(scope="module")
def pool() -> SimulatorPool:
    return SimulatorPool("hammer", SceneSettings())


def drive(policy: Policy, pool: SimulatorPool, seed: int) -> np.ndarray:
    """What a user's loop does: the actions, before they are clipped."""
    recorder = pool.simulator(BATCH_SLOTS).begin(seed)
    actions = []
    for _ in range(STEPS):
        frame = recorder.frame() if policy.wants_frame else None
        actions.append(policy.act(frame, recorder.simulation.state))
        recorder.step(np.clip(actions[-1], -1, 1))
    return np.stack(actions)


def rolled_out(policy: PolicyNetwork, pool: SimulatorPool) -> PolicyRollout:
    return next(roll_out(policy, pool, [TRIAL], max_steps=STEPS))


@pytest.mark.parametrize("name", ["fdp", "dp3"])
def test_a_control_loop_acts_as_a_rollout_does(pool: SimulatorPool, name: str) -> None:
    policy = network(name)
    episode = rolled_out(policy, pool)
    driven = drive(Policy(policy, "hammer", seed=TRIAL.scene_seed), pool, TRIAL.scene_seed)
    np.testing.assert_allclose(np.clip(driven[:8], -1, 1), episode.rollout.action[:8], atol=1e-4)
    other = drive(Policy(policy, "hammer", seed=TRIAL.scene_seed + 1), pool, TRIAL.scene_seed)
    assert np.abs(other[:8] - driven[:8]).max() > 1e-2, "the noise is the seed's"


def test_every_plan_of_a_control_loop_is_decided_on_what_a_rollout_shows(pool: SimulatorPool) -> None:
    policy = network("fdp")
    policy.fixed, policy.seen = True, []
    rolled_out(policy, pool)
    rolled, policy.seen = policy.seen, []
    drive(Policy(policy, "hammer", seed=TRIAL.scene_seed), pool, TRIAL.scene_seed)
    assert len(rolled) == len(policy.seen) == 3
    for theirs, mine in zip(rolled, policy.seen, strict=True):
        slot = TRIAL.episode % BATCH_SLOTS
        frames = theirs.observed[slot]
        assert torch.equal(mine.points[mine.observed[0]], theirs.points[frames])
        assert torch.equal(mine.state[mine.observed[0]], theirs.state[frames])
        assert torch.equal(mine.queries[0], theirs.queries[slot])
    assert not torch.equal(policy.seen[1].points, policy.seen[2].points)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Trained on one task, whose cloud is a plate and a ball. States of 9, actions of 4, 8 query points."""
    folder = tmp_path_factory.mktemp("robot")
    return make_run(make_rolls(folder / "rolls"), "--policy", "fdp", "--out", folder / "run", *SMALL)


STATE = np.linspace(-0.2, 0.2, 9)


def plate(height: float = 0.0) -> Frame:
    """A flat plate at some height [m], seen from 1 m above the origin; a bump moves with the height."""
    depth = np.full((12, 16), 1 - height, np.float32)
    depth[3:6, 2:7] -= 0.05 + height
    return Frame(depth, CAMERA)


def act(policy: Policy, steps: int) -> np.ndarray:
    return np.stack([policy.act(plate(0.01 * k) if policy.wants_frame else None, STATE) for k in range(steps)])


def test_the_name_is_in_the_package_and_costs_nothing_until_it_is_used() -> None:
    script = (
        "import sys, flowlab; assert 'torch' not in sys.modules and 'numpy' not in sys.modules\n"
        "from flowlab import Policy; assert 'torch' in sys.modules and 'mujoco' not in sys.modules\n"
        "assert Policy is flowlab.Policy and Policy.__module__ == 'flowlab.deployment.robot_policy'\n"
    )
    subprocess.run([sys.executable, "-c", script], check=True)
    with pytest.raises(AttributeError, match="'flowlab' has no attribute 'Police'"):
        flowlab.Police  # noqa: B018


def test_frames_are_wanted_at_the_plans_and_the_step_before_them(run: Path) -> None:
    policy = flowlab.Policy.load(run)
    wanted, planned = [], []
    for k in range(18):
        wanted.append(policy.wants_frame)
        policy.act(plate() if policy.wants_frame else None, STATE)
        assert policy.step == k + 1
        planned.append(policy.planned_at)
    assert [k for k in range(18) if wanted[k]] == [0, 3, 4, 7, 8, 11, 12, 15, 16]
    assert planned == [0] * 4 + [4] * 4 + [8] * 4 + [12] * 4 + [16] * 2


def test_a_frame_that_is_not_wanted_changes_nothing(run: Path) -> None:
    policy = Policy.load(run)
    always = np.stack([policy.act(plate(0.01 * k), STATE) for k in range(20)])
    np.testing.assert_array_equal(always, act(Policy.load(run), 20))


def test_executing_one_step_plans_every_time(run: Path) -> None:
    policy = Policy.load(run, execute=1)
    first = act(policy, 1)[0]
    assert (policy.n_action_steps, policy.wants_frame, policy.planned_at) == (1, True, 0)
    np.testing.assert_array_equal(first, act(Policy.load(run), 1)[0])
    act(policy, 3)
    assert policy.planned_at == 3


def test_what_the_network_plans_is_what_comes_out(run: Path) -> None:
    """Put together by hand from the network, the Observer and the first frame."""
    policy = Policy.load(run, seed=5)
    done = act(policy, 4)
    net = load_policy(run).policy
    points = torch.from_numpy(Observer(ObserverSettings(points=64), "roll").observe(plate()).points_world)
    assert policy.queries is not None
    context = ObservationBatch(
        points=points[None],
        state=torch.from_numpy(STATE.astype(np.float32))[None],
        observed=torch.zeros(1, 2, dtype=torch.long),
        queries=torch.from_numpy(policy.queries.xyz_world)[None],
        task=torch.zeros(1, dtype=torch.long),
    )
    plan = net.plan(context, torch.Generator().manual_seed(5))
    np.testing.assert_allclose(done, plan.action[0, 1:5], atol=1e-5)
    assert plan.flow is not None
    assert policy.flow is not None
    assert policy.flow.shape == (15, 8, 3)
    np.testing.assert_allclose(policy.flow, plan.flow[0, 1:], atol=1e-6)


def test_a_plan_of_no_numbers_moves_no_robot(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    policy = Policy.load(run)
    plan = policy.network.plan
    monkeypatch.setattr(policy.network, "plan", lambda *seen: replace(p := plan(*seen), action=p.action * float("inf")))
    with pytest.raises(DataError, match="step 0: the policy plans actions that are not finite"):
        act(policy, 1)


def test_policies_without_flow_have_no_points_to_draw(tmp_path: Path) -> None:
    policy = Policy.load(make_run(make_rolls(tmp_path / "d"), "--policy", "dp3", "--out", tmp_path / "run", *SMALL))
    act(policy, 3)
    assert (policy.flow, policy.queries, policy.planned_at) == (None, None, 0)


def test_a_reset_forgets_the_episode(run: Path) -> None:
    policy = Policy.load(run, seed=3)
    first = act(policy, 11)
    policy.reset(seed=3)
    assert (policy.step, policy.planned_at, policy.flow, policy.queries) == (0, None, None, None)
    np.testing.assert_array_equal(act(policy, 11), first)
    policy.reset()
    fourth = act(policy, 11)
    assert np.abs(fourth - first).max() > 1e-3, "another seed without being asked to repeat one"
    np.testing.assert_array_equal(fourth, act(Policy.load(run, seed=4), 11))


def test_one_checkpoint_can_be_loaded_instead_of_the_newest(run: Path) -> None:
    first, *_, last = sorted((run / "checkpoints").iterdir())
    newest = act(Policy.load(str(run)), 2)
    np.testing.assert_array_equal(act(Policy.load(last), 2), newest)
    assert np.abs(act(Policy.load(first), 2) - newest).max() > 1e-4


def test_of_several_tasks_one_must_be_named(tmp_path: Path) -> None:
    units = [[make_episode(k, task=task, steps=20) for k in range(2)] for task in ("pour", "roll")]
    make_dataset(tmp_path / "d", units)
    both = make_run(tmp_path / "d", "--policy", "dp3", "--out", tmp_path / "run", *SMALL)
    with pytest.raises(UsageError, match=r"run: was trained on several tasks; give one as task=, of pour, roll$"):
        Policy.load(both)
    with pytest.raises(UsageError, match="no task that it was trained on is called 'rol'; did you mean roll"):
        Policy.load(both, task="rol")
    pour, roll = (act(Policy.load(both, task=task), 2) for task in ("pour", "roll"))
    assert np.abs(pour - roll).max() > 1e-6, "the policy is told its task"


def refused(policy: Policy, frame: Frame | None, state: Any, kind: type[FlowlabError] = UsageError) -> str:
    with pytest.raises(kind) as found:
        policy.act(frame, state)
    return str(found.value)


def changed(frame: Frame, **changes: Any) -> Frame:
    """A frame with what its type does not allow, as a user's may have."""
    copy = Frame(frame.depth, frame.camera)
    for name, value in changes.items():
        object.__setattr__(copy, name, value)
    return copy


def test_mistakes_are_told_in_a_sentence_and_the_step_can_be_done_again(run: Path) -> None:
    policy = Policy.load(run)
    act(policy, 7)
    assert refused(policy, None, STATE) == (
        "step 7: the policy looks at the frame of this step, and got None; take one whenever policy.wants_frame is True"
    )
    assert "state has the shape (3,), and the policy was trained on states of shape (9,)" in refused(
        policy, plate(), STATE[:3]
    )
    assert "state[4] is no finite number" in refused(policy, plate(), np.where(np.arange(9) == 4, np.nan, STATE))
    assert refused(policy, plate().depth, STATE) == (  # type: ignore[arg-type]
        "step 7: observation is ndarray, expected a Frame; give flowlab.Frame(depth, camera), with rgb=picture for "
        "policies on color"
    )
    dark = Frame(0 * plate().depth, CAMERA)
    assert "step 7: the frame has no depth reading at all" in refused(policy, dark, STATE, DataError)
    far = refused(policy, Frame(1000 * plate().depth, CAMERA), STATE, DataError)
    assert "workspace, x -0.50 to 0.50, y 0.25 to 0.97, z -0.20 to 0.80 m" in far
    assert "z -999.00 to -949.00 m: look whether depth is in meters" in far
    rest = act(policy, 13)
    np.testing.assert_array_equal(rest, act(with_first(run, 7), 13))


def with_first(run: Path, steps: int) -> Policy:
    policy = Policy.load(run)
    act(policy, steps)
    return policy


def test_arguments_that_do_not_fit_are_refused_at_once(run: Path) -> None:
    with pytest.raises(UsageError, match="execute is 16, and plans reach 15 steps ahead; use 1 to 15"):
        Policy.load(run, execute=16)
    with pytest.raises(UsageError, match="device is 'gpu', which PyTorch cannot use here; use cpu, cuda or cuda:1"):
        Policy.load(run, device="gpu")
    with pytest.raises(DataError, match="not a training run"):
        Policy.load(run / "nowhere")


def test_other_layouts_in_memory_are_the_same_picture(run: Path) -> None:
    first = act(Policy.load(run), 1)
    camera = Camera(16, 12, np.asfortranarray(CAMERA.K), np.asfortranarray(CAMERA.T_world_cam))
    depth = np.asfortranarray(plate().depth.astype(np.float64))
    depth.flags.writeable = False
    other = changed(plate(), depth=depth, camera=camera)
    np.testing.assert_array_equal(Policy.load(run).act(other, STATE.astype(np.float32))[None], first)


def test_a_warm_up_leaves_the_episode_as_it_is(run: Path) -> None:
    policy = Policy.load(run)
    wanted = act(Policy.load(run), 20)
    assert 0 < policy.warm_up() < 30
    head = act(policy, 10)
    assert policy.warm_up(plate()) > 0
    assert (policy.step, policy.planned_at) == (10, 8)
    np.testing.assert_array_equal(np.concatenate([head, act_from(policy, 10, 20)]), wanted)
    with pytest.raises(DataError, match="the frame has no depth reading at all"):
        policy.warm_up(Frame(0 * plate().depth, CAMERA))


def act_from(policy: Policy, first: int, stop: int) -> np.ndarray:
    return np.stack([policy.act(plate(0.01 * k) if policy.wants_frame else None, STATE) for k in range(first, stop)])


@pytest.mark.parametrize("sampling", ["scene", "object", "stratified"])
def test_a_warm_up_has_something_to_see_whatever_the_observer_clears_away(sampling: str) -> None:
    """The crops are of a recorded bench, and of DP3's, which lies behind its camera."""
    for low, high in (((-0.1, -0.1, 0.0), (0.1, 0.3, 0.05)), ((-3.0, -3.0, -5.0), (3.0, 3.0, 5.0))):
        observer = {
            "points": 64,
            "crop": {"low": low, "high": high},
            "remove_table": {},
            "remove_outliers": {},
        }
        queries = {"points": 6, "sampling": sampling, "avoid_edges": {}}
        policy = Policy(network("fdp", observer=observer, queries=queries), "hammer")
        assert policy.warm_up() > 0


@pytest.mark.slow  # 8 s
def test_after_a_warm_up_nothing_is_left_to_compile(run: Path) -> None:
    """In a process of its own, where nobody else compiles."""
    script = f"""
import numpy as np
from flowlab import Policy
from flowlab.geometry import sampling
from flowlab.geometry.camera import Camera
from flowlab.perception import point_cloud
from flowlab.records import Frame
compiled = lambda: [len(f.signatures) for f in (point_cloud.unproject_and_crop, sampling._farthest)]
policy = Policy.load({str(run)!r})
assert compiled() == [0, 0]
policy.warm_up()
assert compiled() == [1, 1], compiled()
camera = Camera(16, 12, np.array({CAMERA.K.tolist()}, np.float32), np.array({CAMERA.T_world_cam.tolist()}).T.copy().T)
depth = np.frombuffer(np.ones((16, 12), np.float64).tobytes()).reshape(16, 12).T
policy.act(Frame(depth, camera), np.zeros(9))
locked = np.frombuffer(np.ones((12, 16), np.float32).tobytes(), np.float32).reshape(12, 16)
for _ in range(8):
    policy.act(Frame(locked, camera) if policy.wants_frame else None, list(range(9)))
assert compiled() == [1, 1], compiled()
"""
    subprocess.run([sys.executable, "-c", script], check=True)


def test_the_loop_that_is_documented_runs(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = (Path(__file__).parents[2] / "docs" / "robots.md").read_text()
    loop = page.split("```python\n")[1].split("```")[0]
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "pour-fdp").symlink_to(run)
    monkeypatch.chdir(tmp_path)
    robot = SimpleNamespace(sent=[], state=lambda: STATE)
    robot.send = robot.sent.append
    exec(loop, {"camera": SimpleNamespace(frame=plate), "robot": robot})
    assert len(robot.sent) == 200
    assert all(action.shape == (4,) and np.isfinite(action).all() for action in robot.sent)


def test_a_policy_is_told_apart_at_a_glance(run: Path) -> None:
    assert repr(Policy.load(run)).startswith("Policy(fdp for ")
    assert "\n" not in repr(Policy.load(run))
