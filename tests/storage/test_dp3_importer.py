"""Stores in DP3's layout are read as demonstrations: flowlab's own exports, and what DP3's scripts write."""

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from numcodecs import Blosc
from synthetic import assert_same, make_dataset, make_episode, make_filmed_episode

from flowlab.errors import DataError
from flowlab.geometry.camera import Camera
from flowlab.storage import stats
from flowlab.storage.exporters.dp3 import DP3Exporter
from flowlab.storage.importers.dp3 import DP3Store, count_points

Arrays = dict[str, np.ndarray]


def make_arrays(lengths: tuple[int, ...] = (120, 90, 45), points: int = 32, channels: int = 6) -> Arrays:
    """What DP3's demonstration script keeps of a task: clouds with colors from 0 to 255 behind xyz."""
    rng = np.random.default_rng(0)
    steps = sum(lengths)
    xyz, rgb = rng.uniform(-1, 1, (steps, points, 3)), rng.integers(0, 256, (steps, points, 3))
    return {
        "data/img": rng.integers(0, 256, (steps, 8, 8, 3)).astype(np.uint8),
        "data/state": rng.normal(size=(steps, 9)).astype(np.float32),
        "data/full_state": rng.normal(size=(steps, 39)).astype(np.float32),
        "data/point_cloud": np.concatenate([xyz, rgb], -1)[..., :channels].astype(np.float32),
        "data/depth": rng.random((steps, 8, 8)).astype(np.float32),
        "data/action": rng.uniform(-1, 1, (steps, 4)).astype(np.float32),
        "meta/episode_ends": np.cumsum(lengths),
    }


def write_v2(store: Path, arrays: Arrays) -> Path:
    """A zarr v2 store file by file, as the format's specification says; chunks and compression are DP3's."""
    codec = Blosc(cname="zstd", clevel=3, shuffle=Blosc.SHUFFLE)
    for group in (store, store / "data", store / "meta"):
        group.mkdir(parents=True, exist_ok=True)
        (group / ".zgroup").write_text('{"zarr_format": 2}')
    for name, values in arrays.items():
        chunks = (100 if name.startswith("data") else len(values), *values.shape[1:])
        meta = {
            "zarr_format": 2, "shape": values.shape, "chunks": chunks, "dtype": values.dtype.str, "order": "C",
            "compressor": codec.get_config(), "fill_value": 0, "filters": None,
        }  # fmt: skip
        (store / name).mkdir()
        (store / name / ".zarray").write_text(json.dumps(meta))
        for k, start in enumerate(range(0, len(values), chunks[0])):
            chunk = np.zeros(chunks, values.dtype)
            rows = values[start : start + chunks[0]]
            chunk[: len(rows)] = rows
            file = store / name / ".".join([str(k)] + ["0"] * (values.ndim - 1))
            file.write_bytes(codec.encode(chunk))
    return store


def test_an_export_of_flowlab_is_read_back(tmp_path: Path) -> None:
    made = [make_episode(k, task=task, steps=40 + 33 * k) for task in ("push", "roll") for k in range(3)]
    DP3Exporter().export(make_dataset(tmp_path / "d", [made[:3], made[3:]]), tmp_path / "all.zarr")
    assert DP3Store.looks_like(tmp_path / "all.zarr")
    store = DP3Store(tmp_path / "all.zarr")
    assert (store.path, store.task, len(store)) == (tmp_path / "all.zarr", "all", 6)
    assert store.frames == tuple(len(e) for e in made)
    for k, (read, episode) in enumerate(zip(store.episodes(), made, strict=True)):
        for name in ("state", "action", "point_cloud", "point_count"):
            assert_same(getattr(read, name), getattr(episode, name), name)
        assert (read.task, read.seed) == ("all", k)


