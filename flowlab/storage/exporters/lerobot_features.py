"""What of a dataset goes into which feature of LeRobot, and what stays behind."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from flowlab.errors import DataError
from flowlab.provenance import Channels, Provenance
from flowlab.records import Episode
from flowlab.storage.dataset import Dataset
from flowlab.storage.episodes import EpisodeRef
from flowlab.storage.schema import POSES, SCHEMA, ArraySpec
from flowlab.storage.shard import Shard

_NAMES = {
    "data/time": "observation.time",
    "data/state": "observation.state",
    "data/state_sigma": "observation.state_sigma",
    "data/action": "action",
    "data/action_sigma": "action_sigma",
    "data/success": "next.success",
    "data/point_cloud": "observation.point_cloud",
    "data/point_count": "observation.point_count",
    "data/tracks": "observation.tracks",
    "data/visible": "observation.tracks_visible",
    "data/sigma": "observation.tracks_sigma",
    "data/object_pose": "observation.object_pose",
    POSES: "observation.T_world_cam",
}
"""Features by the array that they are made of; pictures are called by their camera."""
_OF_EPISODES = ("meta/seed", "meta/success", "meta/query_count", "meta/query_role")
_TYPES = {"int32": "int64"}
_AXES = ("x", "y", "z")


@dataclass(frozen=True, slots=True)
class TableFeature:
    """Numbers of each step."""

    name: str
    dtype: str
    shape: tuple[int, ...]
    names: tuple[str, ...]
    """What the numbers are called; empty where that is not known."""
    of: Callable[[Episode], np.ndarray]
    """The numbers of every step of an episode, as ``dtype``."""
    by_axis: bool
    """Whether the numbers are points, of which statistics are made by axis."""
    info: Mapping[str, Any] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """As ``meta/info.json`` has it."""
        return {
            "dtype": self.dtype,
            "shape": list(self.shape),
            "names": list(self.names) or None,
            "info": dict(self.info),
        }


@dataclass(frozen=True, slots=True)
class ExportPlan:
    """What is written."""

    features: tuple[TableFeature, ...]
    pictures: Mapping[str, tuple[int, int]]
    """Height and width of ``rgb`` and ``depth``, where the dataset keeps them [px]."""
    left_out: Mapping[str, str]
    """Arrays that the dataset has and that are not written, and what they mean."""
    fps: int
    """Steps a second, as a whole number, which LeRobot wants."""
    clock_error: float
    """How far LeRobot's timestamps are off from when the steps truly were, at most, as a share of an episode."""


def make_plan(dataset: Dataset, chosen: Sequence[EpisodeRef], *, flat: bool) -> ExportPlan:
    """What of some episodes is written.

    Args:
        dataset: Where they are from.
        chosen: The episodes.
        flat: Whether clouds and tracks are one row of numbers for each step instead of points.

    Raises:
        DataError: They differ in the shape of an array.
    """
    shapes: dict[str, set[tuple[int, ...]]] = {}
    shards = {ref.shard: Shard(dataset.path / ref.shard) for ref in chosen}
    for shard in shards.values():
        for array in shard.describe():
            shapes.setdefault(array.path, set()).add(array.shape[1:])
    everywhere = {a.path for a in next(iter(shards.values())).describe()}
    for shard in shards.values():
        everywhere &= {a.path for a in shard.describe()}
    taken = [s for s in SCHEMA if s.path in _NAMES and (s.path in everywhere or (s.path == POSES and s.path in shapes))]
    pictures = [s for s in SCHEMA if s.path in ("data/rgb", "data/depth") and s.path in everywhere]
    for spec in (*taken, *pictures):
        if len(shapes[spec.path]) > 1:
            found = " and ".join(str(list(x)) for x in sorted(shapes[spec.path]))
            raise DataError(f"{dataset.path}: '{spec.path}' has the shapes {found} in its episodes, and LeRobot has "
                            "one shape for each feature; export them apart, by --task or 'flowlab subset'")  # fmt: skip
    features = [
        made for s in taken if (made := _feature(s, next(iter(shapes[s.path])), dataset.provenance, flat)) is not None
    ]
    kept = {s.path for s in (*taken, *pictures)} | {*_OF_EPISODES}
    left_out = {s.path: s.meaning for s in SCHEMA if s.path in shapes and s.path not in kept}
    sizes = {s.name: next(iter(shapes[s.path]))[:2] for s in pictures}
    fps, clock_error = _rate(shards.values(), chosen)
    return ExportPlan(tuple(features), sizes, left_out, fps, clock_error)  # type: ignore[arg-type]


