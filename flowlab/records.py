"""The records that travel between stages: small, frozen, each made in one place.

    Frame -> Cloud -> Observation -> Queries -> Tracks2D (real only) -> Tracks3D -> Episode -> shard

A real recording and a simulated rollout are both a :class:`~flowlab.demonstrations.Demonstration`; they differ only
in how tracks are made. World coordinates are meters in the dataset's world frame, which ``docs/conventions.md``
describes; float32 unless said otherwise.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int, Int16, Int32, UInt8

from flowlab.geometry.camera import Camera
from flowlab.shapes import Record


class Role(IntEnum):
    """What a surface is to the task."""

    BACKGROUND = 0
    """Floor, walls, table."""
    ROBOT = 1
    OBJECT = 2
    """Something that can move and is not the robot."""
    PROP = 3
    """Something the task is about that cannot move: a hole, a shelf, a hoop."""
    MARKER = 4
    """A goal marker: drawn, but made of nothing."""


@dataclass(frozen=True, slots=True)
class Entity:
    """One thing that can own a pixel."""

    geom: str
    """Name of the geom, or of the site for a marker; MuJoCo's index where it has no name."""
    body: str
    role: Role


@dataclass(frozen=True, slots=True, repr=False)
class Frame(Record):
    """One depth picture of a calibrated camera, with what else is known of its pixels."""

    depth: Float32[np.ndarray, "H W"]
    """z-depth along the optical axis [m]; 0 where there is no reading."""
    camera: Camera
    owner: Int16[np.ndarray, "H W"] | None = None
    """Index into ``entities`` of what each pixel shows, -1 for nothing; None for a real camera."""
    entities: tuple[Entity, ...] = ()
    rgb: UInt8[np.ndarray, "H W 3"] | None = None

    def _check_values(self) -> None:
        if not self.depth.size or self.depth.min() >= 0:
            return
        if (self.depth < 0).any():  # and not only NaN
            v, u = np.argwhere(self.depth < 0)[0]
            raise self._wrong("depth", f"is {self.depth[v, u]:g} m at pixel ({u}, {v}), expected 0 or more")


@dataclass(frozen=True, slots=True, repr=False)
class Cloud(Record):
    """All points of one frame that lie in the crop, in pixel order."""

    xyz_world: Float32[np.ndarray, "P 3"]
    pixel: Int32[np.ndarray, "P"]
    """Flat index ``v * W + u`` of each point's pixel."""
    owner: Int16[np.ndarray, "P"] | None = None
    entities: tuple[Entity, ...] = ()


@dataclass(frozen=True, slots=True, repr=False)
class Observation(Record):
    """What a policy sees of the scene at one instant."""

    points_world: Float32[np.ndarray, "N 3"]
    """Farthest-point sample of the cloud, in that order: the first k are its sample of k."""
    count: int
    """How many of the points are distinct; the rest repeat them (or are zero, in the DP3 profile)."""

    def _check_values(self) -> None:
        if not 0 <= self.count <= len(self.points_world):
            raise self._wrong("count", f"is {self.count}, expected 0 to {len(self.points_world)}, the number of points")


@dataclass(frozen=True, slots=True, repr=False)
class Queries(Record):
    """The points to follow, on the first frame."""

    xyz_world: Float32[np.ndarray, "M 3"]
    owner: Int16[np.ndarray, "M"]
    """Index into ``entities``; -1 where the owner is not known."""
    count: int
    """How many are distinct; the rest repeat them."""
    entities: tuple[Entity, ...] = ()
    pixel: Int32[np.ndarray, "M"] | None = None
    """Flat index ``v * W + u`` of each point's pixel in the first frame; None where it is not known, as in episodes
    that were stored."""

    def _check_values(self) -> None:
        if not 0 <= self.count <= len(self.owner):
            raise self._wrong("count", f"is {self.count}, expected 0 to {len(self.owner)}, the number of points")
        if len(self.owner) and not (self.owner.min() >= -1 and self.owner.max() < len(self.entities)):
            found = f"{self.owner.min()} to {self.owner.max()}"
            raise self._wrong(
                "owner", f"ranges from {found}, expected -1 to {len(self.entities) - 1}, as of the entities"
            )


