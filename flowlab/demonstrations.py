"""A demonstration on its way to an episode: as it was shown, observed, given points to follow, and tracked."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int16, Int32, UInt8

from flowlab.geometry.camera import Camera
from flowlab.records import Cloud, Frame, Queries, Tracks2D, camera_at, check_rows
from flowlab.shapes import Record


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Demonstration(Record, ABC):
    """A demonstration one can look at: a simulated rollout, or a recording of a real robot."""

    task: str
    seed: int
    camera: Camera
    """Where it moves, as it was in the first row."""
    time_s: Float64[np.ndarray, "T"]
    """When each row was, since the first [s]."""
    state: Float32[np.ndarray, "T S"]
    action: Float32[np.ndarray, "T A"]
    """The action taken after the observation of the same row, as executed."""
    success: Bool[np.ndarray, "T"]
    """Whether the task counts as solved after the action of the same row."""
    object_pose: Float32[np.ndarray, "T 9"] | None = None
    """Position [m] and 6D rotation of the manipulated body, where it is known."""
    extras: Mapping[str, Any] = field(default_factory=dict)
    """Small JSON values of where it comes from, such as MetaWorld's ``rand_vec``."""
    T_world_cam: Float64[np.ndarray, "T 4 4"] | None = None
    """The pose of a camera that moves, in every row: maps its coordinates to the world's [m]. None for one that stands
    still, whose pose ``camera`` has."""

    def __len__(self) -> int:
        return len(self.action)

    def _check_values(self) -> None:
        check_rows(self)

    def camera_at(self, t: int) -> Camera:
        """The camera as it was at a step.

        Args:
            t: The step, from 0.

        Returns:
            The camera, with its pose of that step.
        """
        return camera_at(self, t)

    @abstractmethod
    def frame(self, t: int) -> Frame:
        """The picture taken at step ``t``, before action ``t``.

        Args:
            t: The step, from 0.

        Returns:
            Depth [m], and color and owners where they are known.
        """

    def changed(self) -> str:
        """What has changed, since it was opened, of the files that it is read from.

        Returns:
            What that is, after their path; empty where nothing has, and where there are none.
        """
        return ""


@dataclass(frozen=True, slots=True, repr=False)
class ObservedDemo(Record):
    """A demonstration, and what the Observer saw of it."""

    demo: Demonstration
    points_world: Float32[np.ndarray, "T N 3"]
    point_count: Int32[np.ndarray, "T"]
    first_cloud: Cloud
    depth: Float32[np.ndarray, "T H W"]
    owner: Int16[np.ndarray, "T H W"] | None = None
    rgb: UInt8[np.ndarray, "T H W 3"] | None = None


@dataclass(frozen=True, slots=True, repr=False)
class QueriedDemo(Record):
    """An observed demonstration, and the points to follow through it."""

    observed: ObservedDemo
    queries: Queries


@dataclass(frozen=True, slots=True, repr=False)
class TrackedDemo(Record):
    """A demonstration whose query points have been followed in the picture."""

    queried: QueriedDemo
    tracks: Tracks2D
    tracker: Mapping[str, Any]
    """Name, license and version of the tracker, and what weights it used."""
