"""A policy in simulation sees what the dataset holds, and does what it planned."""

from dataclasses import dataclass, field

import numpy as np
import pytest
import torch
from tiny import tiny_settings, tiny_spec

from flowlab.evaluation.rollout import roll_out
from flowlab.learning.batches import Context
from flowlab.learning.policy import Plan, Policy
from flowlab.perception.observer import ObserverSettings
from flowlab.perception.queries import QuerySettings
from flowlab.records import Episode
from flowlab.sim.environment import SceneSettings
from flowlab.sim.rollout import Studio

EXECUTED, HORIZON = 8, 16


@pytest.fixture(scope="module")
def studio() -> Studio:
    return Studio("hammer", SceneSettings())


@dataclass
class Seen:
    contexts: list[Context] = field(default_factory=list)


class Repeater(Policy):
    """Plans the actions of a demonstration, and remembers what it was shown."""

    def follow(self, action: np.ndarray) -> Seen:
        self.demonstrated, self.seen = torch.from_numpy(action), Seen()
        return self.seen

    def plan(self, context: Context, generator: torch.Generator | None = None) -> Plan:
        now = EXECUTED * len(self.seen.contexts)
        self.seen.contexts.append(context)
        row = torch.arange(now - 1, now - 1 + HORIZON).clamp(0, len(self.demonstrated) - 1)
        return Plan(self.demonstrated[row][None])


def repeater(name: str) -> Repeater:
    settings = tiny_settings(name, f"horizon={HORIZON}", f"executed={EXECUTED}", "encoder.points=1024")
    queries = QuerySettings(points=20).model_dump()
    observer = ObserverSettings().model_dump(mode="json")
    return Repeater(tiny_spec(settings, tasks=("hammer",), observer=observer, queries=queries))


@pytest.mark.parametrize("name", ["dp3", "fdp"])
def test_repeating_the_expert_solves_the_task_at_the_same_step_and_shows_the_dataset(
    studio: Studio, hammer_episode: Episode, name: str
) -> None:
    policy = repeater(name)
    seen = policy.follow(hammer_episode.action)
    outcome = roll_out(studio, policy, hammer_episode.seed)
    assert outcome.success
    assert outcome.steps == np.flatnonzero(hammer_episode.success)[0] + 1
    for k, context in enumerate(seen.contexts):
        rows = [max(EXECUTED * k - 1, 0), EXECUTED * k]
        np.testing.assert_array_equal(context.points, hammer_episode.point_cloud[rows])
        np.testing.assert_array_equal(context.state, hammer_episode.state[rows])
        queries = hammer_episode.queries.xyz_world[None, : 20 if name == "fdp" else 0]
        np.testing.assert_array_equal(context.queries, queries)


def test_a_policy_that_does_nothing_runs_out_of_steps(studio: Studio) -> None:
    policy = repeater("dp3")
    policy.follow(np.zeros((1, 4), np.float32))
    outcome = roll_out(studio, policy, 3, max_steps=19)
    assert (outcome.success, outcome.steps) == (False, 19)
    assert len(policy.seen.contexts) == 3


def test_the_same_seed_gives_the_same_outcome(studio: Studio) -> None:
    torch.manual_seed(0)
    settings = tiny_settings("fdp", "encoder.points=64")
    spec = tiny_spec(
        settings,
        tasks=("hammer",),
        observer=ObserverSettings().model_dump(),
        queries=QuerySettings(points=6).model_dump(),
    )
    policy = Policy(spec)
    ends = []
    for seed in (5, 5, 6):
        roll_out(studio, policy, seed, max_steps=10)
        ends.append(studio.simulation.state)
    np.testing.assert_array_equal(ends[0], ends[1])
    assert (ends[0] != ends[2]).any()
