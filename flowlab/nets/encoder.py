"""From an observation to a vector: a PointNet for the cloud, a small network for the robot's state."""

import math
from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

_ROWS = 2048
"""Points that go through the network at once where no gradient is wanted: what fits the cache of one core."""
_BLOCK = 32


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
        h = self._fourier(xyz)
        for layer, norm in zip(self.layers, self.norms, strict=True):
            h = functional.relu(norm(layer(h)), inplace=True)
        return h

    def forward(self, points: Tensor) -> Tensor:
        """The vector of each cloud: (B, N, 3) -> (B, features).

        Only points that are greatest in some channel matter to the maximum and get a gradient. They are found
        without one, and go through the network again: the same result and gradient for a fraction of the work.
        """
        greatest, where = self._maximum(points)
        if torch.is_grad_enabled():
            clouds, size, _ = points.shape
            row = where + size * torch.arange(clouds, device=points.device)[:, None]  # (B, C)
            wanted = torch.zeros(clouds * size, dtype=torch.bool, device=points.device)
            wanted[row.reshape(-1)] = True
            position = torch.cumsum(wanted, 0) - 1
            chosen = wanted.nonzero()[:, 0]
            # Few different sizes, so that memory and kernels made for one step serve the next; row 0 fills up, unused.
            chosen = functional.pad(chosen, (0, -len(chosen) % _ROWS))
            critical = self.encode_points(points.reshape(-1, 3)[chosen])
            greatest = critical.gather(0, position[row])
        return self.norm(self.project(greatest))

    def _maximum(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Maximum over each cloud's points and which point has it: two of (B, C)."""
        at_once = max(1, _ROWS // points.shape[1]) if points.device.type == "cpu" else len(points)
        kind = points.device.type
        dtype, enabled = torch.get_autocast_dtype(kind), torch.is_autocast_enabled(kind)
        # Older PyTorch hands on weights that were cast here, without a gradient, to the pass that needs one.
        with torch.no_grad(), torch.autocast(kind, dtype, enabled, cache_enabled=False):
            both = [_greatest(self.encode_points(chunk)) for chunk in torch.split(points, at_once)]
        return torch.cat([values for values, _ in both]), torch.cat([where for _, where in both])

    def _fourier(self, xyz: Tensor) -> Tensor:
        if not self.octaves:
            return xyz
        waves = [math.pi * 2.0**k * xyz for k in range(self.octaves)]
        return torch.cat([xyz, *(f(w) for w in waves for f in (torch.sin, torch.cos))], -1)


def _greatest(h: Tensor) -> tuple[Tensor, Tensor]:
    """``h.max(1)`` for (B, N, C), in a fourth of its time: which block of rows has it, then which row of that."""
    clouds, rows, channels = h.shape
    if rows % _BLOCK:
        values, where = h.max(1)
        return values, where
    blocks = h.view(clouds, -1, _BLOCK, channels)
    values, block = blocks.amax(2).max(1)
    inside = blocks.gather(1, block[:, None, None].expand(-1, -1, _BLOCK, -1))[:, 0].max(1).indices
    return values, block * _BLOCK + inside


def linear_layers(widths: Sequence[int]) -> nn.Sequential:
    """Linear layers with ReLU between them."""
    parts: list[nn.Module] = []
    for i, o in pairwise(widths):
        parts += [nn.Linear(i, o), nn.ReLU()]
    return nn.Sequential(*parts[:-1])
