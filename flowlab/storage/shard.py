"""One shard: whole episodes as a zarr v3 group in a stored zip, there under its name only when complete."""

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import EllipsisType
from typing import Any

import numpy as np
import zarr
from jaxtyping import Int
from pydantic import ValidationError
from zarr.codecs import Crc32cCodec, ZstdCodec
from zarr.storage import MemoryStore

from flowlab.config import Settings, explain
from flowlab.errors import DataError, RecordError, first_line
from flowlab.files import new_file
from flowlab.geometry.camera import Camera
from flowlab.records import Entity, Episode, Quality, Queries, Role, Tracks3D
from flowlab.storage.schema import EPISODE_ENDS, POSES, QUALITY, SCHEMA, SCHEMA_VERSION, SIGHT, ArraySpec
from flowlab.storage.shard_files import open_files, write_zip
from flowlab.storage.stored_array import StoredArray, stored_array
from flowlab.text import counted, shown
from flowlab.untrusted import parse_json

STEPS_PER_CHUNK = 256
"""A chunk holds at most this many rows; most episodes are one chunk per array."""
PICTURES_PER_CHUNK_BYTES = 1 << 20
"""A chunk of pictures holds no more than this, but one picture at least, so that a single one is read quickly. Smaller
chunks would take more room: pictures of a scene that hardly changes are compressed together."""


def write_shard(path: Path, episodes: Sequence[Episode], settings_digest: str) -> None:
    """Write episodes to ``path``, replacing what a run that left no receipt may have put there.

    Whatever ends the process, ``path`` is either absent or whole. Chunks carry a CRC-32C checksum, files a CRC-32.

    Raises:
        DataError: The episodes do not share their camera, their entities or which arrays they have.
        OSError: It cannot be written.
    """
    files = _encode(episodes, settings_digest)
    path.parent.mkdir(parents=True, exist_ok=True)
    with new_file(path) as temporary:
        write_zip(temporary, files)


def episode_digest(episode: Episode) -> str:
    """SHA-256 of everything stored of an episode, whatever shard it lies in."""
    about = [episode.task, episode.camera.to_json(), _entities_to_json(episode), dict(episode.extras)]
    digest = hashlib.sha256(json.dumps(about, sort_keys=True).encode())
    for spec in SCHEMA:
        values = spec.of(episode)
        if values is not None:
            digest.update(f"{spec.path} {values.shape}".encode())
            digest.update(np.ascontiguousarray(values, spec.dtype).data)
    return digest.hexdigest()


class _EpisodeAttributes(Settings):
    task: str
    extras: Mapping[str, Any] = {}


class ShardAttributes(Settings):
    """What a shard says of its episodes beside their arrays."""

    flowlab_schema: int
    settings_digest: str
    camera: Mapping[str, Any]
    entities: tuple[tuple[str, str, str], ...]
    """Geom, body and role of each."""
    episodes: tuple[_EpisodeAttributes, ...]


