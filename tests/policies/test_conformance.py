"""The policies keep what a policy promises, and the checks find one that does not."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from flowlab.data.batches import Batch, ObservationBatch
from flowlab.data.needs import Needs
from flowlab.data.training_settings import BatchSettings, TrainSettings
from flowlab.nets.diffusion import NoiseSampler
from flowlab.policies.base import ActionPlan, Generators, Losses, PolicyNetwork, PolicySpec
from flowlab.policies.dp3 import DP3
from flowlab.policies.fdp import FDP
from flowlab.policies.mba import MBA
from flowlab.testing.policies import CHECKS, check_policy

CLOUDS = (
    "horizon=8", "n_action_steps=4", "encoder.points=32", "encoder.subset=null", "encoder.widths=[16]",
    "encoder.features=16", "encoder.state_widths=[16]", "action.widths=[32]", "action.step_embedding=8",
)  # fmt: skip
MOTION = (*CLOUDS, "motion.features=16", "motion.denoiser.widths=[32]", "motion.denoiser.step_embedding=8")
FLOW = (*MOTION, "motion.points=6", "motion.subset=null")
UNET = ("motion.flow_representation=channels", "motion.denoiser.kind=unet", "action.kind=unet")
KINDS: dict[str, tuple[type[PolicyNetwork], tuple[str, ...]]] = {
    "dp3": (DP3, CLOUDS),
    "mba": (MBA, MOTION),
    "fdp": (FDP, FLOW),
    "fdp of channels": (FDP, (*FLOW, *UNET)),
}


@pytest.mark.parametrize("check", CHECKS, ids=lambda c: c.__name__)
@pytest.mark.parametrize("kind", ["dp3", "fdp", pytest.param("mba", marks=pytest.mark.slow), "fdp of channels"])
def test_policies_keep_their_promises(kind: str, check: Callable[..., None]) -> None:
    check(*KINDS[kind])


class StillSettings(BatchSettings):
    """Pictures cannot be moved."""

    shift_m: float = 0.0
    turn_deg: float = 0.0


class PlainSettings(TrainSettings):
    """Of a policy on depth pictures."""

    batch: BatchSettings = StillSettings()
    width: int = 16

    @property
    def needs(self) -> Needs:
        return Needs(depth=True)


class Plain(PolicyNetwork):
    """Linear layers on the mean depth of each row of the picture and on the state: the least that a policy can be."""

    title = "Plain"
    settings_class = PlainSettings

    def __init__(self, spec: PolicySpec) -> None:
        super().__init__(spec)
        s = spec.settings
        assert isinstance(s, PlainSettings)
        self.first = nn.Linear(s.n_obs_steps * (32 + spec.state_width), s.width)
        self.last = nn.Linear(s.width, s.horizon * spec.action_width)

    def predict(self, context: ObservationBatch) -> Tensor:
        assert context.depth is not None
        seen = torch.cat([context.depth.mean(-1), context.state], -1)[context.observed].flatten(1)
        return self.last(self.first(seen).relu()).view(len(seen), -1, self.spec.action_width)

    def compute_loss(self, batch: Batch, noise: NoiseSampler, windows: int) -> Losses:
        loss = ((self.predict(batch) - batch.action).abs() * batch.action_weight[..., None]).mean()
        return Losses(loss, {"action": loss})

    @torch.no_grad()
    def plan(self, context: ObservationBatch, generators: Generators = None) -> ActionPlan:
        return ActionPlan(self.predict(context))


def test_the_least_that_a_policy_can_be_is_one() -> None:
    check_policy(Plain)


class NoTitle(Plain):
    title = None  # type: ignore[assignment]


class EmptyTitle(Plain):
    title = ""


class RequiredSettings(PlainSettings):
    depth_width: int


class Required(Plain):
    settings_class = RequiredSettings


class OwnNoise(Plain):
    def compute_loss(self, batch: Batch, noise: NoiseSampler, windows: int) -> Losses:
        losses = super().compute_loss(batch, noise, windows)
        return replace(losses, total=losses.total + torch.rand(()))


class Summed(Plain):
    def compute_loss(self, batch: Batch, noise: NoiseSampler, windows: int) -> Losses:
        losses = super().compute_loss(batch, noise, windows)
        return replace(losses, total=losses.total * len(batch.observed))


class Idle(Plain):
    def __init__(self, spec: PolicySpec) -> None:
        super().__init__(spec)
        self.idle = nn.Linear(2, 2)


class Forgotten(Plain):
    def parameter_groups(self) -> dict[str, list[nn.Module]]:
        return {"last": [self.last]}


class Stubborn(Plain):
    def compute_loss(self, batch: Batch, noise: NoiseSampler, windows: int) -> Losses:
        losses = super().compute_loss(batch, noise, windows)
        return replace(losses, total=5 + 1e-3 * losses.total)


class Short(Plain):
    @torch.no_grad()
    def plan(self, context: ObservationBatch, generators: Generators = None) -> ActionPlan:
        return ActionPlan(self.predict(context)[:, 1:])


class Random(Plain):
    @torch.no_grad()
    def plan(self, context: ObservationBatch, generators: Generators = None) -> ActionPlan:
        action = self.predict(context)
        return ActionPlan(action + torch.rand_like(action))


class Mixing(Plain):
    @torch.no_grad()
    def plan(self, context: ObservationBatch, generators: Generators = None) -> ActionPlan:
        action = self.predict(context)
        return ActionPlan(action - action.mean(0))


class Remembering(Plain):
    def __init__(self, spec: PolicySpec) -> None:
        super().__init__(spec)
        self.offset = torch.rand(1)

    def predict(self, context: ObservationBatch) -> Tensor:
        return super().predict(context) + self.offset


class Greedy(Plain):
    def predict(self, context: ObservationBatch) -> Tensor:
        return super().predict(context) + context.points.sum()


BROKEN: Mapping[str, tuple[Any, str]] = {
    "no title": (NoTitle, "title must be what people call the policy"),
    "an empty title": (EmptyTitle, "title must be what people call the policy, but is ''"),
    "no network": (
        PlainSettings,
        "a policy must be a class of flowlab.policies.base.PolicyNetwork, and <class .* is none",
    ),
    "no class": (Needs(), "a policy must be a class of flowlab.policies.base.PolicyNetwork"),
    "a setting without a default": (Required, "every setting must have a default, and depth_width has none"),
    "noise of its own": (OwnNoise, "draw noise from what compute_loss is given only"),
    "a sum over windows": (Summed, "the mean of the losses of two halves"),
    "weights that nothing teaches": (Idle, "idle.weight gets no gradient"),
    "weights without an optimizer": (Forgotten, "first.weight must be in one parameter group, but is in 0"),
    "a loss that rises": (Stubborn, "the loss must fall by a tenth"),
    "a short plan": (Short, r"action must have shape \(\d+, 16, 4\)"),
    "a random plan": (Random, "a plan must be a function of the state of its generator"),
    "windows that see each other": (Mixing, "must not depend on the windows beside it"),
    "a secret": (Remembering, "a network with the same spec and state_dict must plan the same"),
    "a need that it does not tell": (Greedy, "its plans depend on arrays that settings.needs does not name"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_broken_promise_is_named(case: str) -> None:
    policy, sentence = BROKEN[case]
    with pytest.raises(AssertionError, match=sentence):
        check_policy(policy)
