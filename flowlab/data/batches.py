"""What a policy is given at a time: some windows of some episodes, and the frames that they share."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, TypeVar

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

_OF_FRAMES = ("points", "state", "rgb", "depth")
"""Fields with a row per frame; all others have a row per window."""


B = TypeVar("B", bound="ObservationBatch")


@dataclass(frozen=True, slots=True)
class ObservationBatch:
    """What a policy decides on, for W windows that share F frames. What it does not need is empty, or None."""

    points: Float[Tensor, "F N 3"]
    """Point clouds [m], world frame; N is 0 where the policy needs none."""
    state: Float[Tensor, "F S"]
    """The robot's, in the dataset's units."""
    observed: Int[Tensor, "W H"]
    """The H frames of each window, the last is now."""
    queries: Float[Tensor, "W M 3"]
    """Where each query point was when its episode began [m], world frame; M is 0 where the policy needs none."""
    task: Int[Tensor, "W"]
    """Index of the task."""
    rgb: UInt8[Tensor, "F height width 3"] | None = None
    """Color pictures; None where the policy needs none."""
    depth: Float[Tensor, "F height width"] | None = None
    """z-depth [m], 0 where there is no reading; None where the policy needs none."""

    def to(self: B, device: torch.device) -> B:
        """The same on another device."""
        values: dict[str, Any] = {f.name: getattr(self, f.name) for f in fields(self)}
        moved: dict[str, Any] = {k: v if v is None else v.to(device, non_blocking=True) for k, v in values.items()}
        return type(self)(**moved)

    @classmethod
    def concatenate(cls, batches: Sequence["ObservationBatch"]) -> "ObservationBatch":
        """The windows of several batches as one batch."""
        before = np.cumsum([0, *(len(b.state) for b in batches[:-1])]).tolist()

        def together(name: str) -> Any:
            parts = [getattr(b, name) for b in batches]
            return None if parts[0] is None else torch.cat(parts)

        observed = torch.cat([b.observed + n for b, n in zip(batches, before, strict=True)])
        others = {f.name: together(f.name) for f in fields(ObservationBatch) if f.name != "observed"}
        return ObservationBatch(**others, observed=observed)


@dataclass(frozen=True, slots=True, kw_only=True)
class Batch(ObservationBatch):
    """A context, and what followed in the demonstrations. Row k of every sequence is action k of the window."""

    action: Float[Tensor, "W T A"]
    """In the dataset's units."""
    action_weight: Float[Tensor, "W T"]
    """0 where the demonstration has no such step; the mean over the whole batch is 1."""
    action_confidence: Float[Tensor, "W T A"]
    """Less where an inferred action is less sure, for each of its numbers; the mean over the whole batch is 1."""
    flow: Float[Tensor, "W T M 3"]
    """How far each query point moves during each action [m]; M is 0 where the policy needs none."""
    flow_weight: Float[Tensor, "W T M"]
    """Less where the label is less sure; the mean over the whole batch is 1."""
    object_pose: Float[Tensor, "W T P"]
    """Position [m] and 6D rotation of the object; P is 9, or 0 where the policy needs none."""

    def part(self, windows: slice) -> "Batch":
        """Some of the windows, with the frames they need. The weights stay those of the whole batch."""
        if windows == slice(0, len(self.observed)):
            return self
        frame, observed = torch.unique(self.observed[windows], return_inverse=True)
        values: dict[str, Any] = {f.name: getattr(self, f.name) for f in fields(self)}
        mine: dict[str, Any] = {
            k: v if v is None else v[frame if k in _OF_FRAMES else windows] for k, v in values.items()
        }
        return Batch(**mine | {"observed": observed})
