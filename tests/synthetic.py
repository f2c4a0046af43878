"""Small episodes made by hand: a ball rolls over a plate, and every point lies on one of the two."""

import json
import zipfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flowlab.checksums import sha256_of
from flowlab.cli import main
from flowlab.geometry.camera import Camera
from flowlab.provenance import Provenance
from flowlab.records import Entity, Episode, PositionSource, Quality, Queries, Role, Sight, Tracks3D
from flowlab.storage import stats
from flowlab.storage.dataset import Dataset, begin, summarize
from flowlab.storage.manifest import MANIFEST, Manifest
from flowlab.storage.receipts import Receipt, keep_receipt, shard_path
from flowlab.storage.shard import episode_digest, write_shard

ENTITIES = (Entity("plate", "plate", Role.PROP), Entity("ball", "ball", Role.OBJECT))
LOOKING_DOWN = np.array([[1.0, 0, 0, 0], [0, -1, 0, 0.5], [0, 0, -1, 1], [0, 0, 0, 1]])
CAMERA = Camera.from_fovy(16, 12, 45.0, LOOKING_DOWN)
SETTINGS = {"observer": {"points": 64}, "queries": {"points": 8}}


def make_episode(
    seed: int = 0,
    *,
    task: str = "roll",
    steps: int = 12,
    points: int = 64,
    queries: int = 8,
    object_pose: bool = True,
    depth: bool = False,
    rgb: bool = False,
) -> Episode:
    """The ball (radius 5 cm) rolls 1 cm a step along x and turns with it; the plate lies still at z = 0."""
    rng = np.random.default_rng(seed)
    t = np.arange(steps)
    center = np.stack([-0.2 + 0.01 * t, np.full(steps, rng.uniform(0.4, 0.6)), np.full(steps, 0.05)], -1)
    c, s, o, one = np.cos(t / 5), np.sin(t / 5), 0.0 * t, 1 + 0.0 * t
    turn = np.stack([np.stack([c, o, s], -1), np.stack([o, one, o], -1), np.stack([-s, o, c], -1)], -2)
    on_ball = points // 2
    direction = rng.normal(size=(on_ball, 3))
    ball = 0.05 * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    plate = np.append(rng.uniform([-0.4, 0.2], [0.4, 0.8], (points - on_ball, 2)), np.zeros((points - on_ball, 1)), 1)
    moved = np.einsum("tij,mj->tmi", turn, ball) + center[:, None]
    cloud = np.concatenate([moved, np.broadcast_to(plate, (steps, *plate.shape))], 1).astype(np.float32)
    chosen = rng.integers(0, points, queries)
    tracks = cloud[:, chosen]
    return Episode(
        task=task,
        seed=seed,
        camera=CAMERA,
        time_s=t / 80,
        point_cloud=cloud,
        point_count=np.full(steps, points, np.int32),
        state=rng.normal(size=(steps, 9)).astype(np.float32),
        action=rng.uniform(-1, 1, (steps, 4)).astype(np.float32),
        success=t >= steps - 5,
        queries=Queries(tracks[0], (chosen < on_ball).astype(np.int16), queries, ENTITIES),
        tracks=Tracks3D(tracks, rng.random((steps, queries)) < 0.9, np.zeros(queries, np.float32)),
        object_pose=np.concatenate([center, turn[..., 0], turn[..., 1]], -1).astype(np.float32)
        if object_pose
        else None,
        depth=rng.uniform(0.5, 1, (steps, 12, 16)).astype(np.float32) if depth else None,
        rgb=rng.integers(0, 256, (steps, 12, 16, 3)).astype(np.uint8) if rgb else None,
        extras={"rand_vec": rng.normal(size=3).tolist()},
    )


def make_receipt(episodes: Sequence[Episode], **changes: Any) -> Receipt:
    """The receipt of a unit that made these episodes of one task."""
    first, last = episodes[0], episodes[-1]
    values: dict[str, Any] = {
        "unit": f"{first.task}-{first.seed:06d}-{last.seed:06d}",
        "task": first.task,
        "seeds": tuple(e.seed for e in episodes),
        "accepted": tuple(e.seed for e in episodes),
        "frames": tuple(len(e) for e in episodes),
        "digests": tuple(episode_digest(e) for e in episodes),
        "stats": stats.summarize(episodes),
    }
    return Receipt(**{**values, **changes})


