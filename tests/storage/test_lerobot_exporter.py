"""What is written for LeRobot: by its own schema, read by other libraries; and read back as a recording."""

import io
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
from dry_runs import dry_run
from hdf5_files import POSE, SIZE, STEPS, K, filmed
from lerobot_files import CODE, codes
from PIL import Image
from synthetic import call_cli, make_dataset, make_episode, make_provenance, with_quality

from flowlab.geometry.camera import Camera
from flowlab.provenance import Channels
from flowlab.recordings.parsing import RecordingSettings, parse_recording
from flowlab.records import Episode
from flowlab.storage.dataset import Dataset
from flowlab.storage.exporters import lerobot
from flowlab.storage.exporters.lerobot import LeRobotExporter
from flowlab.testing.exporters import CHECKS, MakeExporter

TASK = "push the red box"
CAMERA = Camera(*SIZE, K, POSE)
COLOR, DEPTH = "observation.images.main", "observation.images.main_depth"
OWN = {"timestamp", "frame_index", "episode_index", "index", "task_index"}
FPS = 80
Capture = pytest.CaptureFixture[str]


def episode(seed: int, task: str = TASK, **changed: Any) -> Episode:
    """A filmed scene whose depth is in whole millimeters, as of a sensor; clouds and tracks are made up."""
    seen = filmed(seed)
    made = with_quality(make_episode(seed, task=task, steps=STEPS))
    depth = (seen.mm / 1000).astype(np.float32)
    return replace(
        made, camera=CAMERA, rgb=seen.rgb, depth=depth, state=seen.state, extras={"source": f"take-{seed}"}, **changed
    )


@pytest.fixture(scope="module")
def made() -> list[Episode]:
    return [episode(0, "lift"), episode(0), replace(episode(1), success=np.zeros(STEPS, bool))]


