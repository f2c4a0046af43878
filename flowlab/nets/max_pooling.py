"""The maximum over the points of clouds of what a network makes of each, and its gradient at a fraction of the work."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn import functional

_AT_ONCE, _AT_ONCE_BACK = 2048, 8192
"""Points of clouds that go through the network at once on a CPU, and those of which the few that matter get their
gradient at once: what fits the caches of one core."""
_BLOCK = 32
_ROWS = 256
"""Points get their gradient in multiples of so many, so that memory and kernels made for some serve the next."""


@dataclass(frozen=True, slots=True)
class PointLayers:
    """``relu(norm(last(before(points))))``: what every point goes through."""

    before: Callable[[Float[Tensor, "*n 3"]], Float[Tensor, "*n D"]]
    learned: tuple[nn.Parameter, ...]
    """What ``before`` learns and is not frozen."""
    last: nn.Linear
    norm: nn.LayerNorm

    def maximum(self, points: Float[Tensor, "B N 3"]) -> Float[Tensor, "B C"]:
        """Over the points of every cloud.

        Only points that are greatest in some channel matter to it and get a gradient. They are found without one, and
        go through the layers again when it is asked for: the same gradient for a fraction of the work.
        """
        own = self.last.weight, self.last.bias, self.norm.weight, self.norm.bias
        pooled: Tensor = _Maximum.apply(points, self, *own, *self.learned)  # type: ignore[no-untyped-call]
        return pooled


@dataclass(frozen=True, slots=True)
class _Greatest:
    """Of some clouds the greatest ``norm(last(h))`` in every channel, and what its gradient needs."""

    value: Float[Tensor, "B C"]
    where: Int64[Tensor, "B C"]
    """Which point of the cloud has it."""
    normal: Float[Tensor, "B C"]
    """The same before it is scaled and shifted."""
    mean: Float[Tensor, "B N"]
    """Of every point's channels, before the norm."""
    rstd: Float[Tensor, "B N"]
    """One over their standard deviation."""

    @classmethod
    def of(cls, points: Float[Tensor, "B N 3"], layers: PointLayers) -> "_Greatest":
        """Those of some clouds."""
        last, norm = layers.last, layers.norm
        z = last(layers.before(points))
        y, mean, rstd = torch.native_layer_norm(z, norm.normalized_shape, norm.weight, norm.bias, norm.eps)
        value, where = _max(y)
        mean, rstd = mean[..., 0], rstd[..., 0]
        normal = (z.gather(1, where[:, None])[:, 0] - mean.gather(1, where)) * rstd.gather(1, where)
        return cls(value, where, normal, mean, rstd)

    @classmethod
    def cat(cls, parts: "Sequence[_Greatest]") -> "_Greatest":
        """Those of all clouds."""
        return cls(*(torch.cat([getattr(p, name) for p in parts]) for name in cls.__slots__))


class _Maximum(torch.autograd.Function):
    """Every channel of a cloud is one point's. What comes back through the norm of a point's C channels is therefore a
    few of them and, for the mean and the variance that all share, something of 1 and of ``last(h)`` itself. So
    products with (D, D) matrices, ``weight.T @ weight`` and a weighted ``h.T @ h``, take the place of those with the
    (points, C) gradient, which is never made.
    """

    @staticmethod
    def forward(ctx: Any, points: Tensor, layers: PointLayers, *learned: Tensor) -> Tensor:
        kind = points.device.type
        # Weights that are cast here, without a gradient, must not be handed on to what needs one.
        ctx.precision = torch.autocast(
            kind, torch.get_autocast_dtype(kind), torch.is_autocast_enabled(kind), cache_enabled=False
        )
        parts = _parts(points, _AT_ONCE_BACK)
        with ctx.precision:
            found = [_Greatest.cat([_Greatest.of(x, layers) for x in _parts(part, _AT_ONCE)]) for part in parts]
        ctx.parts, ctx.layers, ctx.found = parts, layers, found
        return torch.cat([functional.relu(f.value) for f in found])

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        each = torch.split(gradient, [len(part) for part in ctx.parts])
        with ctx.precision:
            found = [
                _gradients(*one, ctx.layers, ctx.needs_input_grad[0])
                for one in zip(ctx.parts, ctx.found, each, strict=True)
            ]
        of_points, *learned = zip(*found, strict=True)
        d_points = torch.cat(of_points) if ctx.needs_input_grad[0] else None
        return d_points, None, *(sum(parts[1:], parts[0]) for parts in learned)


