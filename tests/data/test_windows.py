"""Windows for anybody's own training hold what the episodes say, whoever reads them."""

import json
import pickle
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import google_crc32c
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numcodecs.zstd import compress
from synthetic import LOOKING_DOWN, assert_same, make_dataset, make_episode, make_provenance, with_quality
from thoroughness import examples
from torch.utils.data import DataLoader

import flowlab
from flowlab.data import Windows, window_pictures
from flowlab.errors import DataError, FlowlabError, UsageError
from flowlab.geometry.camera import Camera
from flowlab.records import Episode
from flowlab.storage.dataset import Dataset
from flowlab.storage.exporters.dp3 import DP3Exporter
from flowlab.storage.shard import PICTURES_PER_CHUNK_BYTES, Shard
from flowlab.storage.shard_files import ZippedFiles, write_zip

LENGTHS = (9, 14, 6)


def with_pictures(e: Episode) -> Episode:
    rng = np.random.default_rng(e.seed)
    depth = rng.uniform(0.5, 1, (len(e), 12, 16)).astype(np.float32)
    depth[:, 0] = 0
    return replace(e, rgb=rng.integers(0, 256, (len(e), 12, 16, 3), np.uint8), depth=depth)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data") / "d"
    made = [make_episode(k, task="roll", steps=n) for k, n in enumerate(LENGTHS)] + [make_episode(7, task="push")]
    made = [with_pictures(with_quality(e)) for e in made]
    make_dataset(folder, [[made[1], made[0]], [made[2]], [made[3]]])
    return folder


@pytest.fixture(scope="module")
def episodes(data: Path) -> list[Episode]:
    dataset = Dataset(data)
    return [dataset.episode(k) for k in range(len(dataset))]


def row_of(e: Episode, key: str, t: int) -> np.ndarray:
    """Read from the episode itself."""
    t = min(max(t, 0), len(e) - 1)
    assert e.tracks.quality is not None
    if key == "flow":
        return e.tracks.xyz_world[t + 1] - e.tracks.xyz_world[t] if t + 1 < len(e) else 0 * e.tracks.xyz_world[t]
    if key == "rgb":
        assert e.rgb is not None
        return np.moveaxis(e.rgb[t], -1, 0) / np.float32(255)
    if key == "depth":
        assert e.depth is not None
        return e.depth[t][None]
    arrays = {"tracks": e.tracks.xyz_world, "visible": e.tracks.visible, "sigma": e.tracks.quality.sigma,
              "time": e.time_s}  # fmt: skip
    values = arrays[key] if key in arrays else getattr(e, key)
    return values[t]


KEYS = ("point_cloud", "point_count", "state", "action", "success", "time", "tracks", "visible", "sigma", "flow",
        "object_pose", "rgb", "depth")  # fmt: skip


@settings(max_examples=examples(60), deadline=None, derandomize=True)
@given(
    offsets=st.dictionaries(st.sampled_from(KEYS), st.lists(st.integers(-20, 20), min_size=1, max_size=5), min_size=1),
    chosen=st.lists(st.integers(0, 3), min_size=1, max_size=4, unique=True),
    where=st.floats(0, 1, exclude_max=True),
)
def test_a_window_is_what_its_episode_says(
    data: Path, episodes: list[Episode], offsets: dict[str, list[int]], chosen: list[int], where: float
) -> None:
    longest = max(len(episodes[k]) for k in chosen)
    offsets = {key: [r % longest if abs(r) >= longest else r for r in rows] for key, rows in offsets.items()}
    windows = Windows(data, offsets, episodes=chosen)
    assert len(windows) == sum(len(episodes[k]) for k in chosen)
    index = int(where * len(windows))
    item = windows[index]
    e, frame = episodes[item["episode_index"]], item["frame_index"]
    before = chosen[: chosen.index(item["episode_index"])]
    assert sum(len(episodes[k]) for k in before) + frame == index
    assert item["task"] == e.task
    assert set(item) == {"task", "episode_index", "frame_index"} | {n for k in offsets for n in (k, f"{k}_is_pad")}
    for key, rows in offsets.items():
        wanted = np.stack([row_of(e, key, frame + r) for r in rows])
        assert item[key].dtype == torch.from_numpy(wanted).dtype, key
        np.testing.assert_array_equal(item[key].numpy(), wanted, err_msg=key)
        known = len(e) - (key == "flow")  # nothing is known of how points move after the last row
        assert item[f"{key}_is_pad"].tolist() == [not 0 <= frame + r < known for r in rows]