def test_a_store_of_dp3_is_read_without_its_colors(tmp_path: Path) -> None:
    arrays = make_arrays()
    store = DP3Store(write_v2(tmp_path / "metaworld_hammer_expert.zarr", arrays))
    assert (store.task, store.frames) == ("metaworld_hammer_expert", (120, 90, 45))
    for episode, rows in zip(store.episodes(), (slice(120), slice(120, 210), slice(210, 255)), strict=True):
        assert_same(episode.point_cloud, np.ascontiguousarray(arrays["data/point_cloud"][rows, :, :3]))
        assert_same(episode.state, arrays["data/state"][rows])
        assert_same(episode.action, arrays["data/action"][rows])
        assert_same(episode.point_count, np.full(len(episode), 32, np.int32))


def test_what_a_store_does_not_tell_is_left_empty(tmp_path: Path) -> None:
    store = DP3Store(write_v2(tmp_path / "s", make_arrays()))
    first, *_ = episodes = list(store.episodes())
    assert first.success.tolist() == [False] * 120
    assert first.queries.count == 0
    assert (first.queries.xyz_world.shape, first.query_role.shape) == ((0, 3), (0,))
    assert (first.tracks.xyz_world.shape, first.tracks.visible.shape) == ((120, 0, 3), (120, 0))
    assert first.tracks.association_distance.shape == (0,)
    assert (first.tracks.quality, first.object_pose, first.depth, first.rgb) == (None, None, None, None)
    assert first.time_s.tolist() == list(range(120))
    assert_same(first.camera, Camera(1, 1, np.eye(3), np.eye(4)))
    described = stats.describe(stats.summarize(episodes))
    assert described["episodes"] == 3
    assert described["arrays"].keys() == {"point_cloud", "state", "action"}


def test_episodes_are_read_one_at_a_time(tmp_path: Path) -> None:
    store = DP3Store(write_v2(tmp_path / "s", make_arrays((100, 100, 100))))
    reading = store.episodes()
    next(reading)
    (tmp_path / "s/data/state/1.0").write_bytes(b"worn out")
    with pytest.raises(DataError, match=r"s/data/state/1.0: damaged \(.+\); write the store anew"):
        next(reading)


def test_zeros_at_the_end_of_a_cloud_are_padding() -> None:
    clouds = np.ones((5, 4, 3), np.float32)
    clouds[1, 2:] = 0  # two points, then padding
    clouds[2, 1] = 0  # a point in the origin, between others
    clouds[3] = 0  # nothing was seen
    clouds[4, 3, :2] = 0  # the last point lies on an axis
    assert count_points(clouds).tolist() == [4, 2, 4, 1, 4]
    assert count_points(clouds).dtype == np.int32


def test_stored_numbers_of_any_type_become_float32(tmp_path: Path) -> None:
    arrays = make_arrays(channels=3)
    arrays["data/state"] = np.arange(255 * 2).reshape(255, 2)
    arrays["data/point_cloud"] = arrays["data/point_cloud"].astype(float)
    episode = next(DP3Store(write_v2(tmp_path / "s", arrays)).episodes())
    assert_same(episode.state, np.arange(240, dtype=np.float32).reshape(120, 2))
    assert episode.point_cloud.dtype == np.float32


def test_the_fingerprint_is_that_of_the_content(tmp_path: Path) -> None:
    arrays = make_arrays()
    fingerprint = DP3Store(write_v2(tmp_path / "a", arrays)).fingerprint
    assert re.fullmatch("[0-9a-f]{16}", fingerprint)
    group = zarr.create_group(tmp_path / "b", zarr_format=2)
    for name in ("data/state", "data/action", "data/point_cloud", "meta/episode_ends"):
        chunks = (70, *arrays[name].shape[1:])
        group.create_array(name, data=arrays[name], chunks=chunks, compressors=None)
    assert DP3Store(tmp_path / "b").fingerprint == fingerprint, "chunks, compression and further arrays are no content"
    seen = {fingerprint}
    for k, name in enumerate(("data/state", "data/action", "data/point_cloud")):
        changed = arrays | {name: arrays[name].copy()}
        changed[name][-1] += 1
        seen.add(DP3Store(write_v2(tmp_path / f"c{k}", changed)).fingerprint)
    ends = arrays | {"meta/episode_ends": np.array([120, 211, 255])}
    seen.add(DP3Store(write_v2(tmp_path / "c3", ends)).fingerprint)
    assert len(seen) == 5, "a change of any array is another content"


