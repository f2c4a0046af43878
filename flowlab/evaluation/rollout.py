"""A policy acts in simulation, seeing what its own Observer makes of the scene."""

from collections import deque
from dataclasses import dataclass

import numpy as np
import torch

from flowlab.learning.batches import Context
from flowlab.learning.policy import Policy
from flowlab.perception.observer import Observer, ObserverSettings
from flowlab.perception.queries import QuerySettings, sample_queries
from flowlab.records import Observation
from flowlab.sim.rollout import Studio

MAX_STEPS = 200
"""DP3's and 3D FDP's limit."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """How one episode went."""

    task: str
    seed: int
    success: bool
    """Whether the task counted as solved after any step."""
    steps: int
    """Until it did, or all of them."""


def roll_out(studio: Studio, policy: Policy, seed: int, max_steps: int = MAX_STEPS) -> Outcome:
    """Let a policy try the layout of ``seed``; the same seed gives the same outcome.

    Only the frames that a plan looks at are rendered.
    """
    spec, sim = policy.spec, studio.simulation
    s = spec.settings
    observer = Observer(ObserverSettings.model_validate(spec.observer), sim.task.name)
    generator = torch.Generator().manual_seed(seed)
    sim.reset(seed)
    live = studio.live()
    cloud = observer.cloud(live.frame())
    queries = torch.zeros(1, 0, 3)
    if s.policy == "fdp":
        chosen = sample_queries(cloud, QuerySettings.model_validate(spec.queries))
        queries = torch.from_numpy(chosen.xyz_world)[None]
    task = torch.tensor([spec.tasks.index(sim.task.name)])
    first = observer.sample(cloud), sim.state
    seen: deque[tuple[Observation, np.ndarray]] = deque([first] * s.history, s.history)
    step = 0
    while step < max_steps:
        context = Context(
            points=torch.from_numpy(np.stack([o.points_world[: s.encoder.points] for o, _ in seen])),
            state=torch.from_numpy(np.stack([state for _, state in seen])),
            observed=torch.arange(s.history)[None],
            queries=queries,
            task=task,
        )
        plan = policy.plan(context, generator).action[0, s.history - 1 :][: s.executed].numpy()
        for k, action in enumerate(plan):
            success = sim.step(np.clip(action, -1, 1))
            step += 1
            if success or step == max_steps:
                return Outcome(sim.task.name, seed, success, step)
            if k >= len(plan) - s.history:
                seen.append((observer.observe(live.frame()), sim.state))
    raise AssertionError("the last step returns")