def test_windows_are_numbered_from_either_end(data: Path) -> None:
    windows = Windows(data, {"action": [0]})
    assert torch.equal(windows[-1]["action"], windows[len(windows) - 1]["action"])
    assert windows.episode_ends.tolist() == np.cumsum([len(e) for e in map(Dataset(data).episode, range(4))]).tolist()
    for outside in (len(windows), -len(windows) - 1):
        with pytest.raises(IndexError, match=f"no window {outside}"):
            windows[outside]


def test_a_dataset_that_is_open_will_do(data: Path) -> None:
    assert torch.equal(
        Windows(Dataset(data), {"state": [0]})[3]["state"], Windows(str(data), {"state": [0]})[3]["state"]
    )
    assert flowlab.data.Windows is Windows
    assert "47" not in repr(Windows(data, {"state": [0]})) or len(repr(Windows(data, {"state": [0]}))) < 300


@pytest.mark.parametrize("workers", [0, 2])
def test_loaders_with_workers_see_every_window_once(data: Path, episodes: list[Episode], workers: int) -> None:
    windows = Windows(data, {"point_cloud": [-1, 0], "action": range(8), "rgb": [0]})
    loader = DataLoader(
        windows, batch_size=5, shuffle=True, num_workers=workers, multiprocessing_context="spawn" if workers else None
    )
    seen = []
    for batch in loader:
        assert batch["point_cloud"].shape[1:] == (2, *episodes[0].point_cloud.shape[1:])
        assert batch["action"].shape[1:] == (8, episodes[0].action.shape[1])
        assert batch["rgb"].shape[1:] == (1, 3, 12, 16)
        seen += list(zip(batch["episode_index"].tolist(), batch["frame_index"].tolist(), strict=True))
        for k, (e, t) in enumerate(seen[-len(batch["action"]) :]):
            np.testing.assert_array_equal(batch["action"][k, 0], episodes[e].action[t])
    assert sorted(seen) == [(e, t) for e in range(4) for t in range(len(episodes[e]))]


def test_a_pickle_holds_no_arrays(data: Path) -> None:
    windows = Windows(data, {"point_cloud": [0], "rgb": [0]})
    before = windows[5]
    assert windows.stats
    content = pickle.dumps(windows)
    assert len(content) < 20_000
    after = pickle.loads(content)[5]
    assert torch.equal(after["rgb"], before["rgb"])


def test_times_are_rows_where_they_are_multiples_of_a_step(data: Path, episodes: list[Episode]) -> None:
    step = float(episodes[0].time_s[1])
    by_time = Windows(data, delta_timestamps={"action": [-step, 0, 2 * step + 5e-5], "state": [0.0]})
    by_row = Windows(data, {"action": [-1, 0, 2], "state": [0]})
    for name, value in by_row[4].items():
        assert torch.equal(by_time[4][name], value) if isinstance(value, torch.Tensor) else by_time[4][name] == value
    with pytest.raises(UsageError, match=rf"'action': {step / 2:g} s is that of no row; the rows are {step:g} s apart"):
        Windows(data, delta_timestamps={"action": [step / 2]})


def test_rows_that_are_not_evenly_spaced_have_no_times(tmp_path: Path) -> None:
    e = make_episode(0)
    time = e.time_s.copy()
    time[3:] += 0.01
    make_dataset(tmp_path / "d", [[replace(e, time_s=time)]])
    with pytest.raises(
        DataError, match=r"d: its rows are not evenly spaced in time: .* s apart, and tolerance_s is 0.0001"
    ):
        Windows(tmp_path / "d", delta_timestamps={"action": [0.0]})
    Windows(tmp_path / "d", delta_timestamps={"action": [0.0]}, tolerance_s=0.02)