def make_provenance(settings: Mapping[str, Any] = SETTINGS, **changes: Any) -> Provenance:
    """What the built-in stages of these settings would say: simulated by MetaWorld where an expert is among them."""
    values: dict[str, Any] = {
        "kind": "recorded",
        "world_frame": "z up",
        "camera": CAMERA.to_json(),
        "observer": settings.get("observer"),
        "queries": settings.get("queries"),
        "tracks": "exact",
    }
    if "track" in settings:
        values |= {"tracks": "estimated", "tracker": settings["track"].get("tracker", "rigid-bodies")}
    if "expert" in settings:
        from flowlab.sim.scene_settings import SceneSettings, describe_scene

        values |= describe_scene(SceneSettings.model_validate(settings["expert"].get("scene", {})))
    return Provenance(**{**values, **changes})


def make_manifest(requested: dict[str, int], **changes: Any) -> Manifest:
    values: dict[str, Any] = {
        "recipe": "by-hand",
        "settings": SETTINGS,
        "provenance": make_provenance(changes.get("settings", SETTINGS)),
        "first_seed": 0,
        "requested": requested,
    }
    return Manifest(**{**values, **changes})


def make_dataset(folder: Path, units: Iterable[Sequence[Episode]], **changes: Any) -> Dataset:
    """A complete dataset with one shard for each group of episodes."""
    units = list(units)
    requested: dict[str, int] = {}
    for unit in units:
        requested[unit[0].task] = requested.get(unit[0].task, 0) + len(unit)
    manifest = begin(folder, make_manifest(requested, **changes))
    for unit in units:
        put_unit(folder, unit, manifest.settings_digest)
    return summarize(folder)


def put_unit(folder: Path, episodes: Sequence[Episode], settings_digest: str, **changes: Any) -> Receipt:
    """Write a unit's shard and its receipt."""
    receipt = make_receipt(episodes, **changes)
    path = folder / shard_path("shards", receipt.unit)
    write_shard(path, episodes, settings_digest)
    receipt = receipt.model_copy(update={"shard_sha256": sha256_of(path)})
    keep_receipt(folder, receipt)
    return receipt


def unzipped(shard: Path) -> Path:
    """The shard as the folder that it would have been before schema version 2, in place of the zip."""
    folder = shard.with_suffix("")
    with zipfile.ZipFile(shard) as archive:
        archive.extractall(folder)
    shard.unlink()
    return folder