def _feature(spec: ArraySpec, shape: tuple[int, ...], known: Provenance, flat: bool) -> TableFeature | None:
    """The feature that an array becomes; none for an array without numbers."""
    if 0 in shape:
        return None
    by_axis = spec.dims[-1] == "xyz"
    stored = (int(np.prod(shape)),) if flat or not shape else shape
    dtype = _TYPES.get(spec.dtype, spec.dtype)
    channels = {"data/state": known.state, "data/action": known.action}.get(spec.path)
    names = _channel_names(channels, shape[0]) if channels and shape else ()

    def of(episode: Episode) -> np.ndarray:
        values = spec.of(episode)
        if values is None and spec.path == POSES:  # a camera that stands still, beside others that move
            values = np.tile(episode.camera.T_world_cam, (len(episode), 1, 1))
        assert values is not None
        return np.ascontiguousarray(values, dtype).reshape(len(episode), *stored)

    return TableFeature(
        _NAMES[spec.path], dtype, stored, names, of, by_axis, {"unit": spec.unit, "meaning": spec.meaning}
    )


def _channel_names(channels: Sequence[Channels], width: int) -> tuple[str, ...]:
    """What each number is called; nothing where that is not known of all."""
    names = [""] * width
    for channel in channels:
        parts = _AXES if channel.kind in ("position", "displacement") else range(len(channel.index))
        for part, place in zip(parts, channel.index, strict=True):
            if place < width:
                names[place] = channel.name if len(channel.index) == 1 else f"{channel.name}.{part}"
    return tuple(names) if all(names) and len(set(names)) == width else ()


def _rate(shards: Any, chosen: Sequence[EpisodeRef]) -> tuple[int, float]:
    """Steps a second, as a whole number, by the usual step; and the greatest share by which an episode lasts longer or
    shorter than its steps then would."""
    wanted = {(ref.shard, ref.position) for ref in chosen}
    steps = [np.diff(shard.array("data/time", rows))
             for name, shard in zip(dict.fromkeys(ref.shard for ref in chosen), shards, strict=True)
             for k, rows in enumerate(shard.rows()) if (name, k) in wanted]  # fmt: skip
    every = np.concatenate(steps)
    fps = max(1, round(1 / float(np.median(every)))) if len(every) else 1
    return fps, max((abs(len(s) / fps / float(s.sum()) - 1) for s in steps if len(s)), default=0.0)


def calibration(episode: Episode) -> dict[str, Any]:
    """The camera as the ``info`` of its pictures has it; without a pose where it moves."""
    camera = episode.camera
    pose = {} if episode.T_world_cam is not None else {"T_world_cam": camera.T_world_cam.tolist()}
    return {
        "K": camera.K.tolist(),
        "width": camera.width,
        "height": camera.height,
        "pixel_centers": 0.0,
        "axes": "opencv",
        **pose,
    }


def said_of_episode(episode: Episode) -> dict[str, Any]:
    """What is said of an episode beyond what LeRobot asks for."""
    camera = calibration(episode)
    pose = camera.get("T_world_cam")
    return {
        "success": bool(episode.success.any()),
        "seed": int(episode.seed),
        "source": str(episode.extras.get("source", "")),
        "query_count": int(episode.queries.count),
        "query_role": episode.query_role.tolist(),
        "camera/K": np.ravel(camera["K"]).tolist(),
        "camera/T_world_cam": None if pose is None else np.ravel(pose).tolist(),
    }
