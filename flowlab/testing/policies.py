"""Does a policy keep its promises? Checks for authors of policies, on demonstrations that are made up.

In the tests of a policy, with settings that make its network small::

    from flowlab.testing.policies import CHECKS

    @pytest.mark.parametrize("check", CHECKS)
    def test_policy(check):
        check(MyPolicy, ("network.widths=[16]",))
"""

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields, replace
from typing import Any

import torch
from torch import Tensor

from flowlab.config import Settings
from flowlab.data.batches import Batch, ObservationBatch
from flowlab.data.needs import Needs
from flowlab.data.training_settings import TrainSettings
from flowlab.nets.diffusion import NoiseSampler
from flowlab.policies.base import ActionPlan, Losses, PolicyNetwork
from flowlab.policies.spec import PolicySpec
from flowlab.testing.policy_problem import ACTION, PICTURE, Problem, make_problem

STEPS = 60
"""Training steps within which the loss must fall."""
Policy = type[PolicyNetwork]


def check_policy(policy: Policy, settings: Sequence[str] = ()) -> None:
    """Raise an AssertionError that says which promise a policy breaks."""
    for check in CHECKS:
        check(policy, settings)


def check_settings(policy: Policy, settings: Sequence[str] = ()) -> None:
    """It has a title; every setting has a default; settings say what it needs, and survive JSON."""
    known = isinstance(policy, type) and issubclass(policy, PolicyNetwork)
    _require(known, f"a policy must be a class of flowlab.policies.base.PolicyNetwork, and {policy!r} is none")
    title = getattr(policy, "title", None)
    _require(isinstance(title, str) and title.strip(), f"title must be what people call the policy, but is {title!r}")
    model: Any = getattr(policy, "settings_class", None)
    _require(isinstance(model, type) and issubclass(model, TrainSettings), "settings_class must be of TrainSettings")
    missing = next(_without_default(model), None)
    _require(missing is None, f"every setting must have a default, and {missing} has none")
    spec = make_problem(policy, settings).policy.spec
    needs: Any = spec.settings.needs
    _require(isinstance(needs, Needs), f"settings.needs must be a Needs, but is a {type(needs).__name__}")
    again = PolicySpec.model_validate(json.loads(spec.model_dump_json()))
    _require(again == spec, "settings must be the same after they were written to JSON and read back")


def check_loss(policy: Policy, settings: Sequence[str] = ()) -> None:
    """The loss is a finite number with named parts, and a function of batch and noise alone."""
    problem = make_problem(policy, settings)
    losses = _losses(problem)
    _require(isinstance(losses, Losses), f"compute_loss must return Losses, but returns a {type(losses).__name__}")
    for name, loss in {"total": losses.total, **losses.parts}.items():
        _require(loss.shape == () and bool(torch.isfinite(loss)), f"loss '{name}' must be one finite number: {loss}")
    torch.manual_seed(1)
    _require(torch.equal(_losses(problem).total, losses.total), "draw noise from what compute_loss is given only")