def edit_json(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change the values of a JSON file, which has no checksum then, as if an earlier flowlab had written it."""
    values = json.loads(path.read_text())
    values.pop("sha256", None)
    change(values)
    path.write_text(json.dumps(values))


def as_folders(dataset: Path) -> Path:
    """A dataset whose shards are folders, as before schema version 2: its files can be damaged one by one."""
    for place, key in ("shards", "shard_sha256"), ("rejects", "rejects_sha256"):
        for shard in (dataset / place).glob("*.zip"):
            unzipped(shard)
            edit_json(dataset / "receipts" / f"{shard.name.partition('.')[0]}.json", lambda r, k=key: r.update({k: ""}))
    edit_json(dataset / MANIFEST, lambda m: m.update(schema_version=1))
    return dataset


def assert_same(a: Any, b: Any, where: str = "episode") -> None:
    """Two records are the same to the last bit, types and shapes included."""
    assert type(a) is type(b), f"{where}: {type(a)} and {type(b)}"
    if isinstance(a, np.ndarray):
        assert (a.dtype, a.shape) == (b.dtype, b.shape), where
        assert a.tobytes() == b.tobytes(), f"{where} differs"
    elif is_dataclass(a):
        for field in fields(a):
            assert_same(getattr(a, field.name), getattr(b, field.name), f"{where}.{field.name}")
    else:
        assert a == b, where


def files_below(folder: Path) -> dict[str, tuple[bytes, int]]:
    """Content and time of change of every file."""
    return {
        str(f.relative_to(folder)): (f.read_bytes(), f.stat().st_mtime_ns) for f in folder.rglob("*") if f.is_file()
    }


def with_tracks(episode: Episode, xyz_world: np.ndarray) -> Episode:
    """The episode with other tracks, its queries where they start."""
    return replace(
        episode,
        tracks=replace(episode.tracks, xyz_world=xyz_world),
        queries=replace(episode.queries, xyz_world=xyz_world[0]),
    )


def call_cli(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> tuple[int, str, str]:
    """Exit code, output and error output of the command line, run here: quick, and any traceback is a failure."""
    capsys.readouterr()
    code: Any = 0
    try:
        main(*map(str, arguments))
    except SystemExit as end:
        code = end.code
    return code, *capsys.readouterr()


def with_quality(episode: Episode, seed: int = 0) -> Episode:
    """The episode as if its tracks had been estimated: measured where visible, else modeled or filled."""
    rng = np.random.default_rng(seed)
    visible = episode.tracks.visible
    shape = visible.shape
    hidden = rng.choice([PositionSource.MODEL, PositionSource.FILLED], shape)
    quality = Quality(
        sigma=rng.uniform(0.001, 0.02, shape).astype(np.float32),
        source=np.where(visible, PositionSource.MEASURED, hidden).astype(np.uint8),
        depth_valid=visible | (rng.random(shape) < 0.1),
        forward_backward=np.where(rng.random(shape) < 0.2, -1, rng.uniform(0, 2, shape)).astype(np.float32),
        disagreement=np.where(rng.random(shape) < 0.2, -1, rng.uniform(0, 2, shape)).astype(np.float32),
        residual=np.where(rng.random(shape) < 0.2, -1, rng.uniform(0, 1, shape)).astype(np.float32),
        sight=np.where(visible, Sight.SEEN, rng.choice([Sight.COVERED, Sight.OUT_OF_VIEW], shape)).astype(np.uint8),
    )
    return replace(episode, tracks=replace(episode.tracks, quality=quality))


LOOKING_ALONG_Y = np.array([[1.0, 0, 0, 0], [0, 0, 1, -1], [0, -1, 0, 0], [0, 0, 0, 1]])


def make_filmed_episode(T_world_cam: np.ndarray | None = None, *, steps: int = 12, seed: int = 3) -> Episode:
    """As if from a recording: roles are not known, and without a pose the world is the camera's frame.

    Before a gray wall 1 m away, by point: 0 is sure and goes right by a pixel a step, 1 is unsure and goes
    down, 2 was filled in, 3 is out of sight, 4 is behind the camera, and 5 repeats 4 wherever padding may lie.
    """
    camera = Camera.from_fovy(80, 60, 50.0, np.eye(4) if T_world_cam is None else T_world_cam)
    t = np.arange(steps)
    uv = np.broadcast_to([[20.0, 12], [60, 10], [30, 40], [50, 45], [40, 30], [70, 52]], (steps, 6, 2)).copy()
    uv[:, 0, 0] += t
    uv[:, 1, 1] += t
    z = np.broadcast_to([1.0, 1, 1, 1, -1, 1], (steps, 6))
    tracks = camera.unproject(uv, z).astype(np.float32)
    visible = np.tile([True, True, False, False, False, True], (steps, 1))
    source = [
        PositionSource.MEASURED,
        PositionSource.MEASURED,
        PositionSource.FILLED,
        PositionSource.MODEL,
        PositionSource.MODEL,
        PositionSource.MEASURED,
    ]
    unmeasured = np.full((steps, 6), -1, np.float32)
    quality = Quality(
        sigma=np.tile(np.array([0.001, 0.06, 0.02, 0.02, 0.02, 0], np.float32), (steps, 1)),
        source=np.tile(np.array(source, np.uint8), (steps, 1)),
        depth_valid=visible,
        forward_backward=unmeasured,
        disagreement=unmeasured,
        residual=unmeasured,
    )
    v, u = np.mgrid[2:60:8, 2:80:8].reshape(2, -1)
    wall = camera.unproject(np.stack([u, v], -1), np.ones(len(u))).astype(np.float32)
    rgb = np.full((steps, 60, 80, 3), 128, np.uint8)
    return Episode(
        task="pour",
        seed=seed,
        camera=camera,
        time_s=t / 10,
        point_cloud=np.broadcast_to(wall, (steps, *wall.shape)).copy(),
        point_count=np.full(steps, len(wall), np.int32),
        state=np.zeros((steps, 7), np.float32),
        action=np.zeros((steps, 8), np.float32),
        success=t == steps - 1,
        queries=Queries(tracks[0], np.full(6, -1, np.int16), 5),
        tracks=Tracks3D(tracks, visible, np.zeros(6, np.float32), quality),
        depth=np.ones((steps, 60, 80), np.float32),
        rgb=rgb,
        extras={"source": "pour-3", "tracker": {"tracker": "rigid-bodies", "license": "Apache-2.0", "options": {}}},
    )
