"""A policy in simulation sees what the dataset holds, does what it planned, and its successes are counted as told."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
import torch
from builders import tiny_settings, tiny_spec
from synthetic import assert_same

from flowlab.data.batches import ObservationBatch
from flowlab.evaluation.rollout import BATCH_SLOTS, PolicyRollout, SimulatorPool, roll_out
from flowlab.evaluation.trials import SCENES_PER_SEED, Trial
from flowlab.perception.observer import Box, ObserverSettings
from flowlab.perception.queries import QuerySettings
from flowlab.policies.base import ActionPlan, Generators, PolicyNetwork
from flowlab.policies.dp3 import DP3
from flowlab.policies.fdp import FDP
from flowlab.records import Episode, Frame
from flowlab.sim.recorder import EpisodeRecorder, ExpertSettings, TaskSimulator
from flowlab.sim.scene_settings import SceneSettings

HORIZON = 64


@pytest.fixture(scope="module")
def hammer() -> SimulatorPool:
    return SimulatorPool("hammer", SceneSettings())


@pytest.fixture(scope="module")
def reach() -> SimulatorPool:
    return SimulatorPool("reach", SceneSettings())


@dataclass
class Seen:
    contexts: list[ObservationBatch] = field(default_factory=list)


class Repeater(DP3):
    """Plans given actions, and remembers what the first slot was shown."""

    def repeat(self, action: np.ndarray, n_action_steps: int) -> Seen:
        self.demonstrated, self.n_action_steps, self.seen = torch.from_numpy(action), n_action_steps, Seen()
        return self.seen

    def plan(self, context: ObservationBatch, generators: Generators = None) -> ActionPlan:
        s = self.spec.settings
        first = self.n_action_steps * len(self.seen.contexts) - (s.n_obs_steps - 1)
        self.seen.contexts.append(context)
        row = torch.arange(first, first + s.horizon).clamp(0, len(self.demonstrated) - 1)
        return ActionPlan(self.demonstrated[row].expand(BATCH_SLOTS, -1, -1))


def spec_values(task: str, queries: int = 20, **observer: Any) -> dict[str, Any]:
    return {
        "tasks": (task,),
        "observer": ObserverSettings(**observer).model_dump(mode="json"),
        "queries": QuerySettings(points=queries).model_dump(),
    }


def repeater(name: str, task: str, history: int = 2, **observer: Any) -> Repeater:
    changes = [f"horizon={HORIZON}", "n_action_steps=8", "encoder.points=1024", f"n_obs_steps={history}"]
    settings = tiny_settings(name, *changes, *(["motion.points=20"] if name == "fdp" else []))
    return Repeater(tiny_spec(settings, **spec_values(task, **observer)))


def demonstrated(episode: Episode) -> Trial:
    """The trial whose scene is that of a demonstration; no evaluation has it."""
    trial = Trial(episode.task, -1, episode.seed)
    assert trial.scene_seed == episode.seed
    return trial


def only(episodes: Sequence[PolicyRollout]) -> PolicyRollout:
    (episode,) = episodes
    return episode


@pytest.mark.parametrize(
    ("name", "history", "n_action_steps"),
    [("dp3", 2, 8), ("fdp", 2, 8), ("fdp", 2, 1), ("dp3", 1, 8), ("dp3", 3, 2)],
)
def test_repeating_the_expert_solves_the_task_at_the_same_step_and_shows_the_dataset(
    hammer: SimulatorPool, hammer_episode: Episode, name: str, history: int, n_action_steps: int
) -> None:
    """Every plan looks at the frames up to its own step, bit for bit as the dataset has them."""
    policy = repeater(name, "hammer", history)
    seen = policy.repeat(hammer_episode.action, n_action_steps)
    episode = only([*roll_out(policy, hammer, [demonstrated(hammer_episode)], n_action_steps=n_action_steps)])
    assert episode.result.success
    solved = int(np.flatnonzero(hammer_episode.success)[0]) + 1
    assert episode.result.steps == solved
    steps = len(episode.rollout)
    assert len(seen.contexts) == -(-steps // n_action_steps)
    np.testing.assert_array_equal(episode.rollout.action, hammer_episode.action[:steps])
    np.testing.assert_array_equal(episode.rollout.state, hammer_episode.state[:steps])
    queries = hammer_episode.queries.xyz_world[: 20 if name == "fdp" else 0]
    for k, context in enumerate(seen.contexts):
        rows = [max(n_action_steps * k - back, 0) for back in reversed(range(history))]
        frames = context.observed[0]
        np.testing.assert_array_equal(context.points[frames], hammer_episode.point_cloud[rows])
        np.testing.assert_array_equal(context.state[frames], hammer_episode.state[rows])
        np.testing.assert_array_equal(context.queries[0], queries)
        assert len(context.observed) == BATCH_SLOTS


def test_a_policy_that_does_nothing_runs_out_of_steps(hammer: SimulatorPool) -> None:
    policy = repeater("dp3", "hammer")
    seen = policy.repeat(np.zeros((1, 4), np.float32), 8)
    outcome = only([*roll_out(policy, hammer, [Trial("hammer", 0, 4)], max_steps=19)]).result
    assert (outcome.task, outcome.seed, outcome.episode, outcome.scene_seed) == ("hammer", 0, 4, 1_000_004)
    assert (outcome.success, outcome.success_dp3, outcome.steps, outcome.note) == (False, False, 19, "")
    assert len(seen.contexts) == 3


def test_actions_are_clipped(hammer: SimulatorPool) -> None:
    """As the expert's are; MetaWorld would take more."""
    policy = repeater("dp3", "hammer")
    policy.repeat(np.array([[3.0, -2.0, 0.5, 9.0]], np.float32), 8)
    rollout = only([*roll_out(policy, hammer, [Trial("hammer", 0, 0)], max_steps=3)]).rollout
    np.testing.assert_array_equal(rollout.action, [[1, -1, 0.5, 1]] * 3)


