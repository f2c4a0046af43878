"""What the policies that denoise actions on point clouds have in common."""

from abc import abstractmethod
from collections.abc import Callable, Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from flowlab.data.batches import Batch, ObservationBatch
from flowlab.data.scaler import Scaler
from flowlab.nets.denoiser import make_denoiser
from flowlab.nets.diffusion import Diffusion, NoiseSampler
from flowlab.nets.motion import MotionHead, MotionLoss
from flowlab.nets.settings import MotionSettings
from flowlab.policies.base import ActionPlan, Generators, Losses, PolicyNetwork
from flowlab.policies.observation_encoder import ObservationEncoder
from flowlab.policies.settings import DiffusionPolicySettings
from flowlab.policies.spec import PolicySpec


class DiffusionPolicy(PolicyNetwork):
    """An encoder for what is seen, and a network that denoises actions conditioned on it."""

    def __init__(self, spec: PolicySpec) -> None:
        super().__init__(spec)
        s, n = spec.settings, spec.normalizer
        assert isinstance(s, DiffusionPolicySettings)
        self.diffusion = Diffusion(s.diffusion.train_steps, s.diffusion.inference_steps, s.diffusion.loss)
        self.position_scale, self.action_scale = Scaler(n.position), Scaler(n.action)
        self.encoder = ObservationEncoder(spec, s.encoder)
        condition = self.encoder.features + self.make_motion(spec, self.encoder.features)
        self.action = make_denoiser(s.action, s.horizon, spec.action_width, condition, s.diffusion.train_steps)

    def make_motion(self, spec: PolicySpec, condition: int) -> int:
        """Make what predicts a motion before the action; how long a vector it adds to what the action is conditioned
        on. Networks are made in this order, so that a seed always gives the same weights."""
        return 0

    def motion_loss(
        self,
        batch: Batch,
        condition: Float[Tensor, "W D"],
        gripper: Float[Tensor, "W 3"] | None,
        noise: NoiseSampler,
        windows: int,
    ) -> MotionLoss | None:
        """The loss of a predicted motion; None where none is predicted."""
        return None

    def predict_motion(
        self,
        context: ObservationBatch,
        condition: Float[Tensor, "W D"],
        gripper: Float[Tensor, "W 3"] | None,
        draw: Callable[..., Tensor],
    ) -> tuple[Tensor, Tensor | None] | None:
        """A motion, in normalized units, and its summary; None where none is predicted. ``draw`` gives noise of a
        shape for every window."""
        return None

    def describe_motion(self, motion: Tensor, gripper: Float[Tensor, "W 3"] | None) -> dict[str, Tensor]:
        """A predicted motion in the dataset's units, by its name in an :class:`~flowlab.policies.base.ActionPlan`."""
        raise NotImplementedError

    def compute_loss(self, batch: Batch, noise: NoiseSampler, windows: int) -> Losses:
        """See :class:`~flowlab.policies.base.PolicyNetwork`."""
        s = self.spec.settings
        gripper = self.gripper(batch)
        condition = self.encoder(batch, self.normalize_clouds(batch.points, batch.state))
        motion = self.motion_loss(batch, condition, gripper, noise, windows)
        if motion is not None and motion.summary is not None:
            condition = torch.cat([condition, motion.summary], -1)
        target = self.normalize_action(batch.action, gripper)
        step = noise.steps(self.diffusion.train_steps, windows, s.batch.draws)
        drawn = noise.normal(windows, s.batch.draws, *target.shape[1:])
        target = target[:, None].expand_as(drawn)
        noised = self.diffusion.noised(target, drawn, step)
        denoised = self.action.denoise(noised.flatten(0, 1), self.action.terms(condition, step)).view(drawn.shape)
        weight = (batch.action_weight[..., None] * batch.action_confidence)[:, None]
        loss = (self.diffusion.distance(denoised, target) * weight).mean()
        if motion is None:
            return Losses(loss, {"action": loss})
        return Losses(loss + self.motion_weight * motion.loss, {"action": loss, "motion": motion.loss})

    @property
    def motion_weight(self) -> float:
        """Of the motion's loss; the action's has 1."""
        return 0.0

    @torch.no_grad()
    def plan(self, context: ObservationBatch, generators: Generators = None) -> ActionPlan:
        """See :class:`~flowlab.policies.base.PolicyNetwork`."""
        s = self.spec.settings
        windows, device = len(context.observed), context.points.device
        gripper = self.gripper(context)
        condition = self.encoder(context, self.normalize_clouds(context.points, context.state))

        def draw(*shape: int) -> Tensor:
            if not isinstance(generators, Sequence):
                return torch.randn(windows, *shape, generator=generators).to(device)
            return torch.stack([torch.randn(shape, generator=g) for g in generators]).to(device)

        motion = self.predict_motion(context, condition, gripper, draw)
        if motion is not None and motion[1] is not None:
            condition = torch.cat([condition, motion[1]], -1)
        step = torch.tensor(self.diffusion.steps, device=device).expand(windows, -1)
        terms = self.action.terms(condition, step)

        def denoise(x: Tensor, k: int) -> Tensor:
            return self.action.denoise(x, [t[:, k : k + 1] for t in terms])

        normal = self.diffusion.sample(denoise, draw(s.horizon, self.spec.action_width), 1.0)
        action = self.action_scale.invert(normal)
        if gripper is not None and self.spec.channels.action_position is not None:
            action[..., self.spec.channels.action_position] += gripper[:, None]
        return ActionPlan(action, **({} if motion is None else self.describe_motion(motion[0], gripper)))

    def parameter_groups(self) -> dict[str, list[nn.Module]]:
        """As in the paper: the encoder, which the others share, and each network."""
        return {"encoder": [self.encoder], "action": [self.action]}

    @property
    def relative(self) -> bool:
        """Whether coordinates are given relative to the gripper."""
        return self.spec.settings.relative_to_gripper and self.spec.channels.gripper is not None

    def gripper(self, context: ObservationBatch) -> Float[Tensor, "W 3"] | None:
        """Where the gripper is now, in each window [m]; None where the policy does not work relative to it."""
        if not self.relative:
            return None
        return context.state[context.observed[:, -1]][:, self.spec.channels.gripper]

    def normalize_clouds(self, points: Float[Tensor, "F N 3"], state: Float[Tensor, "F S"]) -> Float[Tensor, "F N 3"]:
        """Clouds in normalized coordinates, relative to the gripper of the same frame where wanted."""
        return self.position_scale(points - state[:, None, self.spec.channels.gripper] if self.relative else points)

    def normalize_action(
        self, action: Float[Tensor, "W T A"], gripper: Float[Tensor, "W 3"] | None
    ) -> Float[Tensor, "W T A"]:
        """Actions in normalized units, positions relative to the gripper where wanted."""
        if gripper is not None and self.spec.channels.action_position is not None:
            action = action.clone()
            action[..., self.spec.channels.action_position] -= gripper[:, None]
        return self.action_scale(action)


