"""What a policy is worth without a simulator: its errors on demonstrations it was not trained on."""

from collections.abc import Sequence
from pathlib import Path

from flowlab.config import Settings
from flowlab.data.batch_builder import BatchBuilder
from flowlab.data.query_subset import choose_queries
from flowlab.data.window_sampler import WindowIndex, index_windows
from flowlab.evaluation.flow_metrics import FlowErrors, pool_errors
from flowlab.evaluation.held_out import HeldOut, open_held_out
from flowlab.evaluation.sampled_flow import FlowSampler
from flowlab.policies.base import PolicyNetwork
from flowlab.policies.checkpoint import LoadedPolicy
from flowlab.training.validation import validate


class OfflineErrors(Settings):
    """As :func:`~flowlab.training.validation.validate` defines them. None where there is no such prediction, or no
    last step to go by (``hold``, ``constant``)."""

    action_l1: float | None = None
    action_l1_zero: float | None = None
    action_l1_hold: float | None = None
    flow_moving_mm: float | None = None
    flow_moving_mm_zero: float | None = None
    flow_moving_mm_constant: float | None = None
    flow_static_mm: float | None = None
    flow_static_mm_zero: float | None = None
    flow_static_mm_constant: float | None = None
    pose_mm: float | None = None
    pose_mm_zero: float | None = None
    pose_mm_constant: float | None = None


class ErrorSummary(Settings):
    """Errors on one demonstration, or on all."""

    windows: int
    """Plans that are asked for; of more than 256, so many are made, evenly spaced."""
    errors: OfflineErrors
    flow: FlowErrors | None
    """None for policies that predict none, and where nothing moves. Of all demonstrations, distances are over all
    pairs, and TAPVid-3D's figures are means over the demonstrations, weighted by the pairs that are seen."""


class DemonstrationErrors(ErrorSummary):
    """Errors on one demonstration."""

    task: str
    seed: int


class OfflineReport(Settings):
    """How far a policy is from demonstrations it was not trained on."""

    policy: str
    """Name of its kind: fdp, dp3, mba, or one that was added."""
    step: int
    """Training steps that its weights have seen."""
    dataset: str
    demonstrations: tuple[DemonstrationErrors, ...]
    all: ErrorSummary


def evaluate_offline(loaded: LoadedPolicy, data: Path | None = None) -> OfflineReport:
    """Errors on the demonstrations that a policy's run held out.

    Args:
        loaded: The policy.
        data: Another dataset to take demonstrations from; those whose simulated scene the policy was trained on are
            left out.

    Raises:
        DataError: There are no such demonstrations, or the dataset does not fit the policy.
    """
    held_out = open_held_out(loaded, data)
    evaluator = _OfflineEvaluator(loaded.policy, held_out)
    each = [evaluator.measure(k) for k in range(len(held_out.buffer.episodes))]
    return OfflineReport(
        policy=loaded.policy.spec.settings.policy,
        step=loaded.step,
        dataset=str(held_out.dataset),
        demonstrations=tuple(each),
        all=ErrorSummary(
            windows=sum(d.windows for d in each),
            errors=evaluator.errors(range(len(each))),
            flow=pool_errors([d.flow for d in each if d.flow is not None]),
        ),
    )


class _OfflineEvaluator:
    """Compares a policy's plans with what was demonstrated."""

    def __init__(self, policy: PolicyNetwork, held_out: HeldOut) -> None:
        s, spec = policy.spec.settings, policy.spec
        self._policy, self._held_out = policy, held_out
        self._builder = BatchBuilder(held_out.buffer, spec.channels, s, spec.tasks)
        needs = policy.needs.flow
        columns = None if needs is None else choose_queries(held_out.buffer, needs)
        self._sampler = None if columns is None else FlowSampler(policy, held_out.buffer, self._builder, columns)

    def measure(self, demo: int) -> DemonstrationErrors:
        """All errors on one demonstration."""
        about = self._held_out.buffer.episodes[demo]
        return DemonstrationErrors(
            task=about.task,
            seed=about.seed,
            windows=len(self._windows([demo]).now),
            errors=self.errors([demo]),
            flow=self._flow(demo),
        )

    def errors(self, demos: Sequence[int]) -> OfflineErrors:
        """The errors that training looks at, too."""
        device = next(self._policy.parameters()).device
        return OfflineErrors(**validate(self._policy, self._builder, self._windows(demos), device))

    def _windows(self, demos: Sequence[int]) -> WindowIndex:
        """The windows of some demonstrations, one for each plan that is asked for."""
        return index_windows(self._held_out.buffer, list(demos), self._policy.spec.settings.n_action_steps)

    def _flow(self, demo: int) -> FlowErrors | None:
        """Errors of predicted flow; None where none is predicted, or nothing moves."""
        if self._sampler is None:
            return None
        errors = self._sampler.compare(self._windows([demo]))
        camera = None if self._held_out.cameras is None else self._held_out.cameras[demo]
        has_past = self._policy.spec.settings.n_obs_steps > 1
        return errors.compute(camera, has_past=has_past) if len(errors.window) else None