@dataclass(frozen=True, slots=True, repr=False)
class Clip(Record):
    """A whole demonstration as one camera saw it: what a tracker works on."""

    rgb: UInt8[np.ndarray, "T H W 3"]
    depth: Float32[np.ndarray, "T H W"]
    """z-depth [m], registered to the color picture; 0 where there is no reading."""
    camera: Camera
    T_world_cam: Float64[np.ndarray, "T 4 4"] | None = None
    """See :class:`~flowlab.demonstrations.Demonstration`."""

    def __len__(self) -> int:
        return len(self.rgb)

    def poses(self) -> Float64[np.ndarray, "T 4 4"]:
        """The pose of the camera in every frame.

        Returns:
            Maps the camera's coordinates to the world's [m], whether it moves or not.
        """
        if self.T_world_cam is not None:
            return self.T_world_cam
        return np.broadcast_to(np.asarray(self.camera.T_world_cam, float), (len(self), 4, 4))

    def to_world(self, xyz_cam: Float[np.ndarray, "T M 3"]) -> Float[np.ndarray, "T M 3"]:
        """Points of every frame in the world.

        Args:
            xyz_cam: Points in the camera's frame of each row [m].

        Returns:
            The same points in the world's frame [m].
        """
        T = self.poses()
        return xyz_cam @ T[:, :3, :3].swapaxes(1, 2) + T[:, None, :3, 3]

    def to_camera(self, xyz_world: Float[np.ndarray, "T M 3"]) -> Float[np.ndarray, "T M 3"]:
        """Points of every frame in the camera's frame: the inverse of :meth:`to_world`.

        Args:
            xyz_world: Points in the world's frame [m].

        Returns:
            The same points in the camera's frame of each row [m].
        """
        T = self.poses()
        return (xyz_world - T[:, None, :3, 3]) @ T[:, :3, :3]

    def _check_values(self) -> None:
        ends = (self.depth.min(), self.depth.max()) if self.depth.size else ()
        for found in ends:
            if not 0 <= found < np.inf:  # as NaN is, too
                raise self._wrong("depth", f"is {found:g} m somewhere, expected 0 or more, and 0 where nothing is read")


@dataclass(frozen=True, slots=True, repr=False)
class Tracks2D(Record):
    """Where a tracker says every query point is in the picture."""

    xy: Float32[np.ndarray, "T M 2"]
    """Pixel (x right, y down), integer pixel centers; always finite, a held position where the point is lost."""
    visible: Bool[np.ndarray, "T M"]
    """Whether the tracker believes that the camera sees the point there."""
    confidence: Float32[np.ndarray, "T M"]
    """The tracker's own belief in the position, 0 to 1."""
    forward_backward: Float32[np.ndarray, "T M"] | None = None
    """How far a point lands from its start when tracked there and back [px]; -1 where not measured."""
    disagreement: Float32[np.ndarray, "T M"] | None = None
    """How far apart overlapping chunks put the point [px]; -1 where only one chunk covers it."""
    xyz_cam: Float32[np.ndarray, "T M 3"] | None = None
    """Position in the camera frame [m] where a model of the motion gives it, for points out of sight too; (0, 0, 0)
    where none does."""
    residual: Float32[np.ndarray, "T M"] | None = None
    """How badly that model explains color and depth around the point, 0 to 1; -1 where none does."""
    sigma: Float32[np.ndarray, "T M"] | None = None
    """The error [m] that the tracker states itself where its model gives the position: two in three of such errors are
    meant to be smaller; -1 where it states none."""

    def _check_values(self) -> None:
        if not np.isfinite(self.xy).all():
            raise self._wrong("xy", "holds a number that is not finite, expected a held position where a point is lost")
        if not ((self.confidence >= 0) & (self.confidence <= 1)).all():
            found = f"{self.confidence.min():g} to {self.confidence.max():g}"
            raise self._wrong("confidence", f"ranges from {found}, expected 0 to 1")


class PositionSource(IntEnum):
    """Where the position of a tracked point comes from, at one instant."""

    SIMULATOR = 0
    """Exact: a simulated body carries it."""
    MEASURED = 1
    """Followed in the picture, and its depth read there by the sensor."""
    MODEL = 2
    """Carried by a rigid motion that was fitted to the pictures, or put there by a network that hands over 3D; so may
    a point out of sight be."""
    FILLED = 3
    """Neither: interpolated between instants at which it was known, or held at the last."""


class Sight(IntEnum):
    """Whether the sensor sees a tracked point, at one instant, and why not."""

    SEEN = 0
    COVERED = 1
    """Something nearer is read at its place."""
    OUT_OF_VIEW = 2
    """It is beside the picture, or behind the camera."""
    NO_READING = 3
    """The sensor gave no depth at its place, or beside it: the picture may show the point or not."""
    SEEN_THROUGH = 4
    """What is behind it is read at its place: wherever the point is, it is not there, or the tracker lost it."""


@dataclass(frozen=True, slots=True, repr=False)
class FlowPrediction(Record):
    """Where a policy expected the query points of an episode to go, plan by plan."""

    step: Int[np.ndarray, "P"]
    """The step each plan was made at, in order."""
    paths_world: Float32[np.ndarray, "P H M 3"]
    """Row 0: where every query point truly was then [m]; row k: where it was expected after k more actions."""


