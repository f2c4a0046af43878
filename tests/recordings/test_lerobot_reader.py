"""LeRobot datasets written by hand, read through the command line: the filmed scene comes out of each."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from dry_runs import dry_run
from hdf5_files import GIVEN, POSE, STEPS, K, filmed
from lerobot_files import CAMERA, COLOR, DEPTH, FPS, TASK, codes, v3, v21, write_video
from real_recordings import opened, write_yaml
from synthetic import edit_json

from flowlab.recordings.base import choose_reader, read_streams
from flowlab.recordings.identity import identity
from flowlab.recordings.parsing import RecordingSettings
from flowlab.recordings.recording import find_recordings
from flowlab.recordings.recording_yaml import Metadata

Capture = pytest.CaptureFixture[str]
Write = Callable[..., Path]
HALF = K + np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
LAYOUTS = [
    (v3, "video", "png"),
    (v3, "png", "video"),
    (v3, "png", "tiff"),
    (v21, "video", "video"),
    (v21, "png", "png"),
]
NAMES = [f"{w.__name__}, color {c}, depth {d}" for w, c, d in LAYOUTS]


@pytest.mark.parametrize(("write", "color", "depth"), LAYOUTS, ids=NAMES)
def test_a_dataset_is_recognized_and_its_geometry_is_proven(
    write: Write, color: str, depth: str, tmp_path: Path, capsys: Capture
) -> None:
    path = write(tmp_path / "data set", color=color, depth=depth)
    run = dry_run(capsys, path / "episode_0")
    assert (run.code, run.problem, run.facts["reader"]) == (0, "None", "lerobot")
    for about in ("layout", "intrinsics", "registration", "world", "camera", "depth unit", "left out"):
        assert run.checks[about][0] == "ok", run.checks[about]
    found = find_recordings([path])
    assert [p.name for p in found] == ["episode_000000", "episode_000001"]
    for k, one in enumerate(found):
        recording, seen = opened(one), filmed(k)
        np.testing.assert_allclose(recording.camera.K, K, atol=1e-6)
        np.testing.assert_allclose(recording.camera.T_world_cam, POSE, atol=1e-6)
        np.testing.assert_array_equal(recording.state, seen.state)
        np.testing.assert_array_equal(recording.action, seen.action)
        np.testing.assert_allclose(recording.time_s, np.arange(STEPS) / FPS)
        assert recording.extras["state_names"] == [f"joint_{n}" for n in range(9)]
        assert bool(recording.success[-1]) is (k == 0)
        for t in range(STEPS):
            frame = recording.frame(t)
            assert frame.rgb is not None
            off = np.abs(frame.rgb.astype(int) - seen.rgb[t])
            assert off.max() == 0 if color == "png" else off.mean() < 3
            np.testing.assert_array_equal(frame.depth == 0, seen.depth[t] == 0)
            step = {"png": 5.1e-4, "tiff": 1e-6, "video": 1.3e-3}[depth]
            np.testing.assert_allclose(frame.depth, seen.depth[t], atol=step)


def test_a_hole_in_a_depth_video_is_a_hole_again_and_the_steps_are_told(tmp_path: Path, capsys: Capture) -> None:
    depth = filmed().depth.copy()
    depth[:, 40:50, 40:60] = 0
    depth[:, :4] = 11.0
    path = v3(tmp_path / "d", demos=1, depth="video")
    write_video(path / f"videos/{DEPTH}/chunk-000/file-000.mp4", codes(depth))
    run = dry_run(capsys, path)
    verdict, says = run.checks["depth code"]
    assert (verdict, "1.3 at 0.3 m, 1.5 at 1 m" in says, "no reading" in says) == ("ok", True, True)
    found = read_streams(choose_reader(path), path, Metadata()).depth.read(2)
    assert not found[40:50, 40:60].any(), "0 m was coded as 1 cm"
    assert not found[:4].any(), "farther than the code goes"


def edit_table(file: Path, change: Callable[[dict[str, Any]], object]) -> None:
    table = pq.read_table(file)
    columns = {n: table.column(n) for n in table.column_names}
    change(columns)
    pq.write_table(pa.table(columns), file)


CALIBRATIONS: dict[str, tuple[Any, dict[str, Any], list[str]]] = {
    "pixel centers at a half": ({**CAMERA, "K": HALF.tolist(), "pixel_centers": 0.5}, {}, []),
    "axes of OpenGL": (
        {**CAMERA, "T_world_cam": (POSE @ np.diag([1.0, -1, -1, 1])).tolist(), "axes": "opengl"},
        {},
        [],
    ),
    "recording.yaml": (None, {"intrinsics": GIVEN, "T_world_cam": POSE.tolist()}, []),
    "--calibration": (None, {}, ["--calibration", "cam.yaml"]),
}


@pytest.mark.parametrize("name", CALIBRATIONS)
def test_the_camera_is_known_from(name: str, tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    camera, keys, more = CALIBRATIONS[name]
    monkeypatch.chdir(tmp_path)
    path = v3(tmp_path / "d", demos=1, color="png", camera=camera)
    if keys:
        write_yaml(path / "recording.yaml", **keys)
    write_yaml(tmp_path / "cam.yaml", intrinsics=GIVEN, T_world_cam=POSE.tolist())
    run = dry_run(capsys, path, *more)
    assert (run.code, run.problem) == (0, "None"), run.problem
    assert run.checks["world"][0] == "ok", run.checks
    found = opened(find_recordings([path])[0], **({"calibration": tmp_path / "cam.yaml"} if more else {}))
    np.testing.assert_allclose(found.camera.K, K, atol=1e-6)
    np.testing.assert_allclose(found.camera.T_world_cam, POSE, atol=1e-6)


def test_an_episode_has_a_camera_of_its_own(tmp_path: Path) -> None:
    path, moved = v3(tmp_path / "d", color="png"), POSE.copy()
    moved[0, 3] += 0.1
    poses = [POSE.ravel().tolist(), moved.ravel().tolist()]
    edit_table(path / "meta/episodes/chunk-000/file-000.parquet", lambda c: c.update({"camera/T_world_cam": poses}))
    found = [opened(p).camera.T_world_cam for p in find_recordings([path])]
    np.testing.assert_allclose(found, [POSE, moved], atol=1e-6)


def two_cameras(path: Path, *names: str) -> Path:
    """The same pictures, under more names."""

    def more(info: dict[str, Any]) -> None:
        for name in names:
            info["features"] |= {f"observation.images.{name}": info["features"][COLOR],
                                 f"observation.images.{name}_depth": info["features"][DEPTH]}  # fmt: skip

    def columns(table: dict[str, Any]) -> None:
        for name in names:
            table |= {f"observation.images.{name}": table[COLOR], f"observation.images.{name}_depth": table[DEPTH]}

    edit_json(path / "meta/info.json", more)
    edit_table(path / "data/chunk-000/file-000.parquet", columns)
    return path


def test_of_several_cameras_one_is_named(tmp_path: Path, capsys: Capture) -> None:
    path = two_cameras(v3(tmp_path / "d", demos=1, color="png"), "side", "wrist")
    run = dry_run(capsys, path)
    assert "with several cameras, front, side, wrist; choose one with 'camera: front' in" in run.problem
    write_yaml(path / "recording.yaml", camera="side")
    run = dry_run(capsys, path)
    assert "observation.images.side with observation.images.side_depth" in run.checks["layout"][1]
    write_yaml(path / "recording.yaml", camera="top")
    assert "cameras with depth are front, side, wrist, and 'camera' says 'top'" in dry_run(capsys, path).problem


def test_a_camera_in_a_hand_is_passed_over(tmp_path: Path, capsys: Capture) -> None:
    run = dry_run(capsys, two_cameras(v3(tmp_path / "d", demos=1, color="png"), "wrist"))
    verdict, says = run.checks["layout"]
    assert (run.code, verdict, "in a hand, and so not taken: wrist" in says) == (0, "assumed", True)
    assert run.checks["left out"][0] == "assumed"


def test_a_depth_feature_is_told_by_its_old_mark_and_its_unit_by_its_type(tmp_path: Path, capsys: Capture) -> None:
    path = v21(tmp_path / "d", demos=1, color="png")
    edit_json(path / "meta/info.json", lambda i: i["features"][DEPTH].update(info={"video.is_depth_map": True}))
    run = dry_run(capsys, path)
    assert (run.code, run.checks["depth unit"][0]) == (
        0,
        "assumed" if "custom" in run.checks["depth unit"][1] else "ok",
    )
    assert run.facts["depth_unit_m"] == 0.001


def test_what_belongs_to_another_episode_changes_nothing(tmp_path: Path) -> None:
    """The identity is that of the files of one episode, and changes with them."""
    path, settings = v21(tmp_path / "d", color="video"), RecordingSettings()
    before = [identity(p, settings) for p in find_recordings([path])]
    assert before[0] != before[1]
    moved = Path(shutil.move(path, tmp_path / "elsewhere"))
    assert [identity(p, settings) for p in find_recordings([moved])] == before
    write_video(moved / f"videos/chunk-000/{COLOR}/episode_000001.mp4", filmed(0).rgb)
    after = [identity(p, settings) for p in find_recordings([moved])]
    assert (after[0] == before[0], after[1] == before[1]) == (True, False)


def test_the_word_of_the_dataset_on_success_counts(tmp_path: Path) -> None:
    """Of ``next.success`` any step counts, where the episodes say nothing."""
    path = v3(tmp_path / "d", color="png")
    edit_table(path / "meta/episodes/chunk-000/file-000.parquet", lambda c: c.pop("success"))
    solved = [k == STEPS + 2 for k in range(2 * STEPS)]
    edit_table(path / "data/chunk-000/file-000.parquet", lambda c: c.update({"next.success": pa.array(solved)}))
    assert [bool(opened(p).success[-1]) for p in find_recordings([path])] == [False, True]


def test_success_may_be_a_number(tmp_path: Path) -> None:
    path = v3(tmp_path / "d", color="png")
    edit_table(path / "meta/episodes/chunk-000/file-000.parquet", lambda c: c.update(success=[0.0, 1.0]))
    assert [bool(opened(p).success[-1]) for p in find_recordings([path])] == [False, True]


def test_a_video_that_nothing_uses_may_be_missing(tmp_path: Path) -> None:
    """Even what would name its file."""
    path = v3(tmp_path / "d", demos=1)
    other = {"dtype": "video", "shape": [96, 128, 3], "names": None, "info": {}}
    edit_json(path / "meta/info.json", lambda i: i["features"].update({"observation.images.wrist": other}))
    (one,) = find_recordings([path])
    assert opened(one).frame(0).rgb is not None


def test_of_several_depths_the_one_called_like_the_color_is_taken(tmp_path: Path, capsys: Capture) -> None:
    path, other = v3(tmp_path / "d", demos=1, color="png"), "observation.depth.front"
    edit_json(path / "meta/info.json", lambda i: i["features"].update({other: i["features"][DEPTH]}))
    edit_table(path / "data/chunk-000/file-000.parquet", lambda c: c.update({other: c[DEPTH]}))
    assert f"{COLOR} with {DEPTH}" in dry_run(capsys, path).checks["layout"][1]
    edit_json(path / "meta/info.json", lambda i: i["features"].update({"depth.front": i["features"].pop(DEPTH)}))
    assert f"may all be the depth of {COLOR}" in dry_run(capsys, path).problem


def test_depth_with_another_calibration_is_refused(tmp_path: Path, capsys: Capture) -> None:
    path = v3(tmp_path / "d", demos=1, color="png")
    edit_json(path / "meta/info.json", lambda i: i["features"][DEPTH]["info"].update(
        camera={**i["features"][COLOR]["info"]["camera"], "K": [[500, 0, 64], [0, 500, 48], [0, 0, 1]]}))  # fmt: skip
    assert "has another K than that of" in dry_run(capsys, path).problem


def test_a_task_may_have_any_letters(tmp_path: Path) -> None:
    """What Unicode calls a separator of lines is none to JSON."""
    path = v21(tmp_path / "d", demos=1)
    lines = '{"task_index": 0, "task": "pour\u2028slowly\u0085"}\n'
    (path / "meta/tasks.jsonl").write_text(lines, encoding="utf-8")
    edit = (path / "meta/episodes.jsonl").read_text(encoding="utf-8")
    row = {**json.loads(edit.split("\n")[0]), "tasks": ["pour\u2028slowly"]}
    (path / "meta/episodes.jsonl").write_text(json.dumps(row, ensure_ascii=False) + "\n", encoding="utf-8")
    (one,) = find_recordings([path])
    assert opened(one).frame(0).rgb is not None


def without_tasks(path: Path) -> Path:
    """The same dataset, whose entries of episodes name no task."""
    for file in path.glob("meta/episodes/*/*.parquet"):
        edit_table(file, lambda c: c.pop("tasks"))
    for file in path.glob("meta/episodes.jsonl"):
        rows = [json.loads(line) | {"tasks": []} for line in file.read_text().splitlines()]
        file.write_text("".join(json.dumps(row) + "\n" for row in rows))
    return path


@pytest.mark.parametrize("write", [v3, v21])
def test_an_episode_without_words_has_those_of_its_steps(write: Write, tmp_path: Path, capsys: Capture) -> None:
    path = without_tasks(write(tmp_path / "d", color="png"))
    found = find_recordings([path])
    assert [choose_reader(p).task(p) for p in found] == [f"{TASK} 0", f"{TASK} 1"]  # type: ignore[attr-defined]
    run = dry_run(capsys, path / "episode_1")
    assert (run.code, run.facts["task"], "task" in run.checks) == (0, f"{TASK} 1", False)


def test_what_steps_say_of_tasks_is_told_where_it_is_odd(tmp_path: Path, capsys: Capture) -> None:
    path = v3(tmp_path / "d", color="png")
    table, half = path / "data/chunk-000/file-000.parquet", STEPS // 2
    numbers = [0] * STEPS + [0] * STEPS
    edit_table(table, lambda c: c.update(task_index=pa.array(numbers)))
    says = f"meta/ says {TASK} 1, which is taken, and task_index of the steps {TASK} 0"
    assert dry_run(capsys, path / "episode_1").checks["task"] == ("doubtful", says)
    without_tasks(path)
    numbers[STEPS:] = [1] * half + [0] * (STEPS - half)
    edit_table(table, lambda c: c.update(task_index=pa.array(numbers)))
    run = dry_run(capsys, path / "episode_1")
    assert run.facts["task"] == f"{TASK} 1"
    assert run.checks["task"] == ("assumed", f"has 2, of which the first is taken: {TASK} 1; {TASK} 0")
    edit_table(table, lambda c: c.update(task_index=pa.array([7] * 2 * STEPS)))
    run = dry_run(capsys, path / "episode_1")
    assert run.checks["task"] == ("assumed", "task_index of the steps is 7, which meta/tasks does not name")
    edit_table(table, lambda c: c.update(task_index=pa.array([np.nan] * 2 * STEPS)))
    run = dry_run(capsys, path / "episode_1")
    assert (run.code, run.problem.endswith("task_index holds float64, expected whole numbers")) == (3, True), run


def test_rewards_are_left_out_without_a_question(tmp_path: Path, capsys: Capture) -> None:
    path = v3(tmp_path / "d", demos=1, color="png")
    reward = {"dtype": "float32", "shape": [1], "names": None}
    edit_json(path / "meta/info.json", lambda i: i["features"].update({"next.reward": reward}))
    assert dry_run(capsys, path).checks["left out"][0] == "ok"
    edit_json(path / "meta/info.json", lambda i: i["features"].update({"observation.force": reward}))
    verdict, says = dry_run(capsys, path).checks["left out"]
    assert (verdict, says.partition(";")[0]) == ("assumed", "not used: observation.force")


def test_episodes_lie_in_several_files(tmp_path: Path) -> None:
    """As they do where there is more than fits into one, of numbers, videos and what is said of episodes."""
    path = v3(tmp_path / "d", demos=2)
    table, told, film = (
        path / "data/chunk-000/file-000.parquet",
        path / "meta/episodes/chunk-000/file-000.parquet",
        path / "videos",
    )
    for file, rows in ((table, STEPS), (told, 1)):
        whole, other = pq.read_table(file), file.with_name("file-001.parquet")
        pq.write_table(whole.slice(0, rows), file)
        pq.write_table(whole.slice(rows), other)
    other = path / "data/chunk-007/file-001.parquet"
    other.parent.mkdir()
    table.with_name("file-001.parquet").rename(other)
    write_video(film / f"{COLOR}/chunk-002/file-003.mp4", filmed(1).rgb)
    where = {"data/chunk_index": [7], "data/file_index": [1], f"videos/{COLOR}/chunk_index": [2],
             f"videos/{COLOR}/file_index": [3], f"videos/{COLOR}/from_timestamp": [0.0],
             f"videos/{COLOR}/to_timestamp": [STEPS / 20]}  # fmt: skip
    edit_table(told.with_name("file-001.parquet"), lambda c: c.update(where))
    for k, one in enumerate(find_recordings([path])):
        recording = opened(one)
        np.testing.assert_array_equal(recording.state, filmed(k).state)
        for t in range(STEPS):
            frame = recording.frame(t)
            assert np.abs(np.asarray(frame.rgb, int) - filmed(k).rgb[t]).mean() < 3
            np.testing.assert_allclose(frame.depth, filmed(k).depth[t], atol=6e-4)


def test_v20_is_read_too(tmp_path: Path, capsys: Capture) -> None:
    path = v21(tmp_path / "d", demos=1, color="png", codebase_version="v2.0")
    assert json.loads((path / "meta/info.json").read_text())["codebase_version"] == "v2.0"
    assert dry_run(capsys, path).code == 0


def test_the_usual_codec_of_lerobot_is_decoded_from_wherever_one_begins(tmp_path: Path) -> None:
    path = v3(tmp_path / "d")
    both = np.concatenate([filmed(k).rgb for k in range(2)])
    write_video(path / f"videos/{COLOR}/chunk-000/file-000.mp4", both, codec="libsvtav1")
    for k in (1, 0):
        streams = read_streams(choose_reader(path), path / f"episode_{k}", Metadata())
        for t in (4, 1, 0, 3, 2):
            assert np.abs(streams.color.read(t).astype(int) - filmed(k).rgb[t]).mean() < 8
