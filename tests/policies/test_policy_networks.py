"""The policies: what goes into their networks, what comes out, and in which units and frames."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from builders import HAND, MLP, NORMALIZER, UNET, generator, random_batch, sampler, tiny_settings, tiny_spec
from torch import Tensor

from flowlab.data.batches import Batch
from flowlab.data.channels import ChannelSpec
from flowlab.policies.base import Losses, make_policy

HISTORY, HORIZON, M, A = 2, 8, 6, 4
VARIANTS = [
    ("dp3", MLP, "channels"),
    ("dp3", UNET, "channels"),
    ("mba", MLP, "channels"),
    ("mba", UNET, "channels"),
    ("fdp", MLP, "channels"),
    ("fdp", UNET, "channels"),
    ("fdp", MLP, "per-query"),
]
EVERY_VARIANT = pytest.mark.parametrize(
    ("name", "network", "layout"), VARIANTS, ids=[f"{n}-{'mlp' if k == MLP else 'unet'}-{f}" for n, k, f in VARIANTS]
)
MOTIONS = pytest.mark.parametrize(("name", "layout"), [("mba", "channels"), ("fdp", "channels"), ("fdp", "per-query")])


def make(name: str, *overrides: str, places: ChannelSpec | None = None, **changes: Any) -> tuple[Any, Batch]:
    """A policy with random weights, and all windows of three demonstrations."""
    spec = tiny_spec(tiny_settings(name, *overrides), channels=places or ChannelSpec(), **changes)
    torch.manual_seed(0)
    return make_policy(spec), random_batch(spec.settings, spec.channels)


def variant(name: str, network: str, layout: str, *overrides: str, **changes: Any) -> tuple[Any, Batch]:
    return make(
        name, f"action={network}", *motion_settings(name, layout, f"motion.denoiser={network}"), *overrides, **changes
    )


def motion_settings(name: str, layout: str, *others: str) -> tuple[str, ...]:
    """The settings of a motion that a policy has."""
    representation = (f"motion.flow_representation={layout}",) if name == "fdp" else ()
    return () if name == "dp3" else (*representation, *others)


def scaled(values: Tensor, scale: Any) -> Tensor:
    return (values - torch.tensor(scale.offset)) / torch.tensor(scale.unit)


# Training.


@EVERY_VARIANT
@pytest.mark.parametrize("relative", [False, True])
def test_every_weight_learns_from_every_batch(name: str, network: str, layout: str, relative: bool) -> None:
    policy, batch = variant(name, network, layout, f"encoder.relative={str(relative).lower()}", places=HAND)
    losses = policy(batch, sampler(), len(batch.observed))
    if "motion" not in losses.parts:
        assert name == "dp3"
        assert losses.total is losses.parts["action"]
    else:
        weight = policy.spec.settings.motion.weight
        torch.testing.assert_close(losses.total, losses.parts["action"] + weight * losses.parts["motion"])
        assert weight != 1
    losses.total.backward()
    for key, p in policy.named_parameters():
        assert p.grad is not None, key
        assert torch.isfinite(p.grad).all(), key
        assert p.grad.abs().max() > 0, key


@EVERY_VARIANT
def test_parts_of_a_batch_have_the_losses_and_gradients_of_the_whole(name: str, network: str, layout: str) -> None:
    """As processes share it: the mean over parts is the whole."""
    policy, batch = variant(name, network, layout, "encoder.relative=true", places=HAND)
    parts = [slice(k, k + 5) for k in range(0, 25, 5)]
    whole: Losses = policy(batch, sampler(), 25)
    pieces = [policy(batch.part(p), sampler(part=p), 25) for p in parts]
    for loss, found in {"total": whole.total, **whole.parts}.items():
        mean = torch.stack([x.total if loss == "total" else x.parts[loss] for x in pieces]).mean()
        torch.testing.assert_close(mean, found, rtol=1e-4, atol=1e-6)
    weights = list(policy.parameters())
    mean = torch.autograd.grad(torch.stack([x.total for x in pieces]).mean(), weights)
    for mine, theirs in zip(mean, torch.autograd.grad(whole.total, weights), strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-3, atol=1e-6)


def answer(policy: Any, monkeypatch: pytest.MonkeyPatch, action: Tensor, motion: Tensor | None = None) -> None:
    """Have the networks predict these, in normalized units, whatever they see."""

    def always(answer: Tensor) -> Any:
        return lambda x, *rest: answer.expand(len(x) // len(answer), *answer.shape).transpose(0, 1).flatten(0, 1)

    monkeypatch.setattr(policy.action, "denoise", always(action))
    if motion is not None:
        monkeypatch.setattr(policy.motion, "denoise", always(motion))


def laid_out(flow: Tensor, layout: str) -> Tensor:
    """Flow (W, T, M, 3) as the motion network has it."""
    windows, steps, m, _ = flow.shape
    found = torch.empty((windows, steps, 3 * m) if layout == "channels" else (windows, m, 3 * steps))
    for t in range(steps):
        for q in range(m):
            for c in range(3):
                if layout == "channels":
                    found[:, t, 3 * q + c] = flow[:, t, q, c]
                else:
                    found[:, q, 3 * t + c] = flow[:, t, q, c]
    return found


@pytest.mark.parametrize("loss", ["l1", "mse"])
def test_the_action_loss_is_the_weighted_distance_in_normalized_units(
    loss: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy, batch = make("dp3", f"diffusion.loss={loss}")
    answer(policy, monkeypatch, torch.zeros(25, HORIZON, A))
    truth = scaled(batch.action, NORMALIZER.action)
    distance = truth.abs() if loss == "l1" else truth.square()
    assert (batch.action_weight == 0).any()
    wanted = (distance * batch.action_weight[..., None]).mean()
    torch.testing.assert_close(policy(batch, sampler(), 25).parts["action"], wanted)


@pytest.mark.parametrize("layout", ["channels", "per-query"])
def test_the_flow_loss_is_the_weighted_distance_to_clipped_flow(layout: str, monkeypatch: pytest.MonkeyPatch) -> None:
    clip = 0.8
    policy, batch = make(
        "fdp", f"motion.flow_representation={layout}", normalizer=NORMALIZER.model_copy(update={"flow_clip": clip})
    )
    truth = scaled(batch.flow, NORMALIZER.flow)
    assert (truth.abs() > clip).any()
    answer(policy, monkeypatch, torch.zeros(25, HORIZON, A), laid_out(torch.zeros(25, HORIZON, M, 3), layout))
    wanted = (truth.clamp(-clip, clip).abs() * batch.flow_weight[..., None]).mean()
    torch.testing.assert_close(policy(batch, sampler(), 25).parts["motion"], wanted)


def test_each_window_has_so_many_draws_of_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    """The mean over five draws is that of five passes with one each."""
    policy, batch = make("dp3", "batch.draws=5")
    d = sampler()
    step, noise = d.steps(20, 25, 5), d.normal(25, 5, HORIZON, A)
    condition = policy.encoder(batch, policy.normalize_clouds(batch.points, batch.state))
    truth, total = policy.action_scale(batch.action), torch.zeros(())
    for k in range(5):
        noised = policy.diffusion.noised(truth, noise[:, k], step[:, k])
        found = policy.action.denoise(noised, policy.action.terms(condition, step[:, k, None]))
        total = total + ((found - truth).abs() * batch.action_weight[..., None]).mean() / 5
    torch.testing.assert_close(policy(batch, sampler(), 25).parts["action"], total)


@MOTIONS
def test_the_right_motion_has_no_loss_and_the_right_action_neither(
    name: str, layout: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy, batch = make(name, *motion_settings(name, layout), "encoder.relative=true", places=HAND)
    gripper = batch.state[batch.observed[:, -1]][:, :3]
    action = batch.action.clone()
    action[..., :3] -= gripper[:, None]
    if name == "fdp":
        motion = laid_out((batch.flow / 0.02).clamp(-3, 3), layout)
    else:
        position = scaled(batch.object_pose[..., :3] - gripper[:, None], NORMALIZER.position)
        motion = torch.cat([position, batch.object_pose[..., 3:]], -1)
    answer(policy, monkeypatch, scaled(action, NORMALIZER.action), motion)
    losses = policy(batch, sampler(), 25)
    assert losses.parts["action"] < 1e-6
    assert losses.parts["motion"] < 1e-6


@pytest.mark.parametrize("condition", ["clean", "one-step", "truth", "truth-noised", "auxiliary"])
def test_losses_are_finite_whatever_the_action_is_conditioned_on(condition: str) -> None:
    for layout in ("channels", "per-query"):
        policy, batch = make("fdp", f"motion.condition='{condition}'", f"motion.flow_representation={layout}")
        losses = policy(batch, sampler(), 25)
        losses.total.backward()
        assert torch.isfinite(losses.total)
        assert policy.plan(batch, generator()).flow is not None


def test_every_weight_belongs_to_one_optimizer() -> None:
    for name, network, layout in VARIANTS:
        policy, _ = variant(name, network, layout)
        parts = policy.parameter_groups()
        assert list(parts) == ["encoder", "action", "motion"][: 2 if name == "dp3" else 3]
        mine = [id(p) for modules in parts.values() for m in modules for p in m.parameters()]
        assert len(mine) == len(set(mine))
        assert set(mine) == {id(p) for p in policy.parameters()}


# Use.


@EVERY_VARIANT
def test_a_plan_has_an_action_for_every_step_and_the_motion_too(name: str, network: str, layout: str) -> None:
    policy, batch = variant(name, network, layout)
    plan = policy.plan(batch, generator())
    assert plan.action.shape == (25, HORIZON, A)
    assert (plan.flow is None) == (name != "fdp")
    assert (plan.object_pose is None) == (name != "mba")
    if plan.flow is not None:
        assert plan.flow.shape == (25, HORIZON, M, 3)
    if plan.object_pose is not None:
        assert plan.object_pose.shape == (25, HORIZON, 9)
    low, high = (np.array(NORMALIZER.action.offset) + s * np.array(NORMALIZER.action.unit) for s in (-1, 1))
    assert (plan.action.numpy() >= low - 1e-5).all()
    assert (plan.action.numpy() <= high + 1e-5).all()


@EVERY_VARIANT
def test_a_plan_is_a_function_of_the_state_of_its_generator(name: str, network: str, layout: str) -> None:
    policy, batch = variant(name, network, layout)

    def decide(g: torch.Generator) -> list[Tensor]:
        plan = policy.plan(batch, g)
        return [x for x in (plan.action, plan.flow, plan.object_pose) if x is not None]

    torch.manual_seed(1)
    first = decide(generator(5))
    torch.manual_seed(2)
    for mine, theirs in zip(decide(generator(5)), first, strict=True):
        assert torch.equal(mine, theirs)
    g = generator(5)
    decide(g)
    for later, other, before in zip(decide(g), decide(generator(6)), first, strict=True):
        assert not torch.equal(later, before)
        assert not torch.equal(other, before)


@EVERY_VARIANT
def test_windows_planned_together_are_planned_one_by_one(
    name: str, network: str, layout: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy, batch = variant(name, network, layout, "encoder.relative=true", places=HAND)
    drawn: list[Tensor] = []
    randn = torch.randn
    monkeypatch.setattr(torch, "randn", lambda *a, **k: drawn.append(randn(*a, **k)) or drawn[-1])
    whole = policy.plan(batch, generator())
    assert len(drawn) == (1 if name == "dp3" else 2)
    for w in range(0, 25, 4):
        mine = iter([noise[w : w + 1] for noise in drawn])
        monkeypatch.setattr(torch, "randn", lambda *a, mine=mine, **k: next(mine))
        alone = policy.plan(batch.part(slice(w, w + 1)), generator())
        for field in ("action", "flow", "object_pose"):
            if getattr(whole, field) is not None:
                mine_alone, theirs = getattr(alone, field)[0], getattr(whole, field)[w]
                torch.testing.assert_close(mine_alone, theirs, rtol=1e-3, atol=1e-4, msg=f"{field} of window {w}")


@EVERY_VARIANT
@pytest.mark.parametrize("relative", [False, True])
def test_plans_are_in_the_units_and_frame_of_the_dataset(
    name: str, network: str, layout: str, relative: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy, batch = variant(name, network, layout, f"encoder.relative={str(relative).lower()}", places=HAND)
    gripper = batch.state[batch.observed[:, -1]][:, :3] if relative else torch.zeros(25, 3)
    action = torch.rand(25, HORIZON, A) * 2 - 1
    flow, pose = torch.rand(25, HORIZON, M, 3) * 2 - 1, torch.rand(25, HORIZON, 9) * 2 - 1
    motion = {"dp3": None, "fdp": laid_out(flow, layout), "mba": pose}[name]
    answer(policy, monkeypatch, action, motion)
    plan = policy.plan(batch, generator())
    wanted = action * torch.tensor(NORMALIZER.action.unit) + torch.tensor(NORMALIZER.action.offset)
    wanted[..., :3] += gripper[:, None]
    torch.testing.assert_close(plan.action, wanted)
    if plan.flow is not None:
        torch.testing.assert_close(plan.flow, 0.02 * flow)
    if plan.object_pose is not None:
        torch.testing.assert_close(plan.object_pose[..., 3:], pose[..., 3:])
        position = pose[..., :3] * 0.5 + torch.tensor(NORMALIZER.position.offset) + gripper[:, None]
        torch.testing.assert_close(plan.object_pose[..., :3], position)


@EVERY_VARIANT
def test_plans_stay_within_the_limits(name: str, network: str, layout: str, monkeypatch: pytest.MonkeyPatch) -> None:
    policy, batch = variant(name, network, layout)
    shape = {"dp3": (1,), "mba": (HORIZON, 9), "fdp": laid_out(torch.zeros(1, HORIZON, M, 3), layout).shape[1:]}[name]
    answer(
        policy,
        monkeypatch,
        torch.full((25, HORIZON, A), 7.0),
        torch.full((25, *shape), -7.0) if hasattr(policy, "motion") else None,
    )
    plan = policy.plan(batch, generator())
    scale = NORMALIZER.action
    highest = torch.tensor(scale.unit) + torch.tensor(scale.offset)
    torch.testing.assert_close(plan.action, highest.expand(25, HORIZON, A))
    if plan.flow is not None:
        torch.testing.assert_close(plan.flow, torch.full((25, HORIZON, M, 3), -NORMALIZER.flow_clip * 0.02))


@pytest.mark.parametrize("layout", ["channels", "per-query"])
def test_no_motion_is_zero_there_and_back(layout: str, monkeypatch: pytest.MonkeyPatch) -> None:
    policy, batch = make("fdp", f"motion.flow_representation={layout}")
    truth = policy.motion.pack(policy.motion_target(replace(batch, flow=torch.zeros_like(batch.flow)), None)[0])
    assert (truth == 0).all()
    answer(policy, monkeypatch, torch.zeros(25, HORIZON, A), torch.zeros_like(truth))
    assert (policy.plan(batch, generator()).flow == 0).all()


@MOTIONS
def test_a_demonstration_is_given_back_as_it_was(name: str, layout: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """What the networks are taught, given back as their answer, is the plan that was demonstrated."""
    policy, batch = make(name, *motion_settings(name, layout), "encoder.relative=true", places=HAND)
    gripper = policy.gripper(batch)
    truth = policy.motion.pack(policy.motion_target(batch, gripper)[0])
    # Beyond the limits, a plan would be clipped.
    action = policy.normalize_action(batch.action, gripper)
    assert policy.spec.channels.action_position is not None
    answer(policy, monkeypatch, action.clamp(-1, 1), truth.clamp(-2, 2))
    plan = policy.plan(batch, generator())
    inside = (action.abs() <= 1).all(-1)
    assert inside.float().mean() > 0.4
    torch.testing.assert_close(plan.action[inside], batch.action[inside])
    if name == "fdp":
        assert plan.flow is not None
        small = batch.flow.abs() < 2 * 0.02
        torch.testing.assert_close(plan.flow[small], batch.flow[small])
    else:
        assert plan.object_pose is not None
        inside = (truth.abs() <= 2).all(-1)
        torch.testing.assert_close(plan.object_pose[inside], batch.object_pose[inside])


# Frames of reference.


def shifted(batch: Batch, by: Tensor) -> Batch:
    """The same scene elsewhere: everything that has a place in :data:`HAND`."""
    changes = {}
    for name, places in {"state": [0, 3], "action": [0], "object_pose": [0], "points": [0], "queries": [0]}.items():
        values = getattr(batch, name).clone()
        for k in places if values.shape[-1] else ():
            values[..., k : k + 3] += by
        changes[name] = values
    return replace(batch, **changes)


def networks_see(policy: Any, batch: Batch) -> dict[str, Tensor]:
    """What enters the networks of a policy in training."""
    seen: dict[str, Tensor] = {}
    hooks = [
        policy.encoder.cloud.register_forward_pre_hook(lambda _, x: seen.update(cloud=x[0])),
        policy.encoder.state.register_forward_pre_hook(lambda _, x: seen.update(state=x[0])),
    ]
    if hasattr(policy, "query_encoder"):
        hooks.append(policy.query_encoder.register_forward_pre_hook(lambda _, x: seen.update(queries=x[1])))
    gripper = policy.gripper(batch)
    if hasattr(policy, "motion"):
        seen["motion"] = policy.motion.pack(policy.motion_target(batch, gripper)[0])
    seen["action"] = policy.normalize_action(batch.action, gripper)
    policy(batch, sampler(), 25)
    for hook in hooks:
        hook.remove()
    return seen


@MOTIONS
def test_relative_to_the_gripper_a_scene_looks_the_same_elsewhere(name: str, layout: str) -> None:
    policy, batch = make(name, *motion_settings(name, layout), "encoder.relative=true", places=HAND)
    here, there = (networks_see(policy, b) for b in (batch, shifted(batch, torch.tensor([0.3, -0.2, 0.1]))))
    assert here.keys() == there.keys()
    for key in here.keys() - {"state"}:
        torch.testing.assert_close(there[key], here[key], rtol=1e-4, atol=1e-5, msg=key)
    moved = (there["state"] - here["state"]) * torch.tensor(NORMALIZER.state.unit)
    wanted = torch.tensor([0.3, -0.2, 0.1, 0.3, -0.2, 0.1, 0, 0, 0])
    torch.testing.assert_close(moved, wanted.expand_as(moved), rtol=1e-4, atol=1e-5)


@MOTIONS
def test_in_the_world_a_scene_looks_different_elsewhere(name: str, layout: str) -> None:
    for changes in ({"places": HAND}, {}):
        relative = "false" if changes else "true"  # which needs a layout that has a gripper
        policy, batch = make(name, *motion_settings(name, layout), f"encoder.relative={relative}", **changes)
        assert not policy.relative
        by = torch.tensor([0.3, -0.2, 0.1])
        here, there = (networks_see(policy, b) for b in (batch, shifted(batch, by)))
        keys = ["cloud", *(["queries"] if name == "fdp" else [])]
        torch.testing.assert_close(here["cloud"], scaled(batch.points, NORMALIZER.position))
        for key in keys:
            moved = (there[key] - here[key]) * 0.5
            torch.testing.assert_close(moved, by.expand_as(moved), rtol=1e-4, atol=1e-5)


def test_clouds_are_seen_from_the_gripper_of_their_frame_and_queries_from_that_of_now() -> None:
    policy, batch = make("fdp", "encoder.relative=true", places=ChannelSpec(gripper=(3, 4, 5)))
    seen = networks_see(policy, batch)
    for f in range(len(batch.points)):
        wanted = scaled(batch.points[f] - batch.state[f, 3:6], NORMALIZER.position)
        torch.testing.assert_close(seen["cloud"][f], wanted)
    for w in range(25):
        now = batch.observed[w, HISTORY - 1]
        wanted = scaled(batch.queries[w] - batch.state[now, 3:6], NORMALIZER.position)
        torch.testing.assert_close(seen["queries"][w], wanted)
    torch.testing.assert_close(seen["action"], scaled(batch.action, NORMALIZER.action), msg="no place is known there")


@MOTIONS
def test_plans_move_with_the_scene(name: str, layout: str) -> None:
    """With a policy that does not look at the absolute state, nothing but the scene's place is different."""
    policy, batch = make(name, *motion_settings(name, layout), "encoder.relative=true", places=HAND)
    with torch.no_grad():
        policy.encoder.state[-1].weight.zero_()
    by = torch.tensor([0.3, -0.2, 0.1])
    here, there = (policy.plan(b, generator()) for b in (batch, shifted(batch, by)))
    close = {"rtol": 1e-3, "atol": 1e-4}
    torch.testing.assert_close(there.action[..., :3], here.action[..., :3] + by, **close)
    torch.testing.assert_close(there.action[..., 3:], here.action[..., 3:], **close)
    if name == "fdp":
        torch.testing.assert_close(there.flow, here.flow, **close)
    else:
        torch.testing.assert_close(there.object_pose[..., :3], here.object_pose[..., :3] + by, **close)
        torch.testing.assert_close(there.object_pose[..., 3:], here.object_pose[..., 3:], **close)