def test_a_store_of_dp3_does_not_tell_times(data: Path, tmp_path: Path, episodes: list[Episode]) -> None:
    DP3Exporter().export(Dataset(data), tmp_path / "s.zarr", "roll")
    windows = Windows(tmp_path / "s.zarr", {"point_cloud": [0], "action": [0, 1]})
    assert len(windows) == sum(LENGTHS)
    assert set(windows.keys) == {"point_cloud", "point_count", "state", "action"}
    with pytest.raises(DataError, match="does not tell how far its rows are apart in time; give offsets in rows"):
        Windows(tmp_path / "s.zarr", delta_timestamps={"action": [0.0]})


def test_stats_are_those_of_the_numbers_handed_out(data: Path) -> None:
    windows = Windows(data, {key: [0] for key in KEYS})
    assert set(windows.stats) == set(KEYS) - {"success", "visible"}
    for key, found in windows.stats.items():
        values = torch.stack([windows[i][key][0] for i in range(len(windows))]).double()
        if key == "flow":  # of the last row of an episode nothing is known
            last = set((windows.episode_ends - 1).tolist())
            values = values[[i for i in range(len(values)) if i not in last]]
        channels = values.transpose(1, -1).flatten(0, -2) if values.ndim > 2 else values.view(len(values), -1)
        if key in ("rgb", "depth"):
            channels = values.transpose(0, 1).flatten(1).T
            assert found["mean"].shape == (channels.shape[1], 1, 1)
        elif values.ndim > 2:
            channels = values.flatten(0, -2)
        if key == "depth":
            channels = channels[channels > 0][:, None]
        flat = {name: value.flatten().double() for name, value in found.items()}
        torch.testing.assert_close(flat["min"], channels.amin(0), rtol=1e-5, atol=1e-6, msg=key)
        torch.testing.assert_close(flat["max"], channels.amax(0), rtol=1e-5, atol=1e-6, msg=key)
        torch.testing.assert_close(flat["mean"], channels.mean(0), rtol=1e-4, atol=1e-6, msg=key)
        torch.testing.assert_close(flat["std"], channels.std(0, correction=0), rtol=1e-3, atol=1e-5, msg=key)


