"""A policy of one's own: behavior cloning on color pictures, with none of flowlab's clouds, flow or diffusion.

Make a dataset with color pictures (which takes OpenGL), then train, evaluate and use the policy as any other. Run this
in the folder of this file; PYTHONPATH lets every process find its module:

    export PYTHONPATH=. MUJOCO_GL=egl
    flowlab extract-sim drawer-open --episodes 20 --out data/drawer --set expert.scene.renderer=gl \\
        --set expert.scene.rgb=true --set write.rgb=true
    flowlab train data/drawer --policy pixel_bc:PixelBC --minutes 5 --out runs/pixels
    flowlab eval runs/pixels --episodes 20
    python -c "import flowlab; print(flowlab.Policy.load('runs/pixels').act)"

A package would offer it under the entry point group ``flowlab.policies``; then ``--policy pixel-bc`` is enough.
``flowlab.testing.policies`` has checks for its tests.
"""

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

from flowlab.config import Settings
from flowlab.data.batches import Batch, ObservationBatch
from flowlab.data.needs import Needs
from flowlab.data.scaler import Scaler
from flowlab.data.training_settings import BatchSettings, TrainSettings
from flowlab.nets.diffusion import NoiseSampler
from flowlab.policies.base import ActionPlan, Generators, Losses, PolicyNetwork, PolicySpec


class StillBatchSettings(BatchSettings):
    """Scenes are not moved about: a picture cannot be."""

    shift_m: float = 0.0
    turn_deg: float = 0.0


class NetworkSettings(Settings):
    """A convolutional network."""

    size: int = 64
    """Pictures are scaled to so many pixels a side."""
    channels: tuple[int, ...] = (16, 32, 64)
    """Of each convolution; each halves the picture."""
    features: int = 256
    """Length of the layer between what is seen and the actions."""


class PixelBCSettings(TrainSettings):
    """All settings of the policy: ``--set network.size=96``."""

    batch: BatchSettings = StillBatchSettings()
    network: NetworkSettings = NetworkSettings()

    @property
    def needs(self) -> Needs:
        """Color pictures; state and actions everyone gets."""
        return Needs(rgb=True)


class PixelBC(PolicyNetwork):
    """Predicts all actions of a window at once, from the color pictures and states of its frames."""

    title = "Behavior cloning on color pictures"
    settings_class = PixelBCSettings

    def __init__(self, spec: PolicySpec) -> None:
        super().__init__(spec)
        s = spec.settings
        assert isinstance(s, PixelBCSettings)
        self.size = s.network.size
        self.state_scale, self.action_scale = Scaler(spec.normalizer.state), Scaler(spec.normalizer.action)
        self.camera = convolutions((3, *s.network.channels))
        seen = s.n_obs_steps * (4 * 4 * s.network.channels[-1] + spec.state_width) + len(spec.tasks)
        self.head = nn.Sequential(
            nn.Linear(seen, s.network.features), nn.ReLU(), nn.Linear(s.network.features, s.horizon * spec.action_width)
        )

    def compute_loss(self, batch: Batch, noise: NoiseSampler, windows: int) -> Losses:
        """Mean absolute error of the normalized actions; steps that a demonstration lacks have no weight."""
        error = (self.predict(batch) - self.action_scale(batch.action)).abs()
        loss = (error * batch.action_weight[..., None]).mean()
        return Losses(loss, {"action": loss})

    @torch.no_grad()
    def plan(self, context: ObservationBatch, generators: Generators = None) -> ActionPlan:
        """There is no noise in it."""
        return ActionPlan(self.action_scale.invert(self.predict(context).clamp(-1, 1)))

    def predict(self, context: ObservationBatch) -> Tensor:
        """Normalized actions (W, T, A)."""
        assert context.rgb is not None
        pictures = context.rgb.permute(0, 3, 1, 2).float() / 255
        pictures = functional.interpolate(pictures, (self.size, self.size), mode="area")
        frames = torch.cat([self.camera(pictures), self.state_scale(context.state)], -1)
        task = functional.one_hot(context.task, len(self.spec.tasks)).float()
        seen = torch.cat([frames[context.observed].flatten(1), task], -1)
        return self.head(seen).view(len(seen), -1, self.spec.action_width)


def convolutions(channels: Sequence[int]) -> nn.Sequential:
    """From pictures (F, 3, H, W) to vectors."""
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(channels):
        layers += [nn.Conv2d(inputs, outputs, 3, stride=2, padding=1), nn.GroupNorm(4, outputs), nn.ReLU()]
    return nn.Sequential(*layers, nn.AdaptiveAvgPool2d(4), nn.Flatten())
