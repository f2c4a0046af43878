"""Numbers of a dataset brought to about [-1, 1] and back."""

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float

from flowlab.config import Settings
from flowlab.data.channels import ChannelSpec
from flowlab.data.needs import FlowNeeds
from flowlab.data.replay_buffer import ReplayBuffer
from flowlab.data.training_settings import TrainSettings
from flowlab.errors import DataError
from flowlab.storage.stats import step_quantile

_STILL = 1e-4
"""A channel that varies less than this is only centered, as in DP3."""

Limits = Sequence[float] | Float[np.ndarray, "C"]
"""Least or greatest value of every channel."""


class Scale(Settings):
    """``normal = (value - offset) / unit``, channel by channel."""

    offset: tuple[float, ...]
    unit: tuple[float, ...]

    @classmethod
    def of_limits(cls, low: Limits, high: Limits) -> "Scale":
        """Brings ``low`` to -1 and ``high`` to 1."""
        lo, hi = np.array(low), np.array(high)
        unit = np.where(hi - lo < _STILL, 1.0, (hi - lo) / 2)
        return cls(offset=tuple(((lo + hi) / 2).tolist()), unit=tuple(unit.tolist()))

    def fits(self, width: int) -> bool:
        """Whether it is for so many channels, and can be undone."""
        numbers = np.isfinite([*self.offset, *self.unit]).all() and all(u > 0 for u in self.unit)
        return bool(len(self.offset) == len(self.unit) == width and numbers)


class Normalizer(Settings):
    """The scales of a dataset. Lengths have one unit for all axes, so that shapes keep their proportions, but where the
    policy wants limits for each axis."""

    position: Scale
    """Points, and positions of the object; relative to the gripper where the policy is."""
    state: Scale
    action: Scale
    flow: Scale | None = None
    """Zero is no motion; None where the policy learns no flow."""
    flow_clip: float | None = None
    """Normalized flow is clipped here."""


def fit_normalizer(buffer: ReplayBuffer, channels: ChannelSpec, settings: TrainSettings) -> Normalizer:
    """The normalizer of demonstrations, from their numbers: what a dataset says of them may not be true of them.

    Raises:
        DataError: Some are no numbers.
    """
    low, high = _limits(buffer.point_cloud, "point_cloud")
    center, half = (low + high) / 2, float((high - low).max() / 2)
    unit = Scale.of_limits(low, high).unit if settings.scales_axes else (half,) * 3
    relative = settings.relative_to_gripper and channels.gripper is not None
    action = _limits(buffer.action, "action")
    if relative and channels.action_position is not None:
        action = _relative_limits(buffer, channels, settings)
    scale = Scale.of_limits(*action)
    if settings.batch.turn_deg and channels.action_displacement is not None:
        scale = _isotropic(scale, action, channels.action_displacement)
    flow, flow_clip = _flow_scale(buffer, settings.needs.flow)
    return Normalizer(
        position=Scale(offset=(0.0,) * 3 if relative else tuple(center.tolist()), unit=unit),
        state=Scale.of_limits(*_limits(buffer.state, "state")),
        action=scale,
        flow=flow,
        flow_clip=flow_clip,
    )


def _isotropic(scale: Scale, limits: tuple[Limits, Limits], channels: tuple[int, int, int]) -> Scale:
    """A scale whose ``channels`` have one unit and no offset, so that a turned displacement is in range, too."""
    offset, unit = np.array(scale.offset), np.array(scale.unit)
    offset[list(channels)] = 0
    unit[list(channels)] = max(np.abs(np.array(limits)[:, list(channels)]).max(), _STILL)
    return Scale(offset=tuple(offset.tolist()), unit=tuple(unit.tolist()))


def _limits(values: Float[np.ndarray, "F *N C"], name: str) -> tuple[Float[np.ndarray, "C"], Float[np.ndarray, "C"]]:
    """Least and greatest value of every channel."""
    rows = values.reshape(len(values), -1)  # long rows are looked at many times as fast as short ones
    low, high = (limit.reshape(-1, values.shape[-1]) for limit in (rows.min(0), rows.max(0)))
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        raise DataError(f"'{name}' has values that are not finite; 'flowlab validate' tells where")
    return low.min(0).astype(float), high.max(0).astype(float)


def _flow_scale(buffer: ReplayBuffer, needs: FlowNeeds | None) -> tuple[Scale | None, float | None]:
    """The scale of flow [m], and the greatest normalized value."""
    if needs is None:
        return None, None
    unit, clip = max([_STILL, *(_largest(flow) for flow in _flows(buffer))]), 1.0
    if needs.scale == "quantile":
        unit, clip = max(min(step_quantile(_flows(buffer), 0.99), unit), _STILL), needs.clip
    return Scale(offset=(0.0,) * 3, unit=(unit,) * 3), clip


def _largest(flow: Float[np.ndarray, "T Q 3"]) -> float:
    (low,), (high,) = _limits(flow.reshape(-1, 1), "tracks")
    return float(max(-low, high))


def _flows(buffer: ReplayBuffer) -> Iterator[Float[np.ndarray, "T Q 3"]]:
    """How query points move in each episode, step by step."""
    return (np.diff(buffer.tracks[e.start : e.stop], axis=0) for e in buffer.episodes if len(e) > 1)


def _relative_limits(
    buffer: ReplayBuffer, channels: ChannelSpec, settings: TrainSettings
) -> tuple[Float[np.ndarray, "A"], Float[np.ndarray, "A"]]:
    """Limits of the actions of a window, where positions are given relative to the gripper when it is decided on."""
    assert channels.gripper is not None
    assert channels.action_position is not None
    gripper, target = list(channels.gripper), list(channels.action_position)
    low, high = np.array(buffer.action).min(0), np.array(buffer.action).max(0)
    low[target], high[target] = np.inf, -np.inf
    for e in buffer.episodes:
        action, state = buffer.action[e.start : e.stop], buffer.state[e.start : e.stop]
        for ahead in range(1 - settings.n_obs_steps, settings.horizon - settings.n_obs_steps + 1):
            then = np.clip(np.arange(len(e)) + ahead, 0, len(e) - 1)
            away = action[then][:, target] - state[:, gripper]
            low[target] = np.minimum(low[target], away.min(0))
            high[target] = np.maximum(high[target], away.max(0))
    return low, high