@pytest.fixture(scope="module")
def dataset(made: list[Episode], tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Two tasks, whose episodes lie in shards in another order."""
    names = [Channels(name="arm", index=(0, 1, 2, 3, 4, 5, 6), kind="joint", frame="", unit="rad"),
             Channels(name="tip", index=(7,), kind="other", frame="", unit="1"),
             Channels(name="grip", index=(8,), kind="other", frame="", unit="1")]  # fmt: skip
    said = make_provenance(state=tuple(names), tracks="estimated", tracker="lucas-kanade")
    return make_dataset(tmp_path_factory.mktemp("data") / "d", [[made[2], made[1]], [made[0]]], provenance=said)


@pytest.fixture(scope="module")
def exported(dataset: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("out") / "lerobot"
    assert LeRobotExporter().export(dataset, path) == 3
    return path


def info(path: Path) -> dict[str, Any]:
    return json.loads((path / "meta/info.json").read_text())  # type: ignore[no-any-return]


def table(path: Path) -> dict[str, np.ndarray]:
    read = pq.read_table(path / "data/chunk-000/file-000.parquet")
    return {
        n: np.array(read.column(n).to_pylist()) for n in read.column_names if not n.startswith("observation.images")
    }


@pytest.mark.parametrize("check", CHECKS)
def test_every_promise_is_kept(check: Callable[[MakeExporter, Dataset], None], dataset: Dataset) -> None:
    check(LeRobotExporter, dataset)


def test_the_schema_is_that_of_lerobot(exported: Path) -> None:
    said = info(exported)
    assert (said["codebase_version"], said["fps"], said["total_episodes"], said["total_frames"]) == (
        "v3.0",
        FPS,
        3,
        3 * STEPS,
    )
    assert (said["total_tasks"], said["splits"], type(said["fps"])) == (2, {"train": "0:3"}, int)
    features = said["features"]
    file = pq.ParquetFile(exported / "data/chunk-000/file-000.parquet")
    in_table = {n for n, f in features.items() if f["dtype"] != "video"}
    assert set(file.schema_arrow.names) == in_table, "a column that is not declared makes LeRobot refuse the dataset"
    assert set(features) >= OWN
    for name, f in features.items():
        assert {"dtype", "shape", "names"} <= set(f)
        kind = str(file.schema_arrow.field(name).type) if name in in_table else ""
        depth = len(f["shape"]) if f["shape"] != [1] else 0
        if f["dtype"] not in ("image", "video"):
            stored = {"float32": "float", "float64": "double"}.get(f["dtype"], f["dtype"])
            assert kind == "list<element: " * depth + stored + ">" * depth, name
    assert features["observation.point_cloud"]["shape"] == [64, 3]
    assert features["observation.state"]["names"] == [f"arm.{k}" for k in range(7)] + ["tip", "grip"]
    assert features["action"]["names"] is None, "nothing is known of it, and nothing is made up"
    tasks = pq.read_table(exported / "meta/tasks.parquet")
    assert tasks.to_pydict() == {"task_index": [0, 1], "task": ["lift", TASK]}
    assert json.loads(tasks.schema.metadata[b"pandas"])["index_columns"] == ["task"]


def test_parquet_is_written_as_measured(exported: Path) -> None:
    about = pq.ParquetFile(exported / "data/chunk-000/file-000.parquet").metadata
    assert [about.row_group(k).num_rows for k in range(about.num_row_groups)] == [STEPS] * 3
    for k in range(about.num_columns):
        column = about.row_group(0).column(k)
        assert column.compression == "ZSTD"
        assert "PLAIN_DICTIONARY" not in column.encodings
        assert "RLE_DICTIONARY" not in column.encodings
        assert ("BYTE_STREAM_SPLIT" in column.encodings) == (column.physical_type in ("FLOAT", "DOUBLE"))


def test_numbers_are_those_of_the_dataset(exported: Path, made: list[Episode]) -> None:
    found, steps = table(exported), np.arange(3 * STEPS)
    np.testing.assert_array_equal(
        found["observation.point_cloud"].astype(np.float32), np.concatenate([e.point_cloud for e in made])
    )
    np.testing.assert_array_equal(
        found["observation.tracks"].astype(np.float32), np.concatenate([e.tracks.xyz_world for e in made])
    )
    np.testing.assert_array_equal(found["observation.tracks_visible"], np.concatenate([e.tracks.visible for e in made]))
    sigma = np.concatenate([e.tracks.quality.sigma for e in made])  # type: ignore[union-attr]
    np.testing.assert_array_equal(found["observation.tracks_sigma"].astype(np.float32), sigma)
    np.testing.assert_array_equal(
        found["observation.state"].astype(np.float32), np.concatenate([e.state for e in made])
    )
    np.testing.assert_array_equal(found["action"].astype(np.float32), np.concatenate([e.action for e in made]))
    np.testing.assert_array_equal(found["next.success"], np.concatenate([e.success for e in made]))
    np.testing.assert_array_equal(found["index"], steps)
    np.testing.assert_array_equal(found["frame_index"], steps % STEPS)
    np.testing.assert_array_equal(found["episode_index"], steps // STEPS)
    np.testing.assert_array_equal(found["task_index"], np.minimum(steps // STEPS, 1))
    np.testing.assert_array_equal(found["timestamp"].astype(np.float32), (steps % STEPS / FPS).astype(np.float32))
    np.testing.assert_array_equal(found["observation.time"], np.concatenate([e.time_s for e in made]))


def test_episodes_say_where_they_are_and_what_became_of_them(exported: Path, made: list[Episode]) -> None:
    rows = pq.read_table(exported / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    for k, (row, e) in enumerate(zip(rows, made, strict=True)):
        assert (row["episode_index"], row["tasks"], row["length"]) == (k, [e.task], STEPS)
        assert (row["dataset_from_index"], row["dataset_to_index"]) == (k * STEPS, (k + 1) * STEPS)
        assert (row["data/chunk_index"], row["data/file_index"], row["meta/episodes/file_index"]) == (0, 0, 0)
        assert (row["success"], row["seed"], row["source"]) == (k < 2, e.seed, e.extras["source"])
        np.testing.assert_allclose(row[f"videos/{COLOR}/from_timestamp"], k * STEPS / FPS)
        np.testing.assert_allclose(row[f"videos/{COLOR}/to_timestamp"], (k + 1) * STEPS / FPS)
        np.testing.assert_array_equal(row["camera/K"], K.ravel())
        np.testing.assert_allclose(row["stats/observation.state/mean"], e.state.mean(0), atol=1e-6)
        assert row["stats/observation.state/count"] == [STEPS]


def test_statistics_are_by_axis_and_exact(exported: Path, made: list[Episode]) -> None:
    stats = json.loads((exported / "meta/stats.json").read_text())
    assert set(stats) == set(info(exported)["features"])
    cloud = np.concatenate([e.point_cloud for e in made]).reshape(-1, 3).astype(float)
    state = np.concatenate([e.state for e in made]).astype(float)
    for name, rows in (("observation.point_cloud", cloud), ("observation.state", state)):
        found = stats[name]
        for key, value in (("min", rows.min(0)), ("max", rows.max(0)), ("mean", rows.mean(0)), ("std", rows.std(0)),
                           ("q01", np.quantile(rows, 0.01, 0)), ("q50", np.median(rows, 0))):  # fmt: skip
            np.testing.assert_allclose(found[key], value, atol=1e-9)
        assert found["count"] == [3 * STEPS]
    assert np.shape(stats[COLOR]["mean"]) == (3, 1, 1)
    assert 0 <= np.min(stats[COLOR]["min"]) <= np.max(stats[COLOR]["max"]) <= 1
    assert np.shape(stats[DEPTH]["mean"]) == (1, 1, 1)
    assert 500 < stats[DEPTH]["mean"][0][0][0] < 3000, "in the unit that is said: millimeters"


def test_calibration_is_where_lerobot_keeps_it(exported: Path, dataset: Dataset) -> None:
    """In the ``info`` of features: the top level of info.json is lost when LeRobot writes it anew."""
    for name in (COLOR, DEPTH):
        camera = info(exported)["features"][name]["info"]["camera"]
        assert (camera["K"], camera["axes"], camera["pixel_centers"]) == (K.tolist(), "opencv", 0.0)
        np.testing.assert_array_equal(camera["T_world_cam"], POSE)
    origin = json.loads((exported / "meta/flowlab.json").read_text())
    assert origin["fingerprint"] == dataset.fingerprint
    assert origin["provenance"]["tracker"] == "lucas-kanade"
    assert "data/disagreement" in origin["left_out"], "what is left out is said"
    assert "data/disagreement" in (exported / "README.md").read_text()


def frames(file: Path) -> list[Any]:
    with av.open(str(file)) as container:
        return [(f.time, f) for f in container.decode(video=0)]


def test_color_is_a_video_with_a_frame_for_each_step(exported: Path, made: list[Episode]) -> None:
    about = info(exported)["features"][COLOR]
    assert (about["dtype"], about["shape"], about["info"]["video.codec"]) == ("video", [SIZE[1], SIZE[0], 3], "h264")
    found = frames(exported / f"videos/{COLOR}/chunk-000/file-000.mp4")
    assert len(found) == 3 * STEPS
    np.testing.assert_allclose([t for t, _ in found], np.arange(3 * STEPS) / FPS, atol=1e-4)
    assert [f.key_frame for _, f in found][::2] == [True] * len(found[::2]), "quick to begin anywhere"
    seen = np.concatenate([e.rgb for e in made]).astype(int)  # type: ignore[misc]
    assert np.abs(np.stack([f.to_ndarray(format="rgb24") for _, f in found]) - seen).mean() < 6


@pytest.mark.parametrize(("how", "unit"), [("mm", 0.001), ("m", 1.0)])
def test_depth_images_are_without_loss(
    how: Any, unit: float, dataset: Dataset, made: list[Episode], tmp_path: Path
) -> None:
    LeRobotExporter(depth=how, rgb="image").export(dataset, tmp_path / "x", "lift")
    about = info(tmp_path / "x")["features"][DEPTH]
    assert (about["dtype"], about["info"]["is_depth_map"], about["info"]["depth_unit"]) == ("image", True, how)
    assert info(tmp_path / "x")["video_path"] is None
    read = pq.read_table(tmp_path / "x/data/chunk-000/file-000.parquet")
    depth, rgb = (read.column(n).to_pylist() for n in (DEPTH, COLOR))
    assert made[0].depth is not None
    assert made[0].rgb is not None
    for t in range(STEPS):
        counts = np.asarray(Image.open(io.BytesIO(depth[t]["bytes"])))
        np.testing.assert_allclose(counts * unit, made[0].depth[t], atol=1e-7)
        assert how == "mm" or np.array_equal(counts, made[0].depth[t])
        np.testing.assert_array_equal(
            cv2.imdecode(np.frombuffer(rgb[t]["bytes"], np.uint8), 1)[..., ::-1], made[0].rgb[t]
        )


def test_depth_on_request_is_lerobots_video(dataset: Dataset, made: list[Episode], tmp_path: Path) -> None:
    LeRobotExporter(depth="video").export(dataset, tmp_path / "x", "lift")
    about = info(tmp_path / "x")["features"][DEPTH]
    assert {k: about["info"][f"video.{k}"] for k in CODE} == CODE
    found = frames(tmp_path / f"x/videos/{DEPTH}/chunk-000/file-000.mp4")
    assert found[0][1].format.name == "gray12le"
    assert made[0].depth is not None
    for (_, frame), depth in zip(found, made[0].depth, strict=True):
        rows = np.frombuffer(frame.planes[0], np.uint8).reshape(frame.height, -1)[:, : 2 * frame.width]
        np.testing.assert_allclose(np.ascontiguousarray(rows).view("<u2").astype(int), codes(depth), atol=1)


def test_what_is_too_large_for_one_file_lies_in_several(
    dataset: Dataset, made: list[Episode], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lerobot, "_DATA_MB", 0)
    monkeypatch.setattr(lerobot, "_VIDEO_MB", 0)
    LeRobotExporter().export(dataset, tmp_path / "x")
    files = [f"chunk-000/file-00{k}" for k in range(3)]
    for folder, suffix in (("data", "parquet"), (f"videos/{COLOR}", "mp4")):
        assert all((tmp_path / "x" / folder / f"{name}.{suffix}").is_file() for name in files)
    for k, episode in enumerate(made):
        found = parse_recording(tmp_path / f"x/episode_{k}", RecordingSettings()).streams
        np.testing.assert_array_equal(found.state[0].values, episode.state)
        assert episode.rgb is not None
        assert np.abs(found.color.read(3).astype(int) - episode.rgb[3]).mean() < 6


def test_flat_is_one_row_of_numbers(dataset: Dataset, made: list[Episode], tmp_path: Path) -> None:
    LeRobotExporter(flat=True).export(dataset, tmp_path / "x", "lift")
    assert info(tmp_path / "x")["features"]["observation.tracks"]["shape"] == [24]
    np.testing.assert_array_equal(
        table(tmp_path / "x")["observation.tracks"].astype(np.float32).reshape(STEPS, 8, 3), made[0].tracks.xyz_world
    )


def test_what_a_dataset_lacks_is_not_made_up(tmp_path: Path, capsys: Capture, caplog: pytest.LogCaptureFixture) -> None:
    bare = replace(make_episode(0, object_pose=False), state=np.zeros((12, 0), np.float32))
    make_dataset(tmp_path / "d", [[bare]])
    code, _, err = call_cli(capsys, "export", tmp_path / "d", "--to", "lerobot", "--out", tmp_path / "x")
    assert code == 0, err
    assert "not written, as LeRobot has no features for it: meta/association_distance" in caplog.text
    assert set(info(tmp_path / "x")["features"]) == OWN | {
        "observation.time", "observation.point_cloud", "observation.point_count", "action", "next.success",
        "observation.tracks", "observation.tracks_visible"}  # fmt: skip
    assert not (tmp_path / "x/videos").exists()


@pytest.mark.parametrize(("hertz", "said"), [(12.5, "12 a second"), (20.0, ""), (20.1, "")])
def test_a_rate_that_lerobot_cannot_have_is_told(
    hertz: float, said: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    one = make_episode(0)
    dataset = make_dataset(tmp_path / "d", [[replace(one, time_s=np.arange(len(one.action)) / hertz)]])
    assert LeRobotExporter().export(dataset, tmp_path / "x") == 1
    assert said in caplog.text if said else "a second" not in caplog.text
    assert ("timestamps are off by up to 4.2%" in (tmp_path / "x/README.md").read_text()) == bool(said)


def test_a_camera_that_moves_is_written_step_by_step(tmp_path: Path) -> None:
    poses = np.tile(POSE, (STEPS, 1, 1))
    poses[:, 0, 3] += 0.02 * np.arange(STEPS)
    still, moving = episode(1), replace(episode(0), T_world_cam=poses)
    LeRobotExporter(rgb="image").export(make_dataset(tmp_path / "d", [[moving], [still]]), tmp_path / "x")
    np.testing.assert_array_equal(
        table(tmp_path / "x")["observation.T_world_cam"], np.concatenate([poses, np.tile(POSE, (STEPS, 1, 1))])
    )
    assert "camera" not in info(tmp_path / "x")["features"][COLOR]["info"], "what differs is told by episode"
    moves, stands = (parse_recording(tmp_path / f"x/episode_{k}", RecordingSettings()) for k in range(2))
    assert moves.streams.poses is not None
    np.testing.assert_allclose(moves.streams.poses.values.reshape(-1, 4, 4), poses, atol=1e-12)
    assert {c.about: c.verdict for c in moves.checks}["camera"] == "refused", "the film itself does not move"
    assert {c.about: c.verdict for c in stands.checks}["camera"] == "ok"


def test_pictures_of_two_sizes_are_refused(tmp_path: Path, capsys: Capture) -> None:
    make_dataset(tmp_path / "d", [[make_episode(0, rgb=True)], [episode(1, "roll")]])
    code, _, err = call_cli(capsys, "export", tmp_path / "d", "--to", "lerobot", "--out", tmp_path / "x")
    assert (code, "'data/rgb' has the shapes [12, 16, 3] and [96, 128, 3]" in err) == (3, True), err
    assert not (tmp_path / "x").exists()


def test_what_was_exported_is_labeled_as_a_recording(
    dataset: Dataset, exported: Path, made: list[Episode], tmp_path: Path, capsys: Capture
) -> None:
    """Geometry, robot, task and success come back through the command line."""
    code, said, _ = call_cli(
        capsys, "export", dataset.path, "--to", "lerobot", "--out", tmp_path / "x", "--set", "rgb=image"
    )
    assert (code, said) == (0, f"3 episodes written to {tmp_path / 'x'} for lerobot\n")
    run = dry_run(capsys, tmp_path / "x/episode_1")
    assert (run.code, run.problem) == (0, "None")
    for about in ("layout", "intrinsics", "registration", "world", "camera", "depth unit", "clock"):
        assert run.checks[about][0] == "ok", run.checks[about]
    small = (
        "observer.points=256",
        "queries.points=40",
        "quality.min_sure_share=0",
        "quality.max_median_sigma_m=9",
        "write.rgb=true",
    )
    how = ("--tracker", "lucas-kanade", "--workers", "1", *(word for change in small for word in ("--set", change)))
    for _ in range(2):
        code, _, err = call_cli(capsys, "track-real", tmp_path / "x/episode_1", "--out", tmp_path / "y", *how)
        assert (code, "changed" in err) == (0, False), err
    (new,), old = list(Dataset(tmp_path / "y")), made[1]
    assert (new.task, new.success[-1], new.extras["source"]) == (TASK, True, "x/episode_1")
    for name in ("state", "action", "rgb", "time_s"):
        np.testing.assert_array_equal(getattr(new, name), getattr(old, name))
    np.testing.assert_allclose(new.depth, old.depth, atol=1e-7)
    np.testing.assert_allclose(new.camera.K, K)
    np.testing.assert_allclose(new.camera.T_world_cam, POSE, atol=1e-9)
    assert dry_run(capsys, exported / "episode_1").code == 0, "colors of a video, too"
