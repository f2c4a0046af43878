"""The policies: one encoder, one family of denoisers; 3D FDP and MBA predict a motion before the action."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from flowlab.config import Settings
from flowlab.data.batches import Batch, ObservationBatch
from flowlab.data.channels import ChannelSpec
from flowlab.data.normalizer import Normalizer, Scaler
from flowlab.nets.denoiser import make_denoiser
from flowlab.nets.diffusion import Diffusion, NoiseSampler
from flowlab.nets.encoder import PointNet, layers
from flowlab.nets.motion import MotionHead, PointMotionHead, QueryEncoder, SequenceMotionHead
from flowlab.policies.settings import TrainSettings

_TASK_FEATURES = 32
Generators = torch.Generator | Sequence[torch.Generator] | None
"""Where the noise of plans comes from."""


class PolicySpec(Settings):
    """Everything a policy's network is built from; with the weights, everything that is needed to use it."""

    settings: TrainSettings
    state_width: int
    action_width: int
    tasks: tuple[str, ...]
    channels: ChannelSpec
    normalizer: Normalizer
    observer: Mapping[str, Any] | None
    """Settings of the Observer that made the clouds; None where they are not known."""
    queries: Mapping[str, Any]
    """Settings of the query points, as this policy was trained with them."""


@dataclass(frozen=True, slots=True)
class Losses:
    """Of one training step."""

    total: Tensor
    action: Tensor
    motion: Tensor | None


@dataclass(frozen=True, slots=True)
class ActionPlan:
    """What a policy decides on, in the dataset's units."""

    action: Tensor
    """(W, T, A); the first to execute is that of index ``history - 1``."""
    flow: Tensor | None = None
    """(W, T, M, 3) [m]: predicted displacement of every query point during each action; 3D FDP's."""
    object_pose: Tensor | None = None
    """(W, T, 9): MBA's."""