def check_parts(policy: Policy, settings: Sequence[str] = ()) -> None:
    """The mean of the losses of a batch's parts is that of the whole, so that processes can share it."""
    problem = make_problem(policy, settings)
    count = len(problem.batch.observed) // 2 * 2
    batch = problem.batch.part(slice(0, count))
    halves = [slice(0, count // 2), slice(count // 2, count)]
    with torch.no_grad():
        whole = problem.policy(batch, _noise(), count).total
        mean = sum(problem.policy(batch.part(h), _noise(h), count).total for h in halves) / 2
    _require_close(mean, whole, "the mean of the losses of two halves of a batch must be that of the whole")


def check_gradients(policy: Policy, settings: Sequence[str] = ()) -> None:
    """Every parameter belongs to one group of :meth:`~flowlab.policies.base.PolicyNetwork.parameter_groups`, and
    learns."""
    problem = make_problem(policy, settings)
    names = {id(p): name for name, p in problem.policy.named_parameters()}
    groups = problem.policy.parameter_groups()
    grouped = [id(p) for modules in groups.values() for m in modules for p in m.parameters()]
    for key, name in names.items():
        _require(grouped.count(key) == 1, f"{name} must be in one parameter group, but is in {grouped.count(key)}")
    _losses(problem).total.backward()  # type: ignore[no-untyped-call]
    for name, p in problem.policy.named_parameters():
        _require(p.grad is not None and bool(p.grad.abs().max() > 0), f"{name} gets no gradient: nothing teaches it")
        _require(p.grad is not None and bool(p.grad.isfinite().all()), f"the gradient of {name} must be finite")


def check_learning(policy: Policy, settings: Sequence[str] = ()) -> None:
    """The loss falls."""
    problem = make_problem(policy, settings)
    optimizer = torch.optim.Adam(problem.policy.parameters(), 3e-3)
    with torch.no_grad():
        before = _losses(problem, 10**6).total
    for step in range(STEPS):
        optimizer.zero_grad()
        _losses(problem, step).total.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
    with torch.no_grad():
        after = _losses(problem, 10**6).total
    _require(after < 0.9 * before, f"in {STEPS} steps the loss must fall by a tenth, but goes from {before} to {after}")


def check_plan(policy: Policy, settings: Sequence[str] = ()) -> None:
    """A plan has an action for every step of every window, and is a function of the generators' states."""
    problem = make_problem(policy, settings)
    s, context = problem.policy.spec.settings, _context(problem.batch)
    windows = len(context.observed)
    plan = problem.policy.plan(context, _generator(5))
    _require(isinstance(plan, ActionPlan), f"plan must return an ActionPlan, but returns a {type(plan).__name__}")
    shapes = {
        "action": (windows, s.horizon, ACTION),
        "flow": (windows, s.horizon, context.queries.shape[1], 3),
        "object_pose": (windows, s.horizon, 9),
    }
    for name, value in _values(plan).items():
        _require(value.shape == shapes[name], f"{name} must have shape {shapes[name]}, but has {tuple(value.shape)}")
        _require(bool(value.isfinite().all()), f"{name} must be finite")
        _require(not value.requires_grad, "plans must be made without gradients: use @torch.no_grad()")
    torch.manual_seed(1)
    again = problem.policy.plan(context, _generator(5))
    _require_close(again.action, plan.action, "a plan must be a function of the state of its generator", exact=True)


def check_windows(policy: Policy, settings: Sequence[str] = ()) -> None:
    """Windows that are planned together, each with a generator of its own, are planned as one by one."""
    problem = make_problem(policy, settings)
    whole = problem.policy.plan(_context(problem.batch), [_generator(w) for w in range(len(problem.batch.observed))])
    for w in range(0, len(problem.batch.observed), 7):
        alone = problem.policy.plan(_context(problem.batch.part(slice(w, w + 1))), [_generator(w)])
        for name, value in _values(alone).items():
            same = f"{name} of a window must not depend on the windows beside it, nor on their generators"
            _require_close(value[0], _values(whole)[name][w], same)


def check_weights(policy: Policy, settings: Sequence[str] = ()) -> None:
    """What it has learned is all in its state_dict."""
    problem = make_problem(policy, settings)
    torch.manual_seed(99)
    other = policy(problem.policy.spec)
    other.load_state_dict(problem.policy.state_dict())
    mine, theirs = (p.plan(_context(problem.batch), _generator(0)).action for p in (problem.policy, other))
    _require_close(theirs, mine, "a network with the same spec and state_dict must plan the same", exact=True)


def check_needs(policy: Policy, settings: Sequence[str] = ()) -> None:
    """It does without what it does not say that it needs."""
    problem = make_problem(policy, settings)
    needs, batch = problem.policy.needs, problem.batch
    frames, (windows, horizon) = len(batch.state), batch.action.shape[:2]
    nothing = {
        "points": (needs.point_cloud is None, torch.full((frames, 7, 3), torch.nan)),
        "queries": (needs.flow is None, torch.full((windows, 3, 3), torch.nan)),
        "flow": (needs.flow is None, torch.full((windows, horizon, 3, 3), torch.nan)),
        "flow_weight": (needs.flow is None, torch.full((windows, horizon, 3), torch.nan)),
        "object_pose": (not needs.object_pose, torch.full((windows, horizon, 9), torch.nan)),
        "depth": (not needs.depth, torch.full((frames, PICTURE, PICTURE), torch.nan)),
        "rgb": (not needs.rgb, torch.full((frames, PICTURE, PICTURE, 3), 255, dtype=torch.uint8)),
    }
    other = replace(batch, **{name: value for name, (unneeded, value) in nothing.items() if unneeded})
    mine, theirs = (problem.policy.plan(_context(b), _generator(0)).action for b in (batch, other))
    _require_close(theirs, mine, "its plans depend on arrays that settings.needs does not name", exact=True)
    losses = [_losses(Problem(problem.policy, b)).total for b in (batch, other)]
    _require_close(losses[1], losses[0], "its loss depends on arrays that settings.needs does not name", exact=True)


CHECKS: tuple[Callable[[Policy, Sequence[str]], None], ...] = (
    check_settings,
    check_loss,
    check_parts,
    check_gradients,
    check_learning,
    check_plan,
    check_windows,
    check_weights,
    check_needs,
)
"""Every promise of :class:`~flowlab.policies.base.PolicyNetwork`, one at a time."""


def _without_default(model: type[Settings], path: str = "") -> Iterator[str]:
    """Settings without a default, by their paths; the policy's name is given by whoever names the policy."""
    for name, field in model.model_fields.items():
        if field.is_required() and name != "policy":
            yield f"{path}{name}"
        if isinstance(field.default, Settings):
            yield from _without_default(type(field.default), f"{path}{name}.")


def _noise(part: slice | None = None, seed: int = 0) -> NoiseSampler:
    return NoiseSampler(_generator(seed), part=part)


def _generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def _losses(problem: Problem, seed: int = 0) -> Losses:
    losses: Losses = problem.policy(problem.batch, _noise(seed=seed), len(problem.batch.observed))
    return losses


def _context(batch: Batch) -> ObservationBatch:
    """What a policy is shown in use: nothing of what followed."""
    return ObservationBatch(**{f.name: getattr(batch, f.name) for f in fields(ObservationBatch)})


def _values(plan: ActionPlan) -> dict[str, Tensor]:
    return {f.name: v for f in fields(plan) if (v := getattr(plan, f.name)) is not None}


def _require_close(found: Any, wanted: Tensor, message: str, exact: bool = False) -> None:
    _require(torch.equal(found, wanted) if exact else torch.allclose(found, wanted, rtol=1e-3, atol=1e-4), message)


def _require(holds: object, message: str) -> None:
    if not holds:
        raise AssertionError(message)