def _gradients(
    points: Tensor, found: _Greatest, gradient: Tensor, layers: PointLayers, of_points: bool
) -> list[Tensor | None]:
    """Of the points, if wanted; of the last layer's weight, bias, scale and shift; of what the layers before learn."""
    chosen, row = _critical(found.where, found.value > 0, points.shape[1])
    xyz = points.detach().flatten(0, 1)[chosen].requires_grad_(of_points)
    with torch.enable_grad():
        h = layers.before(xyz)
    spread = found.mean.flatten()[chosen], found.rstd.flatten()[chosen]
    with torch.autocast(points.device.type, enabled=False):
        d_h, *own = _last_layer_gradients(h.detach(), layers, found, spread, row, gradient)
    wanted = (*layers.learned, *[xyz] * of_points)
    before = list(torch.autograd.grad(h, wanted, d_h)) if wanted else []
    d_points = None
    if of_points:
        d_points = torch.zeros_like(points).flatten(0, 1).index_add_(0, chosen, before.pop()).view(points.shape)
    return [d_points, *own, *before]


def _critical(
    where: Int64[Tensor, "B C"], alive: Bool[Tensor, "B C"], size: int
) -> tuple[Int64[Tensor, "R"], Int64[Tensor, "B C"]]:
    """Which of all points get a gradient, and which of these has the greatest of a channel, where that is alive."""
    point = where + size * torch.arange(len(where), device=where.device)[:, None]
    wanted = torch.zeros(len(where) * size, dtype=torch.bool, device=where.device)
    wanted[point[alive]] = True
    position = (torch.cumsum(wanted, 0) - 1).clamp(min=0)
    chosen = wanted.nonzero()[:, 0]
    missing = -len(chosen) % _ROWS if len(chosen) else _ROWS
    return functional.pad(chosen, (0, missing)), position[point]


def _last_layer_gradients(
    h: Float[Tensor, "R D"], layers: PointLayers, found: _Greatest, spread: tuple[Tensor, Tensor],
    row: Int64[Tensor, "B C"], gradient: Float[Tensor, "B C"],
) -> tuple[Tensor, ...]:  # fmt: skip
    """Of ``h``, weight, bias, scale and shift; ``spread``: mean and one over deviation of every row.

    Large products are made in the precision that ``h`` has, the rest in that of the weights.
    """
    weight, bias = layers.last.weight.detach(), layers.last.bias.detach()
    (mean, rstd), flat, rows, channels = spread, row.flatten(), len(h), len(weight)
    low, h = h, h.to(weight.dtype)
    g = (gradient * (found.value > 0)).to(weight.dtype)
    few = g * layers.norm.weight.detach()  # what comes back to the few channels of every row, before the norm
    m1, m2 = (h.new_zeros(rows).scatter_add_(0, flat, x.flatten()) / channels for x in (few, few * found.normal))
    few = few * rstd[row]
    of_z = rstd.square() * m2  # how much of its channels, and of 1, every row loses
    of_1 = rstd * m1 - of_z * mean
    weighted = of_z[:, None] * h
    low_weighted, shared = weighted.to(low.dtype), weighted.sum(0)
    d_weight = _gathered(row.T, h, few.T)
    d_weight -= of_1 @ h + bias[:, None] * shared + weight @ (low_weighted.T @ low).to(weight.dtype)
    d_bias = few.sum(0) - of_1.sum() - weight @ shared - bias * of_z.sum()
    d_h = _scattered(flat, rows, weight, few)
    d_h -= torch.stack([of_1, of_z], 1) @ torch.stack([weight.sum(0), bias @ weight])
    d_h -= low_weighted @ (weight.T @ weight).to(low.dtype)
    return d_h.to(low.dtype), d_weight, d_bias, (g * found.normal).sum(0), g.sum(0)


def _gathered(row: Tensor, h: Tensor, factor: Tensor) -> Tensor:
    """For every channel, the sum of rows of ``h`` times their factors: (C, B) and (R, D) -> (C, D)."""
    return functional.embedding_bag(row, h, mode="sum", per_sample_weights=factor.contiguous())


def _scattered(row: Tensor, rows: int, weight: Tensor, factor: Tensor) -> Tensor:
    """For every row, the sum of the channels' weights times factors: (C, D) and (B, C) -> (rows, D)."""
    order = row.argsort()
    begin = torch.searchsorted(row[order], torch.arange(rows, device=row.device))
    return functional.embedding_bag(
        order % len(weight), weight, begin, mode="sum", per_sample_weights=factor.flatten()[order]
    )


def _parts(points: Float[Tensor, "B N 3"], at_once: int) -> tuple[Tensor, ...]:
    """Clouds that go through the network at once."""
    return torch.split(points, max(1, at_once // points.shape[1]) if points.device.type == "cpu" else len(points))


def _max(h: Tensor) -> tuple[Tensor, Tensor]:
    """``h.max(1)`` for (B, N, C), in a fourth of its time: which block of rows has it, then which row of that."""
    clouds, rows, channels = h.shape
    if rows % _BLOCK:
        values, where = h.max(1)
        return values, where
    blocks = h.view(clouds, -1, _BLOCK, channels)
    values, block = blocks.amax(2).max(1)
    inside = blocks.gather(1, block[:, None, None].expand(-1, -1, _BLOCK, -1))[:, 0].max(1).indices
    return values, block * _BLOCK + inside
