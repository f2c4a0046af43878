"""Where the episodes of a dataset come from, and what their numbers mean.

Written into the manifest by the stages that know, each its own part; read by training, evaluation, validation and the
dataset card. Nobody asks for the name of a stage.
"""

from collections.abc import Mapping
from typing import Any, Literal

from flowlab.config import Settings


class Channels(Settings):
    """Some numbers of a state or an action that together mean one thing."""

    name: str
    """``hand``, ``left finger``, ``gripper``."""
    index: tuple[int, ...]
    """Their places in the state or action, from 0."""
    kind: Literal["position", "displacement", "rotation", "joint", "effort", "other"]
    """``position`` and ``displacement`` are triples along x, y, z of ``frame``."""
    frame: str
    """``world`` is the dataset's world frame, in which its clouds and tracks are given; another name is another frame;
    empty where the numbers have none."""
    unit: str
    """``m``, ``cm``, ``rad``, ``1``."""


class Provenance(Settings):
    """Where the episodes of a dataset come from. What is not known is None or empty, and never guessed."""

    kind: Literal["simulated", "recorded", "imported", "unknown"] = "unknown"
    simulator: str = ""
    """Of simulated episodes: ``metaworld``."""
    scene: Mapping[str, Any] | None = None
    """Settings of the simulated scene, from which it can be shown again."""
    world_frame: str = ""
    """What the dataset's world frame is, in words."""
    camera: Mapping[str, Any] = {}
    """K [px] and T_world_cam, see :class:`flowlab.geometry.camera.Camera`; empty where every episode has its own."""
    state: tuple[Channels, ...] | None = None
    """What the numbers of the state mean; None where that is not known."""
    action: tuple[Channels, ...] | None = None
    """What the numbers of the action mean; None where that is not known."""
    action_limits: tuple[tuple[float, ...], tuple[float, ...]] | None = None
    """Least and greatest value of every number of an action, as executed; None where that is not known."""
    observer: Mapping[str, Any] | None = None
    """Settings of the Observer that made the clouds."""
    queries: Mapping[str, Any] | None = None
    """Settings by which the query points were chosen."""
    tracks: Literal["exact", "estimated", "none"] = "none"
    """Whether tracks are the simulator's own, or estimated from pictures, with a stated error."""
    tracker: str = ""
    """Name of what estimated them."""

    @property
    def is_simulated(self) -> bool:
        """Whether a simulator made the episodes, so that an episode's seed decides its scene."""
        return self.kind == "simulated"