class Shard:
    """A shard opened for reading."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._files = open_files(path)
            group = parse_json(self._files.read("zarr.json"), f"{path}/zarr.json")
        except DataError as error:
            raise DataError(f"{error}; {REPAIR}") from error
        about = group.get("attributes") if isinstance(group, dict) else None
        try:
            self.attributes = ShardAttributes.model_validate(about)
        except ValidationError as error:
            raise DataError(f"{path}: not a shard of flowlab ({explain(error, ShardAttributes)}); {REPAIR}") from error

    def __len__(self) -> int:
        return len(self.attributes.episodes)

    @property
    def camera(self) -> Camera | None:
        """The camera of all episodes; None where it moves."""
        return None if f"{POSES}/zarr.json" in self._files else Camera.from_json(self.attributes.camera)

    def about(self, k: int) -> Mapping[str, Any]:
        """The ``extras`` of the k-th episode."""
        return self.attributes.episodes[k].extras

    def array(self, spec_path: str, rows: slice | int | EllipsisType = ...) -> np.ndarray:
        """An array, or some rows of it; a missing or damaged chunk is an error, never silent zeros."""
        try:
            return stored_array(self._files, spec_path).read(self._files, rows)
        except DataError as error:
            raise DataError(f"{error}; {REPAIR}") from error

    def stored(self, spec_path: str) -> StoredArray:
        """An array, its values unread."""
        try:
            return stored_array(self._files, spec_path)
        except DataError as error:
            raise DataError(f"{error}; {REPAIR}") from error

    def take(self, array: StoredArray, rows: Int[np.ndarray, "T"]) -> np.ndarray:
        """Some rows of an array, in any order: no other chunks are read than theirs."""
        try:
            return array.take(self._files, rows)
        except DataError as error:
            raise DataError(f"{error}; {REPAIR}") from error

    def has(self, spec: ArraySpec) -> bool:
        """Whether the shard holds an array."""
        return f"{spec.path}/zarr.json" in self._files

    def specs(self) -> list[ArraySpec]:
        """The arrays that the shard holds, or must hold."""
        estimated = any(f"{path}/zarr.json" in self._files for path in QUALITY)
        return [s for s in SCHEMA if self.has(s) or not s.optional or (estimated and s.path in QUALITY)]

    def describe(self) -> list[StoredArray]:
        """Every array, its values unread."""
        paths = [*(s.path for s in SCHEMA if self.has(s)), EPISODE_ENDS]
        try:
            return [stored_array(self._files, path) for path in paths]
        except DataError as error:
            raise DataError(f"{error}; {REPAIR}") from error

    def rows(self) -> list[slice]:
        """The rows of each episode in the ``data`` arrays."""
        ends = self.array(EPISODE_ENDS).tolist()
        if len(ends) != len(self) or sorted({0, *ends}) != [0, *ends]:
            raise DataError(
                f"{self.path}/{EPISODE_ENDS}: damaged ({shown(ends)} for {counted(len(self), 'episode')}); {REPAIR}"
            )
        return [slice(start, end) for start, end in zip([0, *ends[:-1]], ends, strict=True)]

    def episodes(self) -> Iterator[Episode]:
        """Every episode of the shard."""
        return self.episodes_of({s.path: self.array(s.path) for s in self.specs()})

    def episodes_of(self, columns: Mapping[str, np.ndarray]) -> Iterator[Episode]:
        """Every episode of the shard, whose arrays have been read."""
        for k, rows in enumerate(self.rows()):
            yield self._episode(k, {p: a[rows] if p.startswith("data/") else a[k] for p, a in columns.items()})

    def episode(self, k: int) -> Episode:
        """The k-th episode; reads only its chunks."""
        rows = self.rows()[k]
        columns = {s.path: self.array(s.path, rows if s.per_step else k) for s in self.specs()}
        return self._episode(k, columns)

    def _episode(self, k: int, columns: Mapping[str, np.ndarray]) -> Episode:
        try:
            return self._decode(k, columns)
        except (RecordError, KeyError, TypeError, ValueError) as error:
            raise DataError(f"{self.path}: episode {k} is damaged ({first_line(error)}); {REPAIR}") from error

    def _decode(self, k: int, columns: Mapping[str, np.ndarray]) -> Episode:
        about = self.attributes.episodes[k]
        entities = tuple(Entity(g, b, Role[r.upper()]) for g, b, r in self.attributes.entities)
        return Episode(
            task=about.task,
            seed=int(columns["meta/seed"]),
            camera=Camera.from_json(self.attributes.camera),
            time_s=columns["data/time"],
            point_cloud=columns["data/point_cloud"],
            point_count=columns["data/point_count"],
            state=columns["data/state"],
            action=columns["data/action"],
            success=columns["data/success"],
            queries=Queries(
                columns["meta/query_xyz"], columns["meta/query_owner"], int(columns["meta/query_count"]), entities
            ),
            tracks=Tracks3D(
                columns["data/tracks"], columns["data/visible"], columns["meta/association_distance"], _quality(columns)
            ),
            object_pose=columns.get("data/object_pose"),
            depth=columns.get("data/depth"),
            rgb=columns.get("data/rgb"),
            extras=about.extras,
            T_world_cam=columns.get(POSES),
            state_sigma=columns.get("data/state_sigma"),
            action_sigma=columns.get("data/action_sigma"),
        )


def _quality(columns: Mapping[str, np.ndarray]) -> Quality | None:
    if not any(path in columns for path in QUALITY):
        return None
    return Quality(**{path.removeprefix("data/"): columns[path] for path in QUALITY}, sight=columns.get(SIGHT))


REPAIR = "run the command that made the dataset again, with --repair: it makes this unit anew"


def _entities_to_json(episode: Episode) -> list[list[str]]:
    return [[e.geom, e.body, e.role.name.lower()] for e in episode.queries.entities]


_SHARED: dict[str, Callable[[Episode], object]] = {
    "camera": lambda e: e.camera.to_json(),
    "entities": lambda e: e.queries.entities,
    "arrays": lambda e: [spec.path for spec in SCHEMA if spec.of(e) is not None],
}
"""What a shard holds once for all of its episodes."""


def _encode(episodes: Sequence[Episode], settings_digest: str) -> dict[str, bytes]:
    """The files of a shard, by relative path."""
    first = episodes[0]
    for name, of in _SHARED.items():
        if any(of(e) != of(first) for e in episodes):
            raise DataError(f"the episodes of one shard must share their {name}")
    store: dict[str, Any] = {}
    group = zarr.create_group(
        MemoryStore(store),
        zarr_format=3,
        attributes={
            "flowlab_schema": SCHEMA_VERSION,
            "settings_digest": settings_digest,
            "camera": first.camera.to_json(),
            "entities": _entities_to_json(first),
            "episodes": [{"task": e.task, "extras": dict(e.extras)} for e in episodes],
        },
    )
    for spec in SCHEMA:
        parts = [part for e in episodes if (part := spec.of(e)) is not None]
        if parts:  # all of them, or an optional array that none has
            whole = np.concatenate(parts) if len(parts) > 1 else parts[0]  # pictures are large
            _write(group, spec.path, whole.astype(spec.dtype, copy=False), spec.dims, spec.unit, spec.meaning)
    ends = np.cumsum([len(e) for e in episodes], dtype=np.int64)
    _write(group, EPISODE_ENDS, ends, ("episode",), "1", "the row after each episode's last")
    return {name: content.to_bytes() for name, content in store.items()}


def _write(group: zarr.Group, path: str, values: np.ndarray, dims: tuple[str, ...], unit: str, meaning: str) -> None:
    most = max(1, PICTURES_PER_CHUNK_BYTES // values[:1].nbytes) if "u" in dims and values.size else STEPS_PER_CHUNK
    group.create_array(
        path,
        data=values,
        chunks=(max(1, min(len(values), STEPS_PER_CHUNK, most)), *(max(1, n) for n in values.shape[1:])),
        compressors=[ZstdCodec(level=1), Crc32cCodec()],
        dimension_names=dims,
        attributes={"unit": unit, "meaning": meaning},
        config={"write_empty_chunks": True},  # so that a missing chunk always means damage
    )