WRONG: dict[str, tuple[dict[str, Any], str]] = {
    "key": ({"offsets": {"pointcloud": [0]}}, "no array is called 'pointcloud'; did you mean point_cloud"),
    "neither": ({}, "give either offsets or delta_timestamps"),
    "both": ({"offsets": {}, "delta_timestamps": {}}, "give either offsets or delta_timestamps"),
    "nothing": ({"offsets": {}}, r"offsets must say which rows are wanted of every key, as in \{'state'.*; found \{\}"),
    "no times": ({"delta_timestamps": {}}, "delta_timestamps must say which rows are wanted of every key"),
    "keys only": ({"offsets": ["action"]}, r"must say which rows are wanted of every key, .*; found \['action'\]"),
    "fraction": ({"offsets": {"state": [0.5]}}, r"'state' must be whole numbers of rows, as in .*; found \[0.5\]"),
    "number": ({"offsets": {"state": 0}}, "offsets of 'state' must be whole numbers of rows"),
    "ragged": ({"offsets": {"state": [[0], [0, 1]]}}, "offsets of 'state' must be whole numbers of rows"),
    "far ahead": ({"offsets": {"state": [0, 14]}}, "14 rows off lies outside of every episode; the longest has 14"),
    "far behind": ({"offsets": {"state": [-500]}}, "-500 rows off lies outside of every episode; .* are -13 to 13 off"),
    "late": ({"delta_timestamps": {"state": [1e300]}}, "delta_timestamps of 'state': .* outside of every episode"),
    "nan": ({"delta_timestamps": {"state": [np.nan]}}, r"'state' must be finite seconds, as in .*; found \[nan\]"),
    "endless": ({"delta_timestamps": {"state": [-np.inf]}}, "'state' must be finite seconds"),
    "words": ({"delta_timestamps": {"state": ["a"]}}, r"must be finite seconds, as in .*; found \['a'\]"),
    "tolerance": ({"delta_timestamps": {"state": [0]}, "tolerance_s": np.nan}, "tolerance_s must be seconds, 0"),
    "episode": ({"offsets": {"state": [0]}, "episodes": [4]}, "no episode 4; there are 4, counted from 0"),
    "no episode": ({"offsets": {"state": [0]}, "episodes": []}, "episodes is empty; leave it out for all 4 of them"),
    "task": ({"offsets": {"state": [0]}, "episodes": ["push"]}, r"must be positions of episodes.*found \['push'\]"),
    "task's name": ({"offsets": {"state": [0]}, "episodes": "push"}, "must be positions of episodes.*found 'push'"),
    "one episode": ({"offsets": {"state": [0]}, "episodes": 2}, "must be positions of episodes.*found 2"),
    "mask": ({"offsets": {"state": [0]}, "episodes": [True, False]}, "must be positions of episodes.*found .True"),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_what_is_wrong_is_one_sentence(case: str, data: Path) -> None:
    given, sentence = WRONG[case]
    with pytest.raises(FlowlabError, match=sentence):
        Windows(data, **given)


@pytest.mark.parametrize(
    ("kind", "name", "advice"),
    [
        ("simulated", "rgb", "extract-sim --set expert.scene.rgb=true --set expert.scene.renderer=gl"),
        ("simulated", "depth", "extract-sim --set write.depth=true"),
        ("recorded", "rgb", "track-real --set write.rgb=true"),
        ("recorded", "depth", "track-real --set write.depth=true"),
        ("unknown", "rgb", "not among what it was made from"),
    ],
)
def test_pictures_that_are_not_there_are_refused_with_how_to_get_some(
    kind: str, name: str, advice: str, tmp_path: Path
) -> None:
    make_dataset(tmp_path / "d", [[make_episode(0)]], provenance=make_provenance(kind=kind))
    assert name not in Windows(tmp_path / "d", {"state": [0]}).keys
    with pytest.raises(DataError, match=f"/d: holds no (color|depth) pictures.*{advice}"):
        Windows(tmp_path / "d", {name: [0]})


# Pictures that stay in the shards.


def test_pictures_are_read_from_the_shards_and_nothing_is_decoded_of_others(
    data: Path, episodes: list[Episode], monkeypatch: pytest.MonkeyPatch
) -> None:
    windows = Windows(data, {"rgb": [-1, 0], "depth": [0]})
    decoded = Windows(data, {"rgb": [-1, 0], "depth": [0]}, pictures="decoded")
    assert set(decoded.keys) == set(windows.keys)
    for k in range(len(windows)):
        for key, value in windows[k].items():
            assert torch.equal(value, decoded[k][key]) if isinstance(value, torch.Tensor) else value == decoded[k][key]
    windows = Windows(data, {"rgb": [-1, 0]})  # of which no shard is open
    read: list[str] = []
    original = ZippedFiles.read
    monkeypatch.setattr(ZippedFiles, "read", lambda self, name: read.append(name) or original(self, name))
    windows[3]
    chunks = [name for name in read if "/c/" in name and name.startswith("data")]
    assert chunks == ["data/rgb/c/0/0/0/0"]


def test_a_single_picture_is_a_small_part_of_what_lies_in_a_shard(tmp_path: Path) -> None:
    tall = PICTURES_PER_CHUNK_BYTES // (64 * 3) // 2  # of which two fit into a chunk
    rng = np.random.default_rng(0)
    e = make_episode(0, steps=7, points=4, queries=2)
    rgb, depth = rng.integers(0, 256, (7, tall, 64, 3), np.uint8), rng.random((7, tall, 64), np.float32)
    e = replace(e, rgb=rgb, depth=depth, camera=Camera.from_fovy(64, tall, 45.0, LOOKING_DOWN))
    make_dataset(tmp_path / "d", [[e]])
    stored = {a.path: a.rows_per_chunk for a in Shard(next((tmp_path / "d/shards").iterdir())).describe()}
    assert (stored["data/rgb"], stored["data/depth"], stored["data/tracks"]) == (2, 1, 7)
    windows = Windows(tmp_path / "d", {"rgb": [-5, 0, 1], "depth": [0]})
    np.testing.assert_array_equal(windows[5]["rgb"].mul(255).round().numpy(), np.moveaxis(rgb[[0, 5, 6]], -1, 1))
    assert_same(Dataset(tmp_path / "d")[0], e)


def test_what_earlier_versions_stored_together_is_decoded_first(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(window_pictures, "_QUICK_BYTES", 12 * 16 * 3 * 10)  # the longest episode has more rows
    by_default, asked = (Windows(data, {"rgb": [0]}, pictures=where) for where in (None, "stored"))
    assert torch.equal(by_default[2]["rgb"], asked[2]["rgb"])
    assert (by_default._pictures.stored, asked._pictures.folders) == ({}, [])
    with pytest.raises(UsageError, match="pictures must be 'stored', 'decoded' or None; found 'shards'"):
        Windows(data, {"rgb": [0]}, pictures="shards")  # type: ignore[arg-type]


def test_the_same_episodes_in_other_shards_have_their_own_pictures(
    data: Path, episodes: list[Episode], tmp_path: Path
) -> None:
    """They have one fingerprint, and so what was decoded of one is used for the other."""
    make_dataset(tmp_path / "d", [[e] for e in reversed(episodes)])
    assert Dataset(tmp_path / "d").fingerprint == Dataset(data).fingerprint
    first, second = (Windows(place, {"rgb": [0], "action": [0]}) for place in (data, tmp_path / "d"))
    for k in range(len(first)):
        assert torch.equal(first[k]["rgb"], second[k]["rgb"])
        assert torch.equal(first[k]["action"], second[k]["action"])


def test_workers_that_are_forked_read_through_files_of_their_own(data: Path, episodes: list[Episode]) -> None:
    windows = Windows(data, {"rgb": [0]})
    expected = [windows[k]["rgb"] for k in range(len(windows))]  # its shards are open when the workers begin
    for _ in range(3):
        loader = DataLoader(windows, batch_size=1, num_workers=3, multiprocessing_context="fork")
        assert all(torch.equal(batch["rgb"][0], value) for batch, value in zip(loader, expected, strict=True))


def test_pictures_of_some_episodes_or_of_other_sizes_are_refused(tmp_path: Path) -> None:
    one, two = with_pictures(make_episode(0)), make_episode(1)
    make_dataset(tmp_path / "some", [[one], [two]])
    with pytest.raises(DataError, match="/some: roll seed 1: 'rgb' is in some episodes only; take those by"):
        Windows(tmp_path / "some", {"rgb": [0]})
    assert one.rgb is not None
    camera = Camera.from_fovy(16, 6, 45.0, LOOKING_DOWN)
    small = replace(one, seed=1, rgb=one.rgb[:, :6], depth=None, camera=camera)
    make_dataset(tmp_path / "sizes", [[one], [small]])
    with pytest.raises(DataError, match=r"roll seed 1: 'rgb' is \(6, 16, 3\), in those before \(12, 16, 3\)"):
        Windows(tmp_path / "sizes", {"rgb": [0]})


def test_damaged_pictures_are_one_sentence_and_never_black(tmp_path: Path) -> None:
    make_dataset(tmp_path / "d", [[with_pictures(make_episode(0))]])
    windows = Windows(tmp_path / "d", {"rgb": [0]})
    shard = next((tmp_path / "d/shards").iterdir())
    with zipfile.ZipFile(shard) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    chunk = bytearray(files["data/rgb/c/0/0/0/0"])
    chunk[40] ^= 1
    write_zip(shard, {**files, "data/rgb/c/0/0/0/0": bytes(chunk)})  # whose own checksum is right
    with pytest.raises(DataError, match=r"data/rgb: damaged \(a checksum does not match\)"):
        pickle.loads(pickle.dumps(windows))[0]


def _lying(files: dict[str, bytes], case: str) -> None:
    """Change pictures of four rows of 12 x 16; checksums stay true."""
    about, chunk = json.loads(files["data/rgb/zarr.json"]), "data/rgb/c/0/0/0/0"
    grid = about["chunk_grid"]["configuration"]
    row = 12 * 16 * 3
    if case == "fewer pictures":
        stored = compress(bytes(3 * row), 3)
    elif case == "no size":
        blocks = [(4 * row << 3 | 0b011).to_bytes(3, "little") + b"\7"]  # the last, of one byte repeated
        stored = b"\x28\xb5\x2f\xfd\x00\x58" + b"".join(blocks)
    else:
        about["shape"] = [4, *{"huge": (100_000, 100_000), "wide": (12, 32)}[case], 3]
        grid["chunk_shape"] = [1, *about["shape"][1:]]
        stored = compress(bytes(12 * 32 * 3), 3)
    files[chunk] = stored + google_crc32c.value(stored).to_bytes(4, "little")
    files["data/rgb/zarr.json"] = json.dumps(about).encode()


LIES = {
    "fewer pictures": "a chunk holds 1,728 bytes, expected 2,304",
    "no size": "a chunk holds -1 bytes, expected 2,304",
    "huge": r"damaged \(uint8 \(4, 100000, 100000, 3\) for 4 rows of a camera of \(12, 16\)\)",
    "wide": "for 4 rows of a camera of",
}


@pytest.mark.parametrize("case", LIES)
def test_shards_that_lie_about_their_pictures_are_refused_before_memory_is_taken(case: str, tmp_path: Path) -> None:
    make_dataset(tmp_path / "d", [[with_pictures(make_episode(0, steps=4))]])
    Windows(tmp_path / "d", {"rgb": [0]})  # what is no picture is decoded, and read no more
    shard = next((tmp_path / "d/shards").iterdir())
    with zipfile.ZipFile(shard) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    _lying(files, case)
    write_zip(shard, files)
    with pytest.raises(DataError, match=LIES[case]):
        Windows(tmp_path / "d", {"rgb": [0]})[0]


def test_chunks_too_large_to_be_read_for_a_picture_are_left_to_be_decoded(
    data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(window_pictures, "MAX_LOADED_BYTES", 1000)
    with pytest.raises(DataError, match="are read for one picture; give pictures='decoded'"):
        Windows(data, {"rgb": [0]}, pictures="stored")


@pytest.mark.parametrize("index", [slice(2, 4), "a", 1.5, [0, 1], None])
def test_an_index_that_is_no_number_is_one_sentence(index: Any, data: Path) -> None:
    with pytest.raises(UsageError, match=r"windows are numbered, as in windows\[2\], and found .*Subset"):
        Windows(data, {"state": [0]})[index]


def test_numbers_of_numpy_and_torch_are_indices(data: Path) -> None:
    windows = Windows(data, {"state": [0]})
    for index in (np.int64(3), torch.tensor(3)):
        assert windows[index]["frame_index"] == 3  # type: ignore[index]


def test_the_flow_of_the_last_row_is_not_known(data: Path, episodes: list[Episode]) -> None:
    windows = Windows(data, {"flow": range(-1, 3), "tracks": range(-1, 3)}, episodes=[1])
    last = len(episodes[1]) - 1
    assert windows[last]["flow_is_pad"].tolist() == [False, True, True, True]
    assert windows[last]["tracks_is_pad"].tolist() == [False, False, True, True]


def test_exact_tracks_state_no_error(tmp_path: Path, data: Path) -> None:
    make_dataset(tmp_path / "d", [[make_episode(0)]])
    assert "sigma" not in Windows(tmp_path / "d", {"state": [0]}).keys
    with pytest.raises(UsageError, match="no array is called 'sigma'"):
        Windows(tmp_path / "d", {"sigma": [0]})
    assert "sigma" in Windows(data, {"state": [0]}).keys


def test_windows_of_one_task(data: Path, episodes: list[Episode]) -> None:
    view = Dataset(data).task("roll")
    windows = Windows(view, {"state": [0]}, episodes=[2, 0])
    assert windows.tasks == ("roll",)
    assert len(windows) == len(view[2]) + len(view[0])
    np.testing.assert_array_equal(windows[0]["state"][0], view[2].state[0])
    np.testing.assert_array_equal(episodes[windows.episodes[1]].state, view[0].state)
    with pytest.raises(UsageError, match="no episode 3; there are 3"):
        Windows(view, {"state": [0]}, episodes=[3])
    with pytest.raises(UsageError, match="expected one or more"):
        Windows(view[:0], {"state": [0]})
    with pytest.raises(UsageError, match=r"data must be a dataset or its path, .*found 5"):
        Windows(5, {"state": [0]})  # type: ignore[arg-type]