def test_only_stores_look_like_stores(tmp_path: Path) -> None:
    dataset = make_dataset(tmp_path / "d", [[make_episode()]])
    write_v2(tmp_path / "s", make_arrays())
    shutil.copytree(tmp_path / "s", tmp_path / "half")
    shutil.rmtree(tmp_path / "half/meta")
    (tmp_path / "file").touch()
    places = {"s": True, "half": True, "d": False, f"d/{dataset.receipts[0].shard}": False, "file": False, "no": False}
    assert {place: DP3Store.looks_like(tmp_path / place) for place in places} == places


def test_the_task_is_named_after_the_folder_from_wherever_one_looks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(write_v2(tmp_path / "push.zarr", make_arrays()))
    assert DP3Store(".").task == "push"


def _put(name: str, change: Callable[[np.ndarray], Any]) -> Callable[[Arrays], None]:
    def apply(arrays: Arrays) -> None:
        arrays[name] = np.asarray(change(arrays[name]))

    return apply


def _with(row: int, value: float) -> Callable[[np.ndarray], np.ndarray]:
    def change(values: np.ndarray) -> np.ndarray:
        values = values.astype(float)
        values[row, ..., 0] = value
        return values

    return change


SHAPES = [
    (_put("data/state", lambda a: a[:, 0]), r"data/state: the shape is \(255,\), expected 2 dimensions"),
    (_put("data/action", lambda a: a[:, None]), r"data/action: the shape is \(255, 1, 4\), expected 2 dim"),
    (_put("data/point_cloud", lambda a: a[..., :2]), "data/point_cloud: points of 2 numbers, expected xyz first"),
    (_put("data/state", lambda a: a[:-1]), r"differ in their number of steps \(data/state 254, data/action 255, data/"),
    (_put("data/action", lambda a: a > 0), "data/action: values of type '|b1', expected numbers"),
    (_put("meta/episode_ends", lambda a: [120, 120, 255]), "episode 1 starts at row 120 and ends at row 120"),
    (_put("meta/episode_ends", lambda a: [0, 120, 255]), "episode 0 starts at row 0 and ends at row 0"),
    (_put("meta/episode_ends", lambda a: [120, 90, 255]), "episode 1 starts at row 120 and ends at row 90, expected"),
    (_put("meta/episode_ends", lambda a: [120, 256]), "the last episode ends at row 256, and the data at row 255"),
    (_put("meta/episode_ends", lambda a: [120, 210]), "the last episode ends at row 210, and the data at row 255"),
    (_put("meta/episode_ends", lambda a: a[:, None]), r"int64 of shape \(3, 1\), expected a row number for each"),
    (_put("meta/episode_ends", lambda a: a / 1.0), r"float64 of shape \(3,\), expected a row number for each"),
]


@pytest.mark.parametrize(("change", "sentence"), SHAPES)
def test_a_store_that_does_not_fit_together_is_refused(
    tmp_path: Path, change: Callable[[Arrays], None], sentence: str
) -> None:
    arrays = make_arrays()
    change(arrays)
    with pytest.raises(DataError, match=f"^{tmp_path}/s.*{sentence}"):
        DP3Store(write_v2(tmp_path / "s", arrays))


VALUES = [
    (_put("data/state", _with(130, np.nan)), "data/state: 1 of the 90 steps of episode 1 .* the first in row 130"),
    (_put("data/action", _with(210, np.inf)), "data/action: 1 of the 45 steps of episode 2 .* the first in row 210"),
    (_put("data/point_cloud", _with(0, -np.inf)), "data/point_cloud: 1 of the 120 steps of episode 0"),
    (_put("data/state", _with(3, 1e300)), "data/state: 1 of the 120 steps of episode 0 .* not finite"),
]


@pytest.mark.parametrize(("change", "sentence"), VALUES)
def test_values_that_are_not_finite_are_refused(
    tmp_path: Path, change: Callable[[Arrays], None], sentence: str
) -> None:
    arrays = make_arrays()
    change(arrays)
    store = DP3Store(write_v2(tmp_path / "s", arrays))
    with pytest.raises(DataError, match=f"^{tmp_path}/s/{sentence}"):
        list(store.episodes())


