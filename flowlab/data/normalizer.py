"""Numbers of a dataset brought to about [-1, 1] and back."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from flowlab.config import Settings
from flowlab.data.channels import ChannelSpec
from flowlab.data.replay_buffer import ReplayBuffer
from flowlab.data.source import TrainingSource
from flowlab.policies.settings import TrainSettings

_STILL = 1e-4
"""A channel that varies less than this is only centerd, as in DP3."""


class Scale(Settings):
    """``normal = (value - offset) / unit``, channel by channel."""

    offset: tuple[float, ...]
    unit: tuple[float, ...]

    @classmethod
    def of_limits(cls, low: Sequence[float], high: Sequence[float]) -> "Scale":
        """Brings ``low`` to -1 and ``high`` to 1."""
        lo, hi = np.array(low), np.array(high)
        unit = np.where(hi - lo < _STILL, 1.0, (hi - lo) / 2)
        return cls(offset=tuple(((lo + hi) / 2).tolist()), unit=tuple(unit.tolist()))


class Normalizer(Settings):
    """The scales of a dataset. Lengths have one unit for all axes, so that shapes keep their proportions."""

    place: Scale
    """Points, and positions of the object; relative to the gripper where the policy is."""
    state: Scale
    action: Scale
    flow: Scale
    """Zero is no motion."""
    flow_clip: float
    """Normalized flow is clipped here."""


def fit_normalizer(
    source: TrainingSource, buffer: ReplayBuffer, channels: ChannelSpec, settings: TrainSettings
) -> Normalizer:
    """The normalizer of a dataset, from the statistics gathered while it was written."""
    arrays = source.statistics["arrays"]
    low, high = np.array(arrays["point_cloud"]["min"]), np.array(arrays["point_cloud"]["max"])
    center, half = (low + high) / 2, float((high - low).max() / 2)
    relative = settings.encoder.relative and channels.gripper is not None
    action = arrays["action"]["min"], arrays["action"]["max"]
    if relative and channels.action_position is not None:
        action = _relative_limits(buffer, channels, settings)
    scale = Scale.of_limits(*action)
    if settings.batch.turn_deg and channels.action_displacement is not None:
        scale = _alike_in_all_directions(scale, action, channels.action_displacement)
    flow_unit, flow_clip = _flow_scale(source.statistics, settings)
    return Normalizer(
        place=Scale(offset=(0.0,) * 3 if relative else tuple(center.tolist()), unit=(half,) * 3),
        state=Scale.of_limits(arrays["state"]["min"], arrays["state"]["max"]),
        action=scale,
        flow=Scale(offset=(0.0,) * 3, unit=(flow_unit,) * 3),
        flow_clip=flow_clip,
    )


def _alike_in_all_directions(
    scale: Scale, limits: tuple[Sequence[float], Sequence[float]], channels: tuple[int, int, int]
) -> Scale:
    """A scale whose ``channels`` have one unit and no offset, so that a turned displacement is in range, too."""
    offset, unit = np.array(scale.offset), np.array(scale.unit)
    offset[list(channels)] = 0
    unit[list(channels)] = max(np.abs(np.array(limits)[:, list(channels)]).max(), _STILL)
    return Scale(offset=tuple(offset.tolist()), unit=tuple(unit.tolist()))


def _flow_scale(statistics: Mapping[str, Any], settings: TrainSettings) -> tuple[float, float]:
    """The unit of flow [m], and the greatest normalized value."""
    flow = statistics["arrays"].get("flow")
    if flow is None:
        return 1.0, 1.0
    largest = max(*map(abs, flow["min"]), *map(abs, flow["max"]), _STILL)
    if settings.motion.scale == "limits":
        return largest, 1.0
    return max(min(statistics["motion"]["step_m"]["p99"], largest), _STILL), settings.motion.clip


def _relative_limits(
    buffer: ReplayBuffer, channels: ChannelSpec, settings: TrainSettings
) -> tuple[np.ndarray, np.ndarray]:
    """Limits of the actions of a window, where places are given relative to the gripper when it is decided on."""
    assert channels.gripper is not None
    assert channels.action_position is not None
    gripper, place = list(channels.gripper), list(channels.action_position)
    low, high = np.array(buffer.action).min(0), np.array(buffer.action).max(0)
    low[place], high[place] = np.inf, -np.inf
    for demo in buffer.demos:
        action, state = buffer.action[demo.start : demo.stop], buffer.state[demo.start : demo.stop]
        for ahead in range(1 - settings.n_obs_steps, settings.horizon - settings.n_obs_steps + 1):
            then = np.clip(np.arange(len(demo)) + ahead, 0, len(demo) - 1)
            away = action[then][:, place] - state[:, gripper]
            low[place] = np.minimum(low[place], away.min(0))
            high[place] = np.maximum(high[place], away.max(0))
    return low, high


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