# The observation.


def test_every_frame_of_the_history_matters_in_its_order() -> None:
    policy, batch = make("dp3")
    points = policy.normalize_clouds(batch.points, batch.state)
    whole = policy.encoder(batch, points)
    assert whole.shape == (25, policy.encoder.features) == (25, HISTORY * (8 + 8) + 32)
    swapped = policy.encoder(replace(batch, observed=batch.observed.flip(1)), points)
    torch.testing.assert_close(swapped[:, :16], whole[:, 16:32])
    torch.testing.assert_close(swapped[:, 16:32], whole[:, :16])
    one, state = batch.observed[7, 0], scaled(batch.state, NORMALIZER.state)
    torch.testing.assert_close(whole[7, :8], policy.encoder.cloud(points[one, None])[0])
    torch.testing.assert_close(whole[7, 8:16], policy.encoder.state(state[one]))


def test_a_frame_that_windows_share_counts_as_if_each_had_its_own() -> None:
    policy, batch = make("fdp", "encoder.relative=true", places=HAND)
    assert len(batch.points) < batch.observed.numel()
    own = torch.arange(batch.observed.numel()).view_as(batch.observed)
    frame = batch.observed.flatten()
    unshared = replace(batch, points=batch.points[frame], state=batch.state[frame], observed=own)
    torch.testing.assert_close(policy(unshared, sampler(), 25).total, policy(batch, sampler(), 25).total)