class PolicyNetwork(nn.Module):
    """A diffusion policy on point clouds."""

    def __init__(self, spec: PolicySpec) -> None:
        super().__init__()
        s, n = spec.settings, spec.normalizer
        self.spec = spec
        self.diffusion = Diffusion(s.diffusion.train_steps, s.diffusion.inference_steps)
        self.distance = functional.l1_loss if s.diffusion.loss == "l1" else functional.mse_loss
        self.place, self.state, self.action_scale = Scaler(n.place), Scaler(n.state), Scaler(n.action)
        self.encoder = ObservationEncoder(spec)
        condition = self.encoder.features
        self.motion = self._make_motion(condition)
        self.places = QueryEncoder(self.encoder.cloud, s.motion.features) if s.policy == "fdp" else None
        whole = condition + (self.motion.features if self.motion else 0)
        self.action = make_denoiser(s.action, s.horizon, spec.action_width, whole, s.diffusion.train_steps)

    def _make_motion(self, condition: int) -> MotionHead | None:
        s, n = self.spec.settings, self.spec.normalizer
        if s.policy == "fdp":
            self.flow_scale = Scaler(n.flow)
            if s.motion.flow_representation == "per-query":
                return PointMotionHead(s, self.diffusion, n.flow_clip, condition)
            points = s.motion.points
            return SequenceMotionHead(s, self.diffusion, n.flow_clip, condition, 3 * points, points)
        return SequenceMotionHead(s, self.diffusion, 2.0, condition, 9, 0) if s.policy == "mba" else None

    def parameter_groups(self) -> dict[str, list[nn.Module]]:
        """The modules that have an optimizer of their own, as in the paper: the encoder is shared by the other two."""
        parts: dict[str, list[nn.Module]] = {"encoder": [self.encoder], "action": [self.action]}
        if self.motion is not None:
            parts["motion"] = [self.motion, *([self.places] if self.places is not None else [])]
        return parts

    def forward(self, batch: Batch, draws: NoiseSampler, windows: int) -> Losses:
        """The losses of a batch, which may be a process's part of one of so many windows."""
        s = self.spec.settings
        gripper = self._gripper(batch)
        condition = self.encoder(batch, self._relative(batch.points, batch.state))
        weight = batch.action_weight[:, None, :, None]
        motion_loss = None
        if self.motion is not None:
            truth, counts = self._true_motion(batch, gripper)
            learned = self.motion.compute_loss(truth, counts, condition, self._places(batch, gripper), draws, windows)
            motion_loss = learned.loss
            if learned.summary is not None:
                condition = torch.cat([condition, learned.summary], -1)
        truth = self._normal_action(batch.action, gripper)
        step = draws.steps(s.diffusion.train_steps, windows, s.batch.draws)
        noise = draws.normal(windows, s.batch.draws, *truth.shape[1:])
        noised = self.diffusion.noised(truth[:, None].expand_as(noise), noise, step)
        denoised = self.action.denoise(noised.flatten(0, 1), self.action.terms(condition, step)).view(noise.shape)
        action_loss = (self.distance(denoised, truth[:, None].expand_as(noise), reduction="none") * weight).mean()
        total = action_loss if motion_loss is None else action_loss + s.motion.weight * motion_loss
        return Losses(total, action_loss, motion_loss)

    @torch.no_grad()
    def plan(self, context: ObservationBatch, noise_from: Generators = None) -> ActionPlan:
        """Decide on actions for every window of a context.

        ``noise_from`` is a CPU generator, or one for each window; the noise, and so the plan, is a function of their
        states.
        """
        s = self.spec.settings
        windows, device = len(context.observed), context.points.device
        gripper = self._gripper(context)
        condition = self.encoder(context, self._relative(context.points, context.state))

        def noise(*shape: int) -> Tensor:
            if not isinstance(noise_from, Sequence):
                return torch.randn(windows, *shape, generator=noise_from).to(device)
            return torch.stack([torch.randn(shape, generator=g) for g in noise_from]).to(device)

        motion = None
        if self.motion is not None:
            shape = (s.horizon, 9)
            if self.places is not None:
                m = context.queries.shape[1]
                shape = (m, 3 * s.horizon) if s.motion.flow_representation == "per-query" else (s.horizon, 3 * m)
            motion, summary = self.motion.predict(noise(*shape), condition, self._places(context, gripper))
            if summary is not None:
                condition = torch.cat([condition, summary], -1)
        step = torch.tensor(self.diffusion.steps, device=device).expand(windows, -1)
        terms = self.action.terms(condition, step)

        def denoise(x: Tensor, k: int) -> Tensor:
            return self.action.denoise(x, [t[:, k : k + 1] for t in terms])

        normal = self.diffusion.sample(denoise, noise(s.horizon, self.spec.action_width), 1.0)
        action = self.action_scale.invert(normal)
        if gripper is not None and self.spec.channels.action_position is not None:
            action[..., self.spec.channels.action_position] += gripper[:, None]
        return ActionPlan(action, *self._in_meters(motion, gripper))

    def _gripper(self, context: ObservationBatch) -> Tensor | None:
        """Where the gripper is now, in each window (W, 3); None where the policy does not work relative to it."""
        if not self.relative:
            return None
        return context.state[context.observed[:, -1]][:, self.spec.channels.gripper]

    @property
    def relative(self) -> bool:
        """Whether coordinates are given relative to the gripper."""
        return self.spec.settings.encoder.relative and self.spec.channels.gripper is not None

    def _relative(self, points: Tensor, state: Tensor) -> Tensor:
        """Clouds (F, N, 3) in normalized coordinates, relative to the gripper of the same frame where wanted."""
        return self.place(points - state[:, None, self.spec.channels.gripper] if self.relative else points)

    def _places(self, context: ObservationBatch, gripper: Tensor | None) -> Tensor:
        if self.places is None:
            return context.queries
        xyz = context.queries if gripper is None else context.queries - gripper[:, None]
        return self.places(self.encoder.cloud, self.place(xyz))

    def _normal_action(self, action: Tensor, gripper: Tensor | None) -> Tensor:
        if gripper is not None and self.spec.channels.action_position is not None:
            action = action.clone()
            action[..., self.spec.channels.action_position] -= gripper[:, None]
        return self.action_scale(action)

    def _true_motion(self, batch: Batch, gripper: Tensor | None) -> tuple[Tensor, Tensor]:
        """The demonstrated motion, normalized and laid out as the motion network wants it, and its weights."""
        if self.places is None:
            position = batch.object_pose[..., :3] if gripper is None else batch.object_pose[..., :3] - gripper[:, None]
            pose = torch.cat([self.place(position), batch.object_pose[..., 3:]], -1)
            return pose, batch.action_weight[..., None]
        clip = self.spec.normalizer.flow_clip
        flow = self.flow_scale(batch.flow).clamp(-clip, clip)
        weight = batch.flow_weight[..., None].expand_as(flow)
        if self.spec.settings.motion.flow_representation == "per-query":
            return flow.transpose(1, 2).flatten(2), weight.transpose(1, 2).flatten(2)
        return flow.flatten(2), weight.flatten(2)

    def _in_meters(self, motion: Tensor | None, gripper: Tensor | None) -> tuple[Tensor | None, Tensor | None]:
        """Predicted flow, and predicted pose, whichever there is."""
        if motion is None:
            return None, None
        windows, horizon = len(motion), self.spec.settings.horizon
        if self.places is None:
            position = self.place.invert(motion[..., :3])
            position = position if gripper is None else position + gripper[:, None]
            return None, torch.cat([position, motion[..., 3:]], -1)
        if self.spec.settings.motion.flow_representation == "per-query":
            return self.flow_scale.invert(motion.view(windows, -1, horizon, 3).transpose(1, 2)), None
        return self.flow_scale.invert(motion.view(windows, horizon, -1, 3)), None


class ObservationEncoder(nn.Module):
    """What a window shows, as one vector: cloud and state of each of its frames, and the task where there are many."""

    def __init__(self, spec: PolicySpec) -> None:
        super().__init__()
        s = spec.settings.encoder
        self.cloud = PointNet(s.widths, s.features, s.octaves)
        self.scale = Scaler(spec.normalizer.state)
        self.state = layers([spec.state_width, *s.state_widths]) if spec.state_width else None
        self.task = nn.Embedding(len(spec.tasks), _TASK_FEATURES) if len(spec.tasks) > 1 else None
        of_frame = s.features + (s.state_widths[-1] if spec.state_width else 0)
        self.features = spec.settings.n_obs_steps * of_frame + (_TASK_FEATURES if self.task else 0)
        """Length of the vector."""

    def forward(self, context: ObservationBatch, points: Tensor) -> Tensor:
        """(W, features), from normalized clouds (F, N, 3)."""
        of_frame = self.cloud(points)
        if self.state is not None:
            of_frame = torch.cat([of_frame, self.state(self.scale(context.state))], -1)
        whole = of_frame[context.observed].flatten(1)
        return whole if self.task is None else torch.cat([whole, self.task(context.task)], -1)
