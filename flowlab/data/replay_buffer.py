"""The demonstrations as training reads them: decoded once, then mapped into memory."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, Int, UInt8

from flowlab.data.cache import cached_part, open_part
from flowlab.data.source import TrainingSource
from flowlab.records import Episode

ARRAYS = "arrays"
"""Name of the cached part of a dataset that holds everything but pictures."""


@dataclass(frozen=True, slots=True)
class EpisodeSlice:
    """Where a demonstration lies in the arrays of a :class:`ReplayBuffer`."""

    task: str
    seed: int
    start: int
    stop: int
    """Its rows are ``start`` to ``stop - 1``."""
    origin: int = 0
    """Which dataset it is from, where there are several: its position in :attr:`TrainingSource.parts`."""
    scene: str = ""
    """What its scene is known by in the other datasets; empty where that is not known, or where there is one dataset.
    Those of one task that are called alike show the same layout, or are labels of the same recording."""

    def __len__(self) -> int:
        return self.stop - self.start


@dataclass(frozen=True, slots=True)
class ReplayBuffer:
    """All demonstrations of a dataset, one behind the other: F frames, E episodes, Q query points."""

    episodes: tuple[EpisodeSlice, ...]
    """In order of task and seed."""
    point_cloud: Float32[np.ndarray, "F N 3"]
    """World frame [m]."""
    state: Float32[np.ndarray, "F S"]
    action: Float32[np.ndarray, "F A"]
    tracks: Float32[np.ndarray, "F Q 3"]
    """World frame [m]."""
    visible: Bool[np.ndarray, "F Q"]
    sigma: Float32[np.ndarray, "F Q"]
    """Stated error [m]; 0 for exact tracks."""
    object_pose: Float32[np.ndarray, "F P"]
    """P is 9, or 0 where it is not known."""
    queries: Float32[np.ndarray, "E Q 3"]
    query_role: Int[np.ndarray, "E Q"]
    query_count: Int[np.ndarray, "E 1"]
    action_sigma: Float32[np.ndarray, "F A"] | None = None
    """Stated error of inferred actions, 0 for recorded ones; None where all are recorded."""
    rgb: UInt8[np.ndarray, "F H W 3"] | None = None
    """Color pictures; None where they were not asked for, or the dataset has none."""
    depth: Float32[np.ndarray, "F H W"] | None = None
    """z-depth [m], 0 where there is no reading; None as above."""

    @property
    def inferred(self) -> frozenset[int]:
        """Indices of the episodes whose actions were inferred."""
        if self.action_sigma is None:
            return frozenset()
        return frozenset(k for k, e in enumerate(self.episodes) if (self.action_sigma[e.start : e.stop] > 0).any())

    @property
    def tasks(self) -> tuple[str, ...]:
        """Names of the tasks, sorted."""
        return tuple(sorted({e.task for e in self.episodes}))


def load_buffer(source: TrainingSource, fallback: Path, pictures: Sequence[str] = ()) -> ReplayBuffer:
    """The demonstrations of a source, decoded into the user's cache folder.

    Decoded once for each content; later calls look the files over and map them.

    Args:
        source: The dataset or store.
        fallback: Folder that takes the cache where the user's cannot be written.
        pictures: Which of ``rgb`` and ``depth`` are wanted; they are large, and decoded only on demand.

    Raises:
        DataError: Neither folder can be written, or the episodes are of different widths.
    """
    episodes, arrays = open_part(cached_part(source, fallback, ARRAYS, arrays_of))
    slices = tuple(_with_origin(EpisodeSlice(**e), source) for e in episodes)
    known = {name: array for name, array in arrays.items() if name in ReplayBuffer.__dataclass_fields__}
    return ReplayBuffer(slices, **known, **load_pictures(source, fallback, pictures))


def _with_origin(e: EpisodeSlice, source: TrainingSource) -> EpisodeSlice:
    """A demonstration that knows its dataset: the rows of each lie behind those of the one before."""
    if not source.parts:
        return e
    ends = np.cumsum([part.frames for part in source.parts])
    origin = int(np.searchsorted(ends, e.start, side="right"))
    return replace(e, origin=origin, scene=source.parts[origin].scenes.get((e.task, e.seed), ""))


def load_pictures(source: TrainingSource, fallback: Path, names: Sequence[str]) -> dict[str, np.ndarray]:
    """Those of the pictures (F, H, W, ...) that the dataset has; each kind has a cache of its own."""
    found: dict[str, np.ndarray] = {}
    for name in names:
        found |= open_part(cached_part(source, fallback, name, partial(pictures_of, name=name)))[1]
    return found


def arrays_of(e: Episode) -> tuple[Mapping[str, np.ndarray], Mapping[str, np.ndarray]]:
    """What is cached of an episode but for pictures: arrays with a row per frame, and arrays of the whole episode."""
    tracks = e.tracks
    exact = np.zeros(tracks.visible.shape, np.float32)
    return {
        "point_cloud": e.point_cloud,
        "point_count": e.point_count,
        "state": e.state,
        "action": e.action,
        "action_sigma": np.zeros(e.action.shape, np.float32) if e.action_sigma is None else e.action_sigma,
        "success": e.success,
        "time": e.time_s,
        "tracks": tracks.xyz_world,
        "visible": tracks.visible,
        "sigma": exact if tracks.quality is None else tracks.quality.sigma,
        "object_pose": np.zeros((len(e), 0), np.float32) if e.object_pose is None else e.object_pose,
    }, {
        "queries": e.queries.xyz_world,
        "query_role": e.query_role.astype(np.int8),
        "query_count": np.array([e.queries.count]),
        "estimated": np.array([tracks.quality is not None]),
    }


def pictures_of(e: Episode, name: str) -> tuple[Mapping[str, np.ndarray], Mapping[str, np.ndarray]]:
    """The same, of one kind of picture."""
    values = getattr(e, name)
    return {} if values is None else {name: values}, {}
