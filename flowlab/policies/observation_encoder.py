"""What a window shows, as one vector."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from flowlab.data.batches import ObservationBatch
from flowlab.data.scaler import Scaler
from flowlab.nets.encoder import PointNet, linear_layers
from flowlab.nets.settings import EncoderSettings
from flowlab.policies.spec import PolicySpec

_TASK_FEATURES = 32


class ObservationEncoder(nn.Module):
    """Cloud and state of each frame of a window, and the task where there are many, as one vector."""

    def __init__(self, spec: PolicySpec, settings: EncoderSettings) -> None:
        super().__init__()
        self.cloud = PointNet(settings.widths, settings.features, settings.octaves)
        self.scale = Scaler(spec.normalizer.state)
        self.state = linear_layers([spec.state_width, *settings.state_widths]) if spec.state_width else None
        self.task = nn.Embedding(len(spec.tasks), _TASK_FEATURES) if len(spec.tasks) > 1 else None
        of_frame = settings.features + (settings.state_widths[-1] if spec.state_width else 0)
        self.features = spec.settings.n_obs_steps * of_frame + (_TASK_FEATURES if self.task else 0)
        """Length of the vector."""

    def forward(self, context: ObservationBatch, points: Float[Tensor, "F N 3"]) -> Float[Tensor, "W features"]:
        """The vector of every window of a context, whose clouds are given in normalized coordinates."""
        of_frame = self.cloud(points)
        if self.state is not None:
            of_frame = torch.cat([of_frame, self.state(self.scale(context.state))], -1)
        whole = of_frame[context.observed].flatten(1)
        return whole if self.task is None else torch.cat([whole, self.task(context.task)], -1)
