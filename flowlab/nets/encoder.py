"""From an observation to a vector: a PointNet for the cloud, a small network for the robot's state."""

import math
from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

from flowlab.nets.max_pooling import PointLayers


class PointNet(nn.Module):
    """Per-point layers, a maximum over the points, and a projection (DP3's encoder).

    Source: PointNetEncoderXYZ of 3D Diffusion Policy; with ``octaves``, coordinates also enter as sines and cosines.
    """

    def __init__(self, widths: Sequence[int], features: int, octaves: int) -> None:
        super().__init__()
        self.octaves = octaves
        self.point_width = widths[-1]
        """Length of a point's own vector."""
        inputs = [3 + 6 * octaves, *widths[:-1]]
        self.layers = nn.ModuleList(nn.Linear(i, o) for i, o in zip(inputs, widths, strict=True))
        self.norms = nn.ModuleList(nn.LayerNorm(o) for o in widths)
        self.project = nn.Linear(widths[-1], features)
        self.norm = nn.LayerNorm(features)

    def encode_points(self, xyz: Tensor) -> Tensor:
        """Every point's own vector: (..., 3) -> (..., C)."""
        return functional.relu(self.norms[-1](self.layers[-1](self._before_last(xyz))), inplace=True)

    def forward(self, points: Tensor) -> Tensor:
        """The vector of each cloud: (B, N, 3) -> (B, features)."""
        every = (p for m in (*self.layers[:-1], *self.norms[:-1]) for p in m.parameters())
        learned = tuple(p for p in every if p.requires_grad)
        last, norm = self.layers[-1], self.norms[-1]
        assert isinstance(last, nn.Linear)
        assert isinstance(norm, nn.LayerNorm)
        layers = PointLayers(self._before_last, learned, last, norm)
        return self.norm(self.project(layers.maximum(points)))

    def _before_last(self, xyz: Tensor) -> Tensor:
        """What goes into the last layer."""
        h = self._fourier(xyz)
        for layer, norm in zip(self.layers[:-1], self.norms[:-1], strict=True):
            h = functional.relu(norm(layer(h)), inplace=True)
        return h

    def _fourier(self, xyz: Tensor) -> Tensor:
        if not self.octaves:
            return xyz
        waves = [math.pi * 2.0**k * xyz for k in range(self.octaves)]
        return torch.cat([xyz, *(f(w) for w in waves for f in (torch.sin, torch.cos))], -1)


def linear_layers(widths: Sequence[int]) -> nn.Sequential:
    """Linear layers with ReLU between them."""
    parts: list[nn.Module] = []
    for i, o in pairwise(widths):
        parts += [nn.Linear(i, o), nn.ReLU()]
    return nn.Sequential(*parts[:-1])
