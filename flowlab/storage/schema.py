"""What a shard holds: every array by name, with its dimensions, type, unit and meaning."""

from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np

from flowlab.records import Episode, Quality

SCHEMA_VERSION = 2
"""Since 2 a shard is one file; until then it was a folder."""
READABLE_VERSIONS = (1, SCHEMA_VERSION)


@dataclass(frozen=True, slots=True)
class ArraySpec:
    """One array of a shard: ``data/*`` has a row per step, ``meta/*`` a row per episode."""

    path: str
    dtype: str
    dims: tuple[str, ...]
    unit: str
    meaning: str
    of: Callable[[Episode], np.ndarray | None]
    """Takes the array out of an episode; None where an optional array is absent."""
    optional: bool = False

    @property
    def name(self) -> str:
        """The last part of the path."""
        return self.path.rpartition("/")[2]

    @property
    def per_step(self) -> bool:
        """Whether a row is a step rather than an episode."""
        return self.path.startswith("data/")

    @property
    def is_picture(self) -> bool:
        """Whether a row is a picture."""
        return self.dims[1:3] == ("v", "u")


def _row(value: object, dtype: str) -> np.ndarray:
    return np.asarray(value, dtype)[None]


def _quality(name: str, dtype: str, unit: str, meaning: str) -> ArraySpec:
    """An array of :class:`~flowlab.records.Quality`, which exact tracks lack."""
    return ArraySpec(
        f"data/{name}", dtype, ("time", "query"), unit, meaning,
        lambda e: None if e.tracks.quality is None else getattr(e.tracks.quality, name), optional=True,
    )  # fmt: skip


SCHEMA = (
    ArraySpec("data/time", "float64", ("time",), "s", "since the first row of the episode", lambda e: e.time_s),
    ArraySpec(
        "data/point_cloud", "float32", ("time", "point", "xyz"), "m",
        "what a policy sees: farthest-point sample of the cropped cloud, in that order, in the world frame",
        lambda e: e.point_cloud,
    ),
    ArraySpec(
        "data/point_count", "int32", ("time",), "1",
        "how many points of the cloud are distinct; the rest is padding", lambda e: e.point_count,
    ),
    ArraySpec("data/state", "float32", ("time", "state"), "source", "the robot's own state", lambda e: e.state),
    ArraySpec(
        "data/action", "float32", ("time", "action"), "source",
        "the action executed after the observation of the same row", lambda e: e.action,
    ),
    ArraySpec(
        "data/state_sigma", "float32", ("time", "state"), "source",
        "stated error of an inferred state: 68 % of errors are meant to be below it", lambda e: e.state_sigma,
        optional=True,
    ),
    ArraySpec(
        "data/action_sigma", "float32", ("time", "action"), "source", "the same of an inferred action",
        lambda e: e.action_sigma, optional=True,
    ),
    ArraySpec(
        "data/success", "bool", ("time",), "1", "whether the task counts as solved after the action of the row",
        lambda e: e.success,
    ),
    ArraySpec(
        "data/tracks", "float32", ("time", "query", "xyz"), "m",
        "absolute position of every query point in the world frame; flow[t] = tracks[t + 1] - tracks[t]",
        lambda e: e.tracks.xyz_world,
    ),
    ArraySpec(
        "data/visible", "bool", ("time", "query"), "1", "whether the camera sees the query point",
        lambda e: e.tracks.visible,
    ),
    ArraySpec(
        "data/object_pose", "float32", ("time", "pose"), "m and 1",
        "position and 6D rotation (first two matrix columns) of the manipulated body in the world frame",
        lambda e: e.object_pose, optional=True,
    ),
    ArraySpec(
        "data/depth", "float32", ("time", "v", "u"), "m", "z-depth picture; 0 where there is no reading",
        lambda e: e.depth, optional=True,
    ),
    ArraySpec(
        "data/T_world_cam", "float64", ("time", "row", "column"), "1 and m",
        "pose of a camera that moves: maps its coordinates (OpenCV's axes) to the world's; the shard's camera is then "
        "that of the first row", lambda e: e.T_world_cam, optional=True,
    ),
    ArraySpec("data/rgb", "uint8", ("time", "v", "u", "rgb"), "1", "color picture", lambda e: e.rgb, optional=True),
    _quality("sigma", "float32", "m", "stated error of the position: 68 % of errors are meant to be below it"),
    _quality(
        "source", "uint8", "1", "where the position comes from: 1 measured, 2 carried by a fitted motion, 3 filled in"
    ),
    _quality("depth_valid", "bool", "1", "whether the sensor gave a depth at the point's pixel that fits the point"),
    _quality(
        "forward_backward", "float32", "px",
        "how far the point lands from its start when tracked there and back; -1 where not measured",
    ),
    _quality(
        "disagreement", "float32", "px",
        "how far apart overlapping chunks put the point; -1 where only one chunk covers it",
    ),
    _quality(
        "residual", "float32", "1",
        "how badly the fitted motion explains color and depth around the point, 0 to 1; -1 where there is none",
    ),
    _quality(
        "sight", "uint8", "1",
        "whether the sensor sees the point: 0 seen, 1 covered, 2 out of view, 3 no reading, 4 seen through",
    ),
    ArraySpec("meta/seed", "int64", ("episode",), "1", "seed of the episode", lambda e: _row(e.seed, "int64")),
    ArraySpec(
        "meta/success", "bool", ("episode",), "1", "whether the task was solved at any step",
        lambda e: _row(e.success.any(), "bool"),
    ),
    ArraySpec(
        "meta/query_owner", "int16", ("episode", "query"), "1",
        "index into the shard's 'entities' of what each query point lies on; -1 where it is not known",
        lambda e: _row(e.queries.owner, "int16"),
    ),
    ArraySpec(
        "meta/query_role", "int8", ("episode", "query"), "1",
        "role of that owner: 0 background, 1 robot, 2 object, 3 prop, 4 marker, -1 not known",
        lambda e: _row(e.query_role, "int8"),
    ),
    ArraySpec(
        "meta/query_count", "int32", ("episode",), "1", "how many query points are distinct; the rest repeat them",
        lambda e: _row(e.queries.count, "int32"),
    ),
    ArraySpec(
        "meta/query_xyz", "float32", ("episode", "query", "xyz"), "m", "query points on the first cloud",
        lambda e: _row(e.queries.xyz_world, "float32"),
    ),
    ArraySpec(
        "meta/association_distance", "float32", ("episode", "query"), "m",
        "distance at the first frame between the query and the surface point followed for it",
        lambda e: _row(e.tracks.association_distance, "float32"),
    ),
)  # fmt: skip
SIGHT = "data/sight"
QUALITY = tuple(path for field in fields(Quality) if (path := f"data/{field.name}") != SIGHT)
"""The arrays of :class:`~flowlab.records.Quality`: all of them or none, but for ``SIGHT``, which older shards lack."""
POSES = "data/T_world_cam"
EPISODE_ENDS = "meta/episode_ends"
"""int64 (episode,): the row after each episode's last; written beside the arrays of the schema."""