@pytest.fixture(scope="module")
def there_and_away(reach: SimulatorPool) -> tuple[Trial, np.ndarray, list[bool]]:
    """Actions that reach the goal and leave it again, and whether the task was solved after each of them."""
    trial = Trial("reach", 0, 0)
    simulator = reach.simulator(0)
    expert = simulator.record_expert(trial.scene_seed, ExpertSettings(hold=3))
    back = -expert.action[0, :3] / np.abs(expert.action[0, :3]).max()
    action = np.concatenate([expert.action, np.tile(np.append(back, 0).astype(np.float32), (60, 1))])
    live = simulator.begin(trial.scene_seed)
    success = [live.step(a) for a in np.clip(action, -1, 1)]
    first = success.index(True)
    last = len(success) - success[::-1].index(True)
    assert first > 0
    assert all(success[first:last])
    assert last < len(success) - 15, "the hand leaves the goal for good"
    return trial, action, success


def read_as_dp3_does(success: list[bool], n_action_steps: int) -> int | None:
    """Steps until the end of the first plan with a success among its last two steps; None where there is none."""
    for stop in range(n_action_steps, len(success) + 1, n_action_steps):
        if any(success[max(stop - 2, stop - n_action_steps) : stop]):
            return stop
    return None


def test_a_success_counts_whenever_it_was_and_for_dp3_only_at_the_end_of_a_plan(
    reach: SimulatorPool, there_and_away: tuple[Trial, np.ndarray, list[bool]]
) -> None:
    trial, action, success = there_and_away
    first = success.index(True) + 1
    solved_steps = sum(success)
    missed = first + solved_steps + 2  # the last two steps of the first plan come just after
    kinds = set()
    for n_action_steps in (1, 2, 3, 7, 8, first, first + 1, first + solved_steps, first + solved_steps + 1, missed):
        assert 1 <= n_action_steps < HORIZON
        policy = repeater("dp3", "reach")
        policy.repeat(action, n_action_steps)
        episode = only([*roll_out(policy, reach, [trial], n_action_steps=n_action_steps, max_steps=len(success))])
        outcome, length = episode.result, len(episode.rollout)
        end = read_as_dp3_does(success, n_action_steps)
        assert outcome.success
        assert outcome.steps == first
        assert outcome.success_dp3 == (end is not None), n_action_steps
        assert length == (end or len(success)), "it goes on until both agree"
        assert episode.rollout.success.tolist() == success[:length]
        kinds.add(outcome.success_dp3)
    assert kinds == {True, False}