@EVERY_VARIANT
def test_tasks_are_told_apart_where_there_are_several(name: str, network: str, layout: str) -> None:
    policy, batch = variant(name, network, layout)
    assert set(batch.task.tolist()) == {0, 1}
    plan = policy.plan(batch, generator())
    other = policy.plan(replace(batch, task=1 - batch.task), generator())
    assert (plan.action - other.action).abs().amax((1, 2)).min() > 1e-5
    alone = make_policy(tiny_spec(policy.spec.settings, tasks=("roll",)))
    assert alone.encoder.task is None
    assert alone.encoder.features == policy.encoder.features - 32
    same, swapped = (alone.plan(b, generator()).action for b in (batch, replace(batch, task=1 - batch.task)))
    assert torch.equal(same, swapped)


def test_a_robot_without_a_state_is_seen_by_its_points_alone() -> None:
    scale = NORMALIZER.state.model_copy(update={"offset": (), "unit": ()})
    normalizer = NORMALIZER.model_copy(update={"state": scale})
    policy, batch = make("dp3", state_width=0, normalizer=normalizer)
    blind = replace(batch, state=batch.state[:, :0])
    policy(blind, sampler(), 25).total.backward()
    assert policy.encoder.features == HISTORY * 8 + 32
    assert policy.plan(blind, generator()).action.shape == (25, HORIZON, A)


@MOTIONS
def test_the_action_knows_the_predicted_motion_unless_it_is_auxiliary(
    name: str, layout: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for condition, told in (("clean", True), ("auxiliary", False)):
        policy, batch = make(name, *motion_settings(name, layout), f"motion.condition={condition}")
        shape = policy.motion.pack(policy.motion_target(batch, None)[0]).shape
        actions = []
        for value in (-0.5, 0.5):
            monkeypatch.setattr(policy.motion, "denoise", lambda *_, v=torch.full(shape, value): v)
            actions.append(policy.plan(batch, generator()).action)
        assert torch.equal(*actions) != told