class MotionPolicy(DiffusionPolicy):
    """A diffusion policy that predicts a motion first, which its action is then conditioned on."""

    motion: MotionHead
    motion_settings: MotionSettings

    @abstractmethod
    def motion_target(self, batch: Batch, gripper: Float[Tensor, "W 3"] | None) -> tuple[Tensor, Tensor]:
        """The demonstrated motion (W, T, ...) in normalized units, and how much each number of it counts."""

    def encode_queries(
        self, context: ObservationBatch, gripper: Float[Tensor, "W 3"] | None
    ) -> Float[Tensor, "W M features"] | None:
        """A vector for each query point; None where the motion is not that of points."""
        return None

    @property
    def motion_weight(self) -> float:
        """As the settings say."""
        return self.motion_settings.weight

    def motion_loss(
        self,
        batch: Batch,
        condition: Float[Tensor, "W D"],
        gripper: Float[Tensor, "W 3"] | None,
        noise: NoiseSampler,
        windows: int,
    ) -> MotionLoss:
        """See :class:`DiffusionPolicy`."""
        target, weight = self.motion_target(batch, gripper)
        target, weight = self.motion.pack(target), self.motion.pack(weight)
        queries = self.encode_queries(batch, gripper)
        return self.motion.compute_loss(target, weight, condition, queries, noise, windows)

    def predict_motion(
        self,
        context: ObservationBatch,
        condition: Float[Tensor, "W D"],
        gripper: Float[Tensor, "W 3"] | None,
        draw: Callable[..., Tensor],
    ) -> tuple[Tensor, Tensor | None]:
        """See :class:`DiffusionPolicy`."""
        shape = self.motion.sample_shape(context.queries.shape[1])
        packed, summary = self.motion.predict(draw(*shape), condition, self.encode_queries(context, gripper))
        return self.motion.unpack(packed), summary