def noisy() -> PolicyNetwork:
    """A policy that has learned nothing: its actions come of its noise."""
    torch.manual_seed(0)
    settings, values = tiny_settings("fdp", "encoder.points=64"), spec_values("hammer", 6, points=64)
    return FDP(tiny_spec(settings, **{**values, "tasks": ("assembly", "hammer")})).eval()


def by_trial(episodes: Sequence[PolicyRollout]) -> dict[Trial, PolicyRollout]:
    found = {a.result.trial: a for a in episodes}
    assert len(found) == len(episodes)
    return found


def assert_same_episode(a: PolicyRollout, b: PolicyRollout) -> None:
    """To the last bit."""
    assert a.result == b.result
    for name in ("action", "state", "success", "object_pose"):
        assert_same(getattr(a.rollout, name), getattr(b.rollout, name), name)
    assert a.rollout.extras == b.rollout.extras
    assert len(a.predicted) == len(b.predicted) > 0
    for (step, flow), (other_step, other_flow) in zip(a.predicted, b.predicted, strict=True):
        assert step == other_step
        assert_same(flow, other_flow, "flow")
    assert_same(a.queries, b.queries, "queries")


def test_an_episode_is_the_same_whatever_is_tried_beside_it(hammer: SimulatorPool) -> None:
    """Alone, among others, in another order, on used simulations: outcome, actions and plans to the last bit."""
    policy = noisy()
    wanted = [Trial("hammer", seed, k) for seed in (0, 1) for k in range(5)]
    together = by_trial([*roll_out(policy, hammer, wanted, max_steps=12)])
    assert together.keys() == set(wanted)
    reverse = by_trial([*roll_out(policy, hammer, wanted[::-1], max_steps=12)])
    some = by_trial([*roll_out(policy, hammer, wanted[1:8:3], max_steps=12)])
    fresh = SimulatorPool("hammer", SceneSettings())
    alone = by_trial([only([*roll_out(policy, fresh, [t], max_steps=12)]) for t in (wanted[6], wanted[4])])
    for others in (reverse, some, alone):
        for trial, episode in others.items():
            assert_same_episode(episode, together[trial])
    actions = {a.rollout.action.tobytes() for a in together.values()}
    scene_seeds = {tuple(a.rollout.extras["rand_vec"]) for a in together.values()}
    assert len(actions) == len(scene_seeds) == len(wanted)


def test_noise_is_the_trials_own(hammer: SimulatorPool) -> None:
    """It is that of a generator seeded with the layout, as if the trial were all there is."""
    policy = noisy()
    noise: list[torch.Tensor] = []

    class Listener(FDP):
        def plan(self, context: ObservationBatch, generators: Generators = None) -> ActionPlan:
            assert isinstance(generators, Sequence)
            noise.append(torch.stack([torch.randn(7, generator=g) for g in generators]))
            return policy.plan(context, generators)

    wanted = [Trial("hammer", 2, 1), Trial("hammer", 2, 3)]
    assert len([*roll_out(Listener(policy.spec), hammer, wanted, max_steps=4)]) == 2
    for trial in wanted:
        own = torch.Generator().manual_seed(3 * SCENES_PER_SEED + trial.episode)
        assert torch.equal(noise[0][trial.episode], torch.randn(7, generator=own))