@dataclass(frozen=True, slots=True, repr=False)
class Quality(Record):
    """What is known of the error of tracks that were estimated from pictures."""

    sigma: Float32[np.ndarray, "T M"]
    """Stated error [m]: 68 % of errors are meant to be below it."""
    source: UInt8[np.ndarray, "T M"]
    """The :class:`PositionSource` of every position."""
    depth_valid: Bool[np.ndarray, "T M"]
    """Whether the sensor gave a depth at the point's pixel that fits the point."""
    forward_backward: Float32[np.ndarray, "T M"]
    """See :class:`Tracks2D`."""
    disagreement: Float32[np.ndarray, "T M"]
    """See :class:`Tracks2D`."""
    residual: Float32[np.ndarray, "T M"]
    """See :class:`Tracks2D`."""
    sight: UInt8[np.ndarray, "T M"] | None = None
    """The :class:`Sight` of every position; None in datasets made before this was told."""


@dataclass(frozen=True, slots=True, repr=False)
class Tracks3D(Record):
    """Where every query point is at every instant."""

    xyz_world: Float32[np.ndarray, "T M 3"]
    """Absolute positions; flow is derived on load: ``flow[t] = xyz[t + 1] - xyz[t]``."""
    visible: Bool[np.ndarray, "T M"]
    association_distance: Float32[np.ndarray, "M"]
    """How far from its query the followed point lies at the first frame [m]; 0 for exact tracks."""
    quality: Quality | None = None
    """None for exact tracks."""


@dataclass(frozen=True, slots=True, repr=False)
class Episode(Record):
    """One labeled demonstration, as it is stored. Row t of every array is the same instant; fields that a
    :class:`~flowlab.demonstrations.Demonstration` has too mean the same."""

    task: str
    seed: int
    camera: Camera
    time_s: Float64[np.ndarray, "T"]
    point_cloud: Float32[np.ndarray, "T N 3"]
    point_count: Int32[np.ndarray, "T"]
    state: Float32[np.ndarray, "T S"]
    action: Float32[np.ndarray, "T A"]
    success: Bool[np.ndarray, "T"]
    queries: Queries
    tracks: Tracks3D
    object_pose: Float32[np.ndarray, "T 9"] | None = None
    depth: Float32[np.ndarray, "T H W"] | None = None
    rgb: UInt8[np.ndarray, "T H W 3"] | None = None
    extras: Mapping[str, Any] = field(default_factory=dict)
    T_world_cam: Float64[np.ndarray, "T 4 4"] | None = None
    state_sigma: Float32[np.ndarray, "T S"] | None = None
    """Stated error of every number of the state, in its unit: 68 % of errors are meant to be below it. None where the
    state was not inferred."""
    action_sigma: Float32[np.ndarray, "T A"] | None = None
    """The same of the action."""

    def __len__(self) -> int:
        return len(self.action)

    def camera_at(self, t: int) -> Camera:
        """The camera as it was at step ``t``.

        Args:
            t: The step, from 0.

        Returns:
            ``camera``, where it stands still.
        """
        return camera_at(self, t)

    def check_numbers(self) -> None:
        """Refuse what nobody may store. An episode that is read may have it: a damaged dataset has to be looked into.

        Raises:
            RecordError: Times do not rise, numbers of the robot are not finite, or counts cannot be.
        """
        check_rows(self)
        low, high, most = self.point_count.min(initial=0), self.point_count.max(initial=0), self.point_cloud.shape[1]
        if not 0 <= low <= high <= most:
            raise self._wrong("point_count", f"ranges from {low} to {high}, expected 0 to {most}")

    @property
    def flow(self) -> Float[np.ndarray, "T M 3"]:
        """Displacement [m] of every query point during action t; zero for the last row."""
        return np.diff(self.tracks.xyz_world, axis=0, append=self.tracks.xyz_world[-1:])

    @property
    def query_role(self) -> Int[np.ndarray, "M"]:
        """The :class:`Role` of every query's owner, -1 where it is not known."""
        roles = np.array([e.role for e in self.queries.entities] + [-1])
        return roles[self.queries.owner]


def camera_at(of: Any, t: int) -> Camera:
    """The camera at a row of an episode or a demonstration."""
    return of.camera if of.T_world_cam is None else of.camera.at(of.T_world_cam[t])


def check_rows(of: Any) -> None:
    """Of an episode or a demonstration, refuse times that do not rise, and numbers of the robot that are none."""
    for name in ("time_s", "state", "action"):
        if not np.isfinite(values := getattr(of, name)).all():
            raise of._wrong(name, f"is not finite in row {int(np.argwhere(~np.isfinite(values))[0][0])}")
    if len(of.time_s) > 1 and not (np.diff(of.time_s) > 0).all():
        row = int(np.argmin(np.diff(of.time_s) > 0)) + 1
        raise of._wrong("time_s", f"is {of.time_s[row]:g} s in row {row} after {of.time_s[row - 1]:g} s, expected more")
    if of.seed < 0:
        raise of._wrong("seed", f"is {of.seed}, expected 0 or more")
