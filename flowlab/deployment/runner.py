"""A policy's side of one episode: what it remembers, and what it has decided to do."""

from collections import deque
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float32

from flowlab.data.batches import ObservationBatch
from flowlab.errors import DataError
from flowlab.perception.observer import Observer, ObserverSettings
from flowlab.perception.queries import QuerySettings, queries_in
from flowlab.policies.base import ActionPlan, PolicySpec
from flowlab.records import Frame, Queries


class PolicyRunner:
    """Shown the frames of an episode that a plan needs, hands out the action of every step.

    Every ``n_action_steps`` steps a plan is due; it is decided on the last frames only, so that no others need be
    taken.
    """

    def __init__(self, spec: PolicySpec, task: str, seed: int, n_action_steps: int | None = None) -> None:
        if spec.observer is None:
            raise DataError("the policy was trained on clouds whose making is not known, so nobody can make such again")
        s = spec.settings
        self.spec = spec
        self.n_action_steps = n_action_steps or s.n_action_steps
        """Steps of a plan that are executed."""
        self.noise = torch.Generator().manual_seed(seed)
        """Where the noise of this episode's plans comes from."""
        self.queries: Queries | None = None
        """The points whose motion is predicted; None for policies that predict none."""
        self._observer = Observer(ObserverSettings.model_validate(spec.observer), task)
        self._task = torch.tensor([spec.tasks.index(task)])
        self._history: deque[tuple[np.ndarray, np.ndarray]] = deque(maxlen=s.n_obs_steps)
        self._actions: deque[np.ndarray] = deque()

    @property
    def needs_plan(self) -> bool:
        """Whether the next action needs a new plan."""
        return not self._actions

    @property
    def needs_frame(self) -> bool:
        """Whether a plan will be decided on the frame of this step."""
        return len(self._actions) < self.spec.settings.n_obs_steps

    def observe(self, frame: Frame, state: Float32[np.ndarray, "S"]) -> None:
        """Take in a step that a plan will be decided on.

        Args:
            frame: What the camera sees: depth [m], and the camera's pose in the dataset's world frame.
            state: The robot's, laid out as in the training data.

        Raises:
            DataError: The frame shows nothing.
        """
        cloud = self._observer.cloud(frame)
        points = self._observer.sample(cloud).points_world[: self.spec.settings.encoder.points]
        first = not self._history
        if first and self.spec.settings.policy == "fdp":
            self.queries = queries_in(cloud, frame.depth, QuerySettings.model_validate(self.spec.queries))
        times = self.spec.settings.n_obs_steps if first else 1  # what was before the first step is taken to be like it
        self._history.extend([(points, np.asarray(state, np.float32))] * times)

    def observation(self) -> ObservationBatch:
        """What a plan is to be decided on, as one window."""
        queries = np.zeros((0, 3), np.float32) if self.queries is None else self.queries.xyz_world
        return ObservationBatch(
            points=torch.from_numpy(np.stack([points for points, _ in self._history])),
            state=torch.from_numpy(np.stack([state for _, state in self._history])),
            observed=torch.arange(len(self._history))[None],
            queries=torch.from_numpy(queries)[None],
            task=self._task,
        )

    def execute(self, plan: ActionPlan, window: int = 0) -> None:
        """Hand out the actions of one window of a plan from now on."""
        now = self.spec.settings.n_obs_steps - 1
        self._actions.extend(plan.action[window, now : now + self.n_action_steps].cpu().numpy())

    def next_action(self) -> Float32[np.ndarray, "A"]:
        """The action of this step, in the dataset's units."""
        return self._actions.popleft()


def concatenate(observations: Sequence[ObservationBatch]) -> ObservationBatch:
    """Observations of one window each as one batch."""
    frames = np.cumsum([0, *(len(o.points) for o in observations)])
    return ObservationBatch(
        points=torch.cat([o.points for o in observations]),
        state=torch.cat([o.state for o in observations]),
        observed=torch.cat([o.observed + int(n) for o, n in zip(observations, frames[:-1], strict=True)]),
        queries=torch.cat([o.queries for o in observations]),
        task=torch.cat([o.task for o in observations]),
    )