@pytest.mark.parametrize(("n_action_steps", "looked_at"), [(4, [0, 3, 4, 7, 8, 11]), (1, [*range(12)])])
def test_only_what_a_plan_looks_at_is_taken_and_that_changes_nothing(
    hammer: SimulatorPool, monkeypatch: pytest.MonkeyPatch, n_action_steps: int, looked_at: list[int]
) -> None:
    policy, trial = noisy(), Trial("hammer", 0, 0)
    taken: list[int] = []
    take = EpisodeRecorder.frame

    def frame(live: EpisodeRecorder) -> Frame:
        taken.append(len(live.success))
        return take(live)

    monkeypatch.setattr(EpisodeRecorder, "frame", frame)
    episode = only([*roll_out(policy, hammer, [trial], n_action_steps=n_action_steps, max_steps=12)])
    assert taken[: len(looked_at)] == looked_at
    assert set(taken) <= {*looked_at, 12}
    taken.clear()
    always = only(
        [*roll_out(policy, hammer, [trial], n_action_steps=n_action_steps, max_steps=12, render_every_step=True)]
    )
    assert taken[:12] == [*range(12)]
    assert_same_episode(episode, always)


def test_what_was_predicted_is_the_plans_flow_from_the_present_on(hammer: SimulatorPool) -> None:
    policy = repeater("fdp", "hammer", history=3)
    policy.repeat(np.zeros((1, 4), np.float32), 8)
    flow = torch.arange(BATCH_SLOTS * HORIZON * 20 * 3, dtype=torch.float32).view(BATCH_SLOTS, HORIZON, 20, 3)

    class Prophet(Repeater):
        def plan(self, context: ObservationBatch, generators: Generators = None) -> ActionPlan:
            return ActionPlan(policy.plan(context, generators).action, flow)

    episode = only([*roll_out(Prophet(policy.spec), hammer, [Trial("hammer", 0, 2)], max_steps=20)])
    assert [step for step, _ in episode.predicted] == [0, 8, 16]
    for _, prediction in episode.predicted:
        np.testing.assert_array_equal(prediction, flow[2, 2:])


HAND = (0.0, 0.6, 0.2)
"""Where the hand begins, about."""


def test_a_view_that_becomes_empty_fails_the_episode_and_says_why(reach: SimulatorPool) -> None:
    """The crop holds the hand only where it begins, and it goes up."""
    low, high = ([x + s * d for x, d in zip(HAND, (0.06, 0.06, 0.05), strict=True)] for s in (-1, 1))
    policy = repeater("dp3", "reach", crop=Box(low=tuple(low), high=tuple(high)))
    seen = policy.repeat(np.array([[0, 0, 1, 0]], np.float32), 8)
    episode = only([*roll_out(policy, reach, [Trial("reach", 0, 0)])])
    outcome = episode.result
    assert "no point of the frame lies in the crop" in outcome.note
    assert (outcome.success, outcome.success_dp3) == (False, False)
    assert 1 <= len(seen.contexts) < 200 // 8
    assert outcome.steps == len(episode.rollout) < 200


def test_a_first_view_that_is_empty_fails_the_episode_too(reach: SimulatorPool) -> None:
    """And the others go on."""
    policy = repeater("dp3", "reach", crop=Box(low=(5, 5, 5), high=(6, 6, 6)))
    policy.repeat(np.zeros((1, 4), np.float32), 8)
    wanted = [Trial("reach", 0, 0), Trial("reach", 0, 4), Trial("reach", 0, 1)]
    outcomes = [a.result for a in roll_out(policy, reach, wanted)]
    assert {o.trial for o in outcomes} == set(wanted)
    for outcome in outcomes:
        assert "no point of the frame lies in the crop" in outcome.note
        assert (outcome.success, outcome.success_dp3, outcome.flow) == (False, False, None)


def test_a_pool_makes_a_simulator_once() -> None:
    pool = SimulatorPool("reach", SceneSettings())
    first = pool.simulator(1)
    assert pool.simulator(1) is first
    assert pool.simulator(2) is not first
    assert isinstance(first, TaskSimulator)
