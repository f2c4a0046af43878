"""Policies act in simulation: several episodes at a time, so that one plan serves them all."""

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float32

from flowlab.data.batches import ObservationBatch
from flowlab.deployment.policy_runner import PolicyRunner
from flowlab.errors import DataError
from flowlab.evaluation.flow_error import flow_error
from flowlab.evaluation.results import EpisodeResult
from flowlab.evaluation.success import solved_for_dp3
from flowlab.evaluation.trials import Trial
from flowlab.policies.base import ActionPlan, PolicyNetwork
from flowlab.records import Queries
from flowlab.sim.recorder import EpisodeRecorder, Rollout, TaskSimulator
from flowlab.sim.scene_settings import ACTION_SIZE, SceneSettings

MAX_STEPS = 200
"""DP3's and 3D FDP's limit."""
BATCH_SLOTS = 4
"""Windows of every plan. More hardly cost less each (on a CPU, the encoder's products are large enough), and each
needs a simulation of its own."""


@dataclass(frozen=True, slots=True)
class PolicyRollout:
    """An episode that a policy has been through."""

    result: EpisodeResult
    rollout: Rollout
    queries: Queries | None
    """The points whose motion was predicted."""
    predicted: tuple[tuple[int, Float32[np.ndarray, "K M 3"]], ...]
    """The step every plan was made at, and the flow [m] it predicted from then on, action by action; more of them
    than are executed."""


class SimulatorPool:
    """Simulators of one task, one for each slot of a batch, made as they are needed and used again."""

    def __init__(self, task: str, scene: SceneSettings) -> None:
        self.task, self.scene = task, scene
        self._simulators: dict[int, TaskSimulator] = {}

    def simulator(self, slot: int) -> TaskSimulator:
        """That of a slot."""
        if slot not in self._simulators:
            self._simulators[slot] = TaskSimulator(self.task, self.scene)
        return self._simulators[slot]


def roll_out(
    policy: PolicyNetwork,
    simulators: SimulatorPool,
    trials: Sequence[Trial],
    *,
    n_action_steps: int | None = None,
    max_steps: int = MAX_STEPS,
    render_every_step: bool = False,
) -> Iterator[PolicyRollout]:
    """Try episodes of one task, and hand out each as it ends.

    What comes out of a trial depends on the policy and the trial only, bit for bit, whatever else is tried beside it:
    every plan has :data:`BATCH_SLOTS` windows, a trial's is always the same of them (its number modulo their count),
    and its noise is its own.

    Args:
        policy: The network, with what it was trained on.
        simulators: Of the trials' task, in the scene that the policy knows.
        trials: What to try.
        n_action_steps: Steps of every plan to execute; None executes as many as the policy was trained to.
        max_steps: After so many, an episode has failed.
        render_every_step: Take frames that no plan looks at too, which changes nothing.

    Yields:
        Every episode, in the order in which they end.
    """

    def begin(slot: int, trial: Trial) -> _RunningEpisode:
        runner = PolicyRunner(policy.spec, trial.task, trial.scene_seed, n_action_steps)
        recorder = simulators.simulator(slot).begin(trial.scene_seed)
        episode = _RunningEpisode(trial, recorder, runner, max_steps, render_every_step)
        episode.observe()
        return episode

    waiting = [deque(t for t in trials if t.episode % BATCH_SLOTS == slot) for slot in range(BATCH_SLOTS)]
    running: dict[int, _RunningEpisode] = {}
    noise = [torch.Generator() for _ in range(BATCH_SLOTS)]
    device = next(policy.parameters()).device
    while running or any(waiting):
        for slot in range(BATCH_SLOTS):
            if slot not in running and waiting[slot]:
                running[slot] = begin(slot, waiting[slot].popleft())
                noise[slot] = running[slot].runner.noise
        yield from (running.pop(slot).abort() for slot in sorted(running) if running[slot].note)
        if running:
            plan = policy.plan(_observations(running).to(device), noise)
            for slot in sorted(running):
                running[slot].execute(plan, slot)
            yield from (running.pop(slot).finish() for slot in sorted(running) if running[slot].is_over)


def _observations(running: Mapping[int, "_RunningEpisode"]) -> ObservationBatch:
    """What a plan for all slots is decided on; those in which nothing runs show what another does."""
    spare = min(running)
    return ObservationBatch.concatenate(
        [running[slot if slot in running else spare].runner.observation() for slot in range(BATCH_SLOTS)]
    )


@dataclass
class _RunningEpisode:
    """An episode that has begun and not ended."""

    trial: Trial
    recorder: EpisodeRecorder
    runner: PolicyRunner
    max_steps: int
    render_every_step: bool
    success_dp3: bool = False
    note: str = ""
    """Why it cannot go on."""
    predicted: list[tuple[int, Float32[np.ndarray, "K M 3"]]] = field(default_factory=list)

    @property
    def is_over(self) -> bool:
        """Whether it is solved by both readings, out of steps, or cannot go on."""
        solved = self.success_dp3 and any(self.recorder.success)
        return solved or len(self.recorder.success) >= self.max_steps or bool(self.note)

    def observe(self) -> None:
        """Show the policy the present, if a plan will be decided on it."""
        wanted = self.runner.needs_frame or self.render_every_step
        frame = self.recorder.frame() if wanted else None
        if self.runner.needs_state:
            try:
                self.runner.observe(frame, self.recorder.simulation.state)
            except DataError as error:
                self.note = str(error)

    def execute(self, plan: ActionPlan, window: int) -> None:
        """Execute one window of a plan, up to the next plan or the episode's end."""
        began = len(self.recorder.success)
        if plan.flow is not None:
            now = self.runner.spec.settings.n_obs_steps - 1
            self.predicted.append((began, plan.flow[window, now:].cpu().numpy()))
        self.runner.execute(plan, window)
        while not (self.runner.needs_plan or self.is_over):
            self.recorder.step(np.clip(self.runner.next_action(), -1, 1))
            done = self.recorder.success[began:]
            if self.runner.needs_plan or began + len(done) == self.max_steps:
                self.success_dp3 |= solved_for_dp3(done)
            self.observe()
            if self.recorder.unstable:
                self.note = "the physics became unstable"

    def abort(self) -> PolicyRollout:
        """End it after a step in which nothing is done: there is no rollout without one."""
        self.recorder.step(np.zeros(ACTION_SIZE, np.float32))
        return self.finish()

    def finish(self) -> PolicyRollout:
        """What it has come to."""
        trial, success, queries = self.trial, self.recorder.success, self.runner.queries
        rollout, predicted = self.recorder.rollout(), tuple(self.predicted)
        solved = any(success) and not self.note
        error = None if queries is None else flow_error(rollout, queries, predicted, self.runner.n_action_steps)
        result = EpisodeResult(
            task=trial.task,
            seed=trial.seed,
            episode=trial.episode,
            scene_seed=trial.scene_seed,
            success=solved,
            success_dp3=solved and self.success_dp3,
            steps=success.index(True) + 1 if solved else len(success),
            note=self.note,
            flow=error,
        )
        return PolicyRollout(result, rollout, queries, predicted)
