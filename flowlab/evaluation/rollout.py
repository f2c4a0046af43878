"""Policies act in simulation: several episodes at a time, so that one plan serves them all."""

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float32

from flowlab.data.batches import ObservationBatch
from flowlab.deployment.runner import PolicyRunner
from flowlab.errors import DataError
from flowlab.evaluation.flow_error import flow_error
from flowlab.evaluation.trials import EpisodeResult, Trial
from flowlab.policies.base import ActionPlan, PolicyNetwork
from flowlab.records import Queries
from flowlab.sim.recorder import EpisodeRecorder, Rollout, TaskSimulator
from flowlab.sim.simulation import ACTION_SIZE, SceneSettings

MAX_STEPS = 200
"""DP3's and 3D FDP's limit."""
BATCH_SLOTS = 4
"""Windows of every plan. More hardly cost less each (on a CPU, the encoder's products are large enough), and each
needs a simulation of its own."""
_LAST_LOOKED_AT = 2
"""Of the executed steps of a plan, DP3's runner keeps the success of so many."""


@dataclass(frozen=True, slots=True)
class Attempt:
    """An episode that a policy has been through."""

    outcome: EpisodeResult
    rollout: Rollout
    queries: Queries | None
    """The points whose motion was predicted."""
    predicted: tuple[tuple[int, Float32[np.ndarray, "K M 3"]], ...]
    """The step every plan was made at, and the flow [m] it foresaw from then on, action by action; more of them than
    are executed."""


class SimulatorPool:
    """Simulations of one task, one for each lane, made as they are needed and used again."""

    def __init__(self, task: str, scene: SceneSettings) -> None:
        self.task, self.scene = task, scene
        self._simulators: dict[int, TaskSimulator] = {}

    def simulator(self, lane: int) -> TaskSimulator:
        """That of a lane."""
        if lane not in self._simulators:
            self._simulators[lane] = TaskSimulator(self.task, self.scene)
        return self._simulators[lane]


def roll_out(
    policy: PolicyNetwork,
    stage: SimulatorPool,
    trials: Sequence[Trial],
    *,
    n_action_steps: int | None = None,
    max_steps: int = MAX_STEPS,
    look_always: bool = False,
) -> Iterator[Attempt]:
    """Try episodes of one task, and hand out each as it ends.

    What comes out of a trial depends on the policy and the trial only, bit for bit, whatever else is tried beside it:
    every plan has ``LANES`` windows, a trial's is always the same of them (its number modulo ``LANES``), and its noise
    is its own. Only frames that a plan looks at are taken, but with ``look_always``, which changes nothing.
    """
    lanes = [_BatchSlot(k, policy, stage, n_action_steps, max_steps, look_always) for k in range(BATCH_SLOTS)]
    for trial in trials:
        lanes[trial.episode % BATCH_SLOTS].waiting.append(trial)
    device = next(policy.parameters()).device
    while ready := [lane for lane in lanes if lane.ready()]:
        yield from (lane.give_up() for lane in ready if lane.is_blind)
        ready = [lane for lane in ready if lane.under_way is not None]
        if not ready:
            continue
        spare = ready[0].context()
        whole = ObservationBatch.concatenate([lane.context() if lane in ready else spare for lane in lanes]).to(device)
        plan = policy.plan(whole, [lane.noise for lane in lanes])
        yield from (attempt for lane in ready if (attempt := lane.go_on(plan)) is not None)


@dataclass
class _UnderWay:
    """An episode that has begun."""

    trial: Trial
    live: EpisodeRecorder
    actor: PolicyRunner
    success_dp3: bool = False
    note: str = ""
    predicted: list[tuple[int, Float32[np.ndarray, "K M 3"]]] = field(default_factory=list)


class _BatchSlot:
    """One window of every plan: tries its episodes one after the other."""

    def __init__(
        self,
        index: int,
        policy: PolicyNetwork,
        stage: SimulatorPool,
        n_action_steps: int | None,
        max_steps: int,
        look_always: bool,
    ) -> None:
        self._index, self._policy, self._stage = index, policy, stage
        self._n_action_steps, self._max_steps, self._look_always = n_action_steps, max_steps, look_always
        self.waiting: deque[Trial] = deque()
        self.under_way: _UnderWay | None = None
        self.noise = torch.Generator()

    def ready(self) -> bool:
        """Begin the next episode if none is under way; whether one is."""
        if self.under_way is None and self.waiting:
            trial = self.waiting.popleft()
            actor = PolicyRunner(self._policy.spec, trial.task, trial.scene_seed, self._n_action_steps)
            self.noise = actor.noise
            self.under_way = _UnderWay(trial, self._stage.simulator(self._index).begin(trial.scene_seed), actor)
            self._look()
        return self.under_way is not None

    @property
    def is_blind(self) -> bool:
        """Whether the episode under way shows the policy nothing to begin with."""
        return self.under_way is not None and bool(self.under_way.note)

    def give_up(self) -> Attempt:
        """End the episode under way after a step in which nothing is done: there is no attempt without one."""
        episode = self.under_way
        assert episode is not None
        episode.live.step(np.zeros(ACTION_SIZE, np.float32))
        self.under_way = None
        return _finished(episode)

    def context(self) -> ObservationBatch:
        """What a plan for the episode under way is decided on."""
        assert self.under_way is not None
        return self.under_way.actor.context()

    def go_on(self, plan: ActionPlan) -> Attempt | None:
        """Execute this lane's part of a plan; the attempt if it has come to its end."""
        episode = self.under_way
        assert episode is not None
        live, actor = episode.live, episode.actor
        began = len(live.success)
        if plan.flow is not None:
            now = actor.spec.settings.n_obs_steps - 1
            flow = plan.flow[self._index, now:].cpu().numpy()
            episode.predicted.append((began, flow))
        actor.follow(plan, self._index)
        over = False
        while not over:
            live.step(np.clip(actor.act(), -1, 1))
            if actor.plan_is_due or len(live.success) == self._max_steps:
                episode.success_dp3 |= any(live.success[began:][-_LAST_LOOKED_AT:])
            self._look()
            over = self._is_over(episode)
            if actor.plan_is_due:
                break
        if not over:
            return None
        self.under_way = None
        return _finished(episode)

    def _look(self) -> None:
        assert self.under_way is not None
        episode, live = self.under_way, self.under_way.live
        if not (episode.actor.needs_frame or self._look_always):
            return
        frame = live.frame()
        if episode.actor.needs_frame:
            try:
                episode.actor.see(frame, live.simulation.state)
            except DataError as error:
                episode.note = str(error)

    def _is_over(self, episode: _UnderWay) -> bool:
        """Once solved by both readings, out of steps, or broken down."""
        live = episode.live
        if live.unstable:
            episode.note = "the physics became unstable"
        solved = any(live.success) and episode.success_dp3
        return solved or len(live.success) >= self._max_steps or bool(episode.note)


def _finished(episode: _UnderWay) -> Attempt:
    trial, live, queries = episode.trial, episode.live, episode.actor.queries
    rollout, predicted = live.rollout(), tuple(episode.predicted)
    solved = bool(any(live.success)) and not episode.note
    outcome = EpisodeResult(
        task=trial.task,
        seed=trial.seed,
        episode=trial.episode,
        scene_seed=trial.scene_seed,
        success=solved,
        success_dp3=solved and episode.success_dp3,
        steps=live.success.index(True) + 1 if solved else len(live.success),
        note=episode.note,
        flow=None if queries is None else flow_error(rollout, queries, predicted, episode.actor.n_action_steps),
    )
    return Attempt(outcome, rollout, queries, predicted)