def test_colors_need_not_be_finite(tmp_path: Path) -> None:
    arrays = make_arrays()
    arrays["data/point_cloud"][..., 4] = np.nan
    assert len(list(DP3Store(write_v2(tmp_path / "s", arrays)).episodes())) == 3


def test_the_arrays_there_are_and_should_be_are_named(tmp_path: Path) -> None:
    arrays = make_arrays()
    del arrays["data/point_cloud"]
    write_v2(tmp_path / "s", arrays)
    expected = (
        f"{tmp_path}/s: the array data/point_cloud is missing, there are: data/action, data/depth, data/full_state, "
        "data/img, data/state, meta/episode_ends; a store in DP3's layout has data/state, data/action, "
        "data/point_cloud, meta/episode_ends"
    )
    with pytest.raises(DataError) as caught:
        DP3Store(tmp_path / "s")
    assert str(caught.value) == expected


def test_damage_is_told(tmp_path: Path) -> None:
    store = write_v2(tmp_path / "s", make_arrays())
    with pytest.raises(DataError, match=f"^{tmp_path}/no: there is no zarr v2 store here$"):
        DP3Store(tmp_path / "no")
    (store / "data/point_cloud/1.0.0").unlink()
    with pytest.raises(DataError, match="data/point_cloud: 1 of 3 chunks missing; write the store anew"):
        DP3Store(store)
    (store / "data/point_cloud/.zarray").write_text("{")
    with pytest.raises(
        DataError, match=r"data/point_cloud/.zarray: not valid JSON \(Expecting property name.+\); write"
    ):
        DP3Store(store)
    (store / ".zgroup").write_text("{")
    with pytest.raises(DataError, match=f"^{tmp_path}/s/.zgroup: not valid JSON"):
        DP3Store(store)


def test_states_that_are_all_zero_are_no_damage(tmp_path: Path) -> None:
    """Today's zarr leaves chunks of zeros out."""
    episode = make_filmed_episode()
    assert not episode.state.any()
    DP3Exporter().export(make_dataset(tmp_path / "d", [[episode, replace(episode, seed=4)]]), tmp_path / "s")
    assert not (tmp_path / "s/data/state/0.0").exists()
    assert [e.state.tolist() for e in DP3Store(tmp_path / "s").episodes()] == [np.zeros((12, 7)).tolist()] * 2


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"shape": [10**12, 9]}, "claims the shape"),
        ({"chunks": [10**9, 9]}, "claims the shape"),
        ({"shape": [10**9, 9], "chunks": [1, 9]}, "claims the shape"),
        ({"shape": [-1, 9]}, r"'shape' is \[-1, 9\], expected whole numbers from 0 on"),
        ({"chunks": [0, 9]}, r"'chunks' is \[0, 9\], expected whole numbers from 1 on"),
        ({"filters": [{"id": "pickle"}]}, r"is stored by \[\{'id': 'pickle'\}\], expected numbers as they are"),
        ({"compressor": {"id": "zlib", "level": 1}}, "is stored by"),
        ({"dtype": "|O"}, r"values of type '\|O', expected numbers"),
        ({"dimension_separator": "../"}, "'dimension_separator' is"),
    ],
)
def test_what_an_array_may_not_claim(tmp_path: Path, change: dict[str, Any], sentence: str) -> None:
    store = write_v2(tmp_path / "s", make_arrays((4, 3), points=4))
    about = store / "data/state/.zarray"
    about.write_text(json.dumps({**json.loads(about.read_text()), **change}))
    with pytest.raises(DataError, match=sentence):
        DP3Store(store)


def test_a_chunk_that_unpacks_to_more_is_refused_on_its_header(tmp_path: Path) -> None:
    store = write_v2(tmp_path / "s", make_arrays((4, 3), points=4))
    (store / "data/state/0.0").write_bytes(Blosc(cname="zstd").encode(np.zeros(1 << 26, np.uint8)))
    with pytest.raises(DataError, match="it unpacks to 67,108,864 bytes, expected 3,600"):
        next(DP3Store(store).episodes())
