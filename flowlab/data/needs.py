"""Which arrays of a dataset a policy is trained on, and must be shown in use."""

from dataclasses import dataclass
from typing import Any, Literal

from flowlab.data.replay_buffer import ReplayBuffer

_OBJECT_SHARE = 1 / 3
"""Of stratified query points; the default of :class:`~flowlab.perception.queries.QuerySettings`."""


@dataclass(frozen=True, slots=True)
class CloudNeeds:
    """Point clouds of the scene."""

    points: int
    """Of each cloud, the first so many: farthest-point samples are nested."""
    subset: int | None = None
    """Train on a random subset of so many of them, another in each step; None trains on all."""
    subset_most: int | None = None
    """Draw how many that are in each step, from ``subset`` to this, small numbers as often as large ones by ratio."""


@dataclass(frozen=True, slots=True)
class FlowNeeds:
    """How query points move."""

    points: int
    """M, the query points of an episode."""
    sampling: Literal["scene", "object", "stratified"] = "scene"
    """Which of the dataset's: see :class:`~flowlab.perception.queries.QuerySettings`."""
    subset: int | None = None
    """Train on a random subset of so many of them, another in each step; None trains on all."""
    occluded_weight: float = 1.0
    """Weight in the loss of a point that the camera does not see; one that it sees exactly has 1."""
    sigma_m: float = 0.01
    """Stated error [m] at which the weight of an estimated position is a half."""
    scale: Literal["limits", "quantile"] = "limits"
    """What is 1 when flow is normalized: its largest component, or the length that 99 % of the steps stay below."""
    clip: float = 1.0
    """Greatest value of normalized flow with ``quantile``."""

    @property
    def query_settings(self) -> dict[str, Any]:
        """The same choice of points, for :class:`~flowlab.perception.queries.QuerySettings` to make on a new cloud."""
        return {"points": self.points, "sampling": self.sampling, "object_share": _OBJECT_SHARE}


@dataclass(frozen=True, slots=True)
class Needs:
    """What a policy needs beside the robot's state and actions, which everyone gets. Nothing else is given to it."""

    point_cloud: CloudNeeds | None = None
    flow: FlowNeeds | None = None
    """In training the flow of query points, in use where these points were when the episode began."""
    object_pose: bool = False
    """In training only, as something to predict."""
    rgb: bool = False
    """Color pictures."""
    depth: bool = False
    """Depth pictures."""

    @property
    def pictures(self) -> tuple[str, ...]:
        """Names of the arrays of pictures that are needed."""
        return tuple(name for name in ("rgb", "depth") if getattr(self, name))

    def missing_from(self, buffer: ReplayBuffer) -> str | None:
        """What a dataset lacks, in words; None where it has everything."""
        if self.object_pose and buffer.object_pose.shape[1] != 9:
            return "object poses"
        if self.flow is not None and not buffer.queries.shape[1]:
            return "query points"
        for name in self.pictures:
            if getattr(buffer, name) is None:
                return {"rgb": "color pictures", "depth": "depth pictures"}[name]
        return None
