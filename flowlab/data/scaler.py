"""Scales of a dataset as a part of a network."""

import torch
from torch import Tensor, nn

from flowlab.data.normalizer import Scale


class Scaler(nn.Module):
    """A :class:`Scale` that follows its network from device to device; its numbers are kept with the settings."""

    offset: Tensor
    unit: Tensor

    def __init__(self, scale: Scale) -> None:
        super().__init__()
        self.register_buffer("offset", torch.tensor(scale.offset), persistent=False)
        self.register_buffer("unit", torch.tensor(scale.unit), persistent=False)

    def forward(self, values: Tensor) -> Tensor:
        """Normalize."""
        return (values - self.offset) / self.unit

    def invert(self, normal: Tensor) -> Tensor:
        """Back to the dataset's units."""
        return normal * self.unit + self.offset
