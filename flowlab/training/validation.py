"""How well a policy does on demonstrations it was not trained on, beside what costs nothing."""

from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from flowlab.data.batch_builder import BatchBuilder
from flowlab.data.batches import Batch
from flowlab.data.window_sampler import WindowIndex
from flowlab.geometry.moving import MOVING_IN_PLAN_M
from flowlab.policies.base import ActionPlan, PolicyNetwork

_WINDOWS = 256
"""Most windows that are looked at, evenly spaced over all of them."""
_AT_ONCE = 64


def validate(
    policy: PolicyNetwork, builder: BatchBuilder, windows: WindowIndex, device: torch.device
) -> dict[str, float]:
    """Errors of a policy's plans on some windows; the same noise each time.

    ``action_l1``: mean absolute error of the executed actions, in the dataset's units; ``_zero`` and ``_hold`` are
    those of no action, and of the last one repeated. ``flow_moving_mm`` and ``flow_static_mm``: mean distance [mm]
    between predicted and true positions of query points, over the steps from now on that the labels cover;
    ``pose_mm`` is that of the object's position. ``_zero`` stands still, ``_constant`` keeps the true velocity of the
    last step. Policies that see one frame only have no last step to go by, so these two are left out.
    """
    generator = torch.Generator().manual_seed(0)
    sums: dict[str, np.ndarray] = {}
    for part in portions(windows):
        batch = builder.build(part).to(device)
        for name, (total, count) in _errors(policy, batch, policy.plan(batch, generator)).items():
            sums[name] = sums.get(name, np.zeros(2)) + np.array([float(total), float(count)])
    baselines = ("_zero",) if policy.spec.settings.n_obs_steps == 1 else ("_zero", "_hold", "_constant")  # need a past
    return {
        name: float(total / count)
        for name, (total, count) in sums.items()
        if count and (name.endswith(baselines) or not name.endswith(("_hold", "_constant")))
    }


def portions(windows: WindowIndex) -> Iterator[WindowIndex]:
    """Evenly spaced windows, in handy portions; each a run of its own."""
    index = np.unique(np.linspace(0, len(windows.now) - 1, _WINDOWS).astype(int))
    for part in np.array_split(index, -(-len(index) // _AT_ONCE)):
        yield WindowIndex(windows.episode[part], windows.now[part], np.zeros(len(part), int))


def _errors(policy: PolicyNetwork, batch: Batch, plan: ActionPlan) -> dict[str, tuple[Tensor, Tensor]]:
    """Sum and count of every error."""
    s = policy.spec.settings
    now = s.n_obs_steps - 1
    chosen = slice(now, now + s.n_action_steps)
    known = (batch.action_weight[:, chosen, None] > 0).expand_as(batch.action[:, chosen])
    true = batch.action[:, chosen]
    held = batch.action[:, max(now - 1, 0), None].expand_as(true)
    guesses = {"": plan.action[:, chosen], "_zero": torch.zeros_like(true), "_hold": held}
    errors = {f"action_l1{name}": _sum((guess - true).abs(), known) for name, guess in guesses.items()}
    if plan.flow is not None:
        errors |= _flow_errors(batch, plan.flow, now)
    if plan.object_pose is not None:
        errors |= _pose_errors(batch, plan.object_pose, now)
    return errors


def true_motion(batch: Batch, now: int) -> tuple[Tensor, Tensor, Tensor]:
    """How far every query point gets from where it is now, step by step (W, K, M, 3) [m]; what of it the labels cover
    (W, K, M); and which points move (W, 1, M)."""
    known = (batch.flow_weight[:, now:] > 0).cummin(1).values
    true = batch.flow[:, now:].cumsum(1)
    return true, known, ((true.norm(dim=-1) > MOVING_IN_PLAN_M) & known).any(1, keepdim=True)


def constant_motion(batch: Batch, now: int) -> Tensor:
    """The same (W, K, M, 3) [m], if the motion of the step before now went on."""
    return _continued(batch.flow[:, max(now - 1, 0)], batch.flow[:, now:])


def _flow_errors(batch: Batch, flow: Tensor, now: int) -> dict[str, tuple[Tensor, Tensor]]:
    true, known, moving = true_motion(batch, now)
    continued = constant_motion(batch, now)
    guesses = {"": flow[:, now:].cumsum(1), "_zero": torch.zeros_like(true), "_constant": continued}
    return {
        f"flow_{kind}_mm{name}": _sum(1e3 * (guess - true).norm(dim=-1), known & of_kind)
        for kind, of_kind in (("moving", moving), ("static", ~moving))
        for name, guess in guesses.items()
    }


def _pose_errors(batch: Batch, pose: Tensor, now: int) -> dict[str, tuple[Tensor, Tensor]]:
    """Of the position only: the pose at each step after now."""
    here = batch.object_pose[:, now, :3]
    known = batch.action_weight[:, now + 1 :] > 0
    true = batch.object_pose[:, now + 1 :, :3] - here[:, None]
    last = here - batch.object_pose[:, max(now - 1, 0), :3]
    guesses = {
        "": pose[:, now + 1 :, :3] - here[:, None],
        "_zero": torch.zeros_like(true),
        "_constant": _continued(last, true),
    }
    return {f"pose_mm{name}": _sum(1e3 * (guess - true).norm(dim=-1), known) for name, guess in guesses.items()}


def _continued(velocity: Tensor, like: Tensor) -> Tensor:
    """Where a constant velocity (W, ..., 3) leads in 1, 2, ... steps (W, T, ..., 3)."""
    steps = torch.arange(1, like.shape[1] + 1, device=like.device)
    return velocity[:, None] * steps.view(1, -1, *[1] * (like.ndim - 2))


def _sum(error: Tensor, counted: Tensor) -> tuple[Tensor, Tensor]:
    return (error * counted).sum(), counted.sum()
