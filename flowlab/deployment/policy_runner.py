"""A policy's side of one episode: what it remembers, and what it has decided to do."""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import torch
from jaxtyping import Float32, UInt8
from pydantic import ValidationError

from flowlab.config import Settings, explain
from flowlab.data.batches import ObservationBatch
from flowlab.deployment.inputs import GivenCloud, explain_empty_cloud
from flowlab.errors import DataError, UsageError
from flowlab.perception.observer import Observer, ObserverSettings
from flowlab.perception.queries import QuerySettings, queries_in
from flowlab.policies.base import ActionPlan
from flowlab.policies.spec import PolicySpec
from flowlab.records import Frame, Queries

Model = TypeVar("Model", bound=Settings)
_NO_POINTS = np.zeros((0, 3), np.float32)


@dataclass(frozen=True, slots=True)
class _ObservedStep:
    """What a policy needs of one step; what it does not need is empty, or None."""

    points: Float32[np.ndarray, "N 3"]
    state: Float32[np.ndarray, "S"]
    rgb: UInt8[np.ndarray, "H W 3"] | None
    depth: Float32[np.ndarray, "H W"] | None


class PolicyRunner:
    """Shown the frames of an episode that a plan needs, hands out the action of every step.

    Every ``n_action_steps`` steps a plan is due; it is decided on the last frames only, so that no others need be
    taken.
    """

    def __init__(
        self, spec: PolicySpec, task: str, seed: int, n_action_steps: int | None = None, *, takes_clouds: bool = False
    ) -> None:
        s, needs = spec.settings, spec.settings.needs
        self._needs_cloud = needs.point_cloud is not None or needs.flow is not None
        self._needs_picture = self._needs_cloud or bool(needs.pictures)
        self.spec = spec
        if not takes_clouds:
            self._check_observer()
        self.n_action_steps = n_action_steps or s.n_action_steps
        """Steps of a plan that are executed."""
        self.noise = torch.Generator().manual_seed(seed)
        """Where the noise of this episode's plans comes from."""
        self.queries: Queries | None = None
        """The points whose motion is predicted; None for policies that predict none."""
        self._observer = Observer(_settings(ObserverSettings, spec.observer or {}, "observer"), task)
        self._query_settings = _settings(QuerySettings, spec.queries, "queries") if needs.flow is not None else None
        self._task = torch.tensor([spec.tasks.index(task)])
        self._history: deque[_ObservedStep] = deque(maxlen=s.n_obs_steps)
        self._actions: deque[np.ndarray] = deque()

    @property
    def needs_plan(self) -> bool:
        """Whether the next action needs a new plan."""
        return not self._actions

    @property
    def needs_state(self) -> bool:
        """Whether a plan will be decided on this step."""
        return len(self._actions) < self.spec.settings.n_obs_steps

    @property
    def needs_frame(self) -> bool:
        """Whether a plan will be decided on the frame of this step."""
        return self._needs_picture and self.needs_state

    def observe(self, frame: Frame | GivenCloud | None, state: Float32[np.ndarray, "S"]) -> None:
        """Take in a step that a plan will be decided on.

        Args:
            frame: What the camera sees: depth [m], the camera's pose in the dataset's world frame, and color where the
                policy needs it; or a cloud that is ready. None where :attr:`needs_frame` is False.
            state: The robot's, laid out as in the training data.

        Raises:
            DataError: The frame shows nothing, or nobody knows how a cloud is to be made of it.
            UsageError: The policy needs color, and the frame has none.
        """
        if isinstance(frame, GivenCloud):
            self._observe_cloud(frame, np.asarray(state, np.float32))
            return
        needs, first = self.spec.settings.needs, not self._history
        if frame is None:
            if self.needs_frame:
                raise UsageError("the policy needs the frame of this step, and got None")
        elif needs.rgb and frame.rgb is None:
            raise UsageError("the policy needs color, and the frame has none; give it as rgb, of the size of the depth")
        points = _NO_POINTS
        if self._needs_cloud and frame is not None:
            self._check_observer()
            cloud = self._observer.cloud(frame)
            if needs.point_cloud is not None:
                points = self._observer.sample(cloud).points_world[: needs.point_cloud.points]
            if first and self._query_settings is not None:
                self.queries = queries_in(cloud, frame.depth, self._query_settings)
        rgb = frame.rgb if needs.rgb and frame is not None else None
        depth = frame.depth if needs.depth and frame is not None else None
        self._remember(_ObservedStep(points, np.asarray(state, np.float32), rgb, depth))

    def explain(self, error: DataError, frame: Frame | GivenCloud | None) -> str:
        """Why a frame could not be observed, in words for whoever drives the robot."""
        if not isinstance(frame, Frame) or self.spec.observer is None or len(self._observer.cloud(frame).xyz_world):
            return str(error)
        return explain_empty_cloud(frame, self._observer.settings.crop_for(self._observer.task))

    def _check_observer(self) -> None:
        if self._needs_cloud and self.spec.observer is None:
            raise DataError("the policy was trained on clouds whose making is not known, so nobody can make such again")

    def _observe_cloud(self, cloud: GivenCloud, state: Float32[np.ndarray, "S"]) -> None:
        """The same of a cloud that somebody else made; with the first comes what to follow."""
        needs = self.spec.settings.needs
        if not self._history and needs.flow is not None:
            if cloud.query_points is None:
                raise UsageError("the policy predicts how points move, and the episode's first cloud comes without any")
            owner = np.full(len(cloud.query_points), -1, np.int16)
            self.queries = Queries(cloud.query_points, owner, len(owner))
        points = _NO_POINTS if needs.point_cloud is None else cloud.points_world
        self._remember(_ObservedStep(points, state, None, None))

    def _remember(self, step: _ObservedStep) -> None:
        """Keep a step; what was before the first is taken to be like it."""
        self._history.extend([step] * (1 if self._history else self.spec.settings.n_obs_steps))

    def observation(self) -> ObservationBatch:
        """What a plan is to be decided on, as one window."""
        queries = _NO_POINTS if self.queries is None else self.queries.xyz_world
        needs, steps = self.spec.settings.needs, self._history
        return ObservationBatch(
            points=torch.from_numpy(np.stack([s.points for s in steps])),
            state=torch.from_numpy(np.stack([s.state for s in steps])),
            observed=torch.arange(len(steps))[None],
            queries=torch.from_numpy(queries)[None],
            task=self._task,
            rgb=torch.from_numpy(np.stack([s.rgb for s in steps if s.rgb is not None])) if needs.rgb else None,
            depth=torch.from_numpy(np.stack([s.depth for s in steps if s.depth is not None])) if needs.depth else None,
        )

    def execute(self, plan: ActionPlan, window: int = 0) -> None:
        """Hand out the actions of one window of a plan from now on."""
        now = self.spec.settings.n_obs_steps - 1
        self._actions.extend(plan.action[window, now : now + self.n_action_steps].cpu().numpy())

    def next_action(self) -> Float32[np.ndarray, "A"]:
        """The action of this step, in the dataset's units."""
        return self._actions.popleft()


def is_finite(plan: ActionPlan) -> bool:
    """Whether a robot can do what is planned."""
    return bool(plan.action.isfinite().all())


def _settings(model: type[Model], values: Mapping[str, Any], name: str) -> Model:
    """Settings that a policy was trained with. Raises :class:`DataError` where they are none."""
    try:
        return model.model_validate(values)
    except ValidationError as error:
        raise DataError(f"the policy's {name}: {explain(error, model)}; restore its policy.json") from error
