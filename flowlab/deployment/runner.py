"""A policy's side of one episode: what it remembers, and what it has decided to do."""

from collections import deque

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
    """Shown every step of an episode, gives the action for it.

    Every ``n_action_steps`` steps a plan is due; it looks at the last frames only, so that no others need be taken.
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
        self._seen: deque[tuple[np.ndarray, np.ndarray]] = deque(maxlen=s.n_obs_steps)
        self._planned: deque[np.ndarray] = deque()

    @property
    def plan_is_due(self) -> bool:
        """Whether the next action needs a plan."""
        return not self._planned

    @property
    def needs_frame(self) -> bool:
        """Whether a plan will look at the frame of this step."""
        return len(self._planned) < self.spec.settings.n_obs_steps

    def see(self, frame: Frame, state: Float32[np.ndarray, "S"]) -> None:
        """Take in a step that the actor looks at. Raises :class:`DataError` where the frame shows nothing."""
        cloud = self._observer.cloud(frame)
        needs = self.spec.settings.needs
        wanted = 0 if needs.point_cloud is None else needs.point_cloud.points
        points = self._observer.sample(cloud).points_world[:wanted]
        first = not self._seen
        if first and needs.flow is not None:
            self.queries = queries_in(cloud, frame.depth, QuerySettings.model_validate(self.spec.queries))
        times = self.spec.settings.n_obs_steps if first else 1  # what was before the first step is taken to be like it
        self._seen.extend([(points, np.asarray(state, np.float32))] * times)

    def context(self) -> ObservationBatch:
        """What a plan is to be decided on."""
        queries = np.zeros((0, 3), np.float32) if self.queries is None else self.queries.xyz_world
        return ObservationBatch(
            points=torch.from_numpy(np.stack([points for points, _ in self._seen])),
            state=torch.from_numpy(np.stack([state for _, state in self._seen])),
            observed=torch.arange(len(self._seen))[None],
            queries=torch.from_numpy(queries)[None],
            task=self._task,
        )

    def follow(self, plan: ActionPlan, window: int = 0) -> None:
        """Do what a plan says for one of its windows."""
        now = self.spec.settings.n_obs_steps - 1
        self._planned.extend(plan.action[window, now : now + self.n_action_steps].cpu().numpy())

    def act(self) -> Float32[np.ndarray, "A"]:
        """The action of this step."""
        return self._planned.popleft()
