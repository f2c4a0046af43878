"""LeRobot datasets of strangers: nothing outside the folder is opened, and what is odd is one sentence."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from dry_runs import dry_run
from hdf5_files import STEPS, filmed
from lerobot_files import COLOR, DEPTH, v3, v21, write_video
from synthetic import call_cli, edit_json
from test_lerobot_reader import edit_table

from flowlab.errors import DataError
from flowlab.recordings.base import BadImage, choose_reader, read_streams
from flowlab.recordings.readers import helper_process, lerobot_process, lerobot_tables
from flowlab.recordings.recording_yaml import Metadata

Capture = pytest.CaptureFixture[str]
Change = Callable[[Path], object]
TABLE, EPISODES, TASKS = (
    "data/chunk-000/file-000.parquet",
    "meta/episodes/chunk-000/file-000.parquet",
    "meta/tasks.parquet",
)
VIDEO = f"videos/{COLOR}/chunk-000/file-000.mp4"


def info(**values: Any) -> Change:
    return lambda path: edit_json(path / "meta/info.json", lambda i: i.update(values))


def of_feature(name: str, **values: Any) -> Change:
    return lambda path: edit_json(path / "meta/info.json", lambda i: i["features"][name].update(values))


def camera(**values: Any) -> Change:
    return lambda path: edit_json(
        path / "meta/info.json", lambda i: i["features"][COLOR]["info"]["camera"].update(values)
    )


def columns(file: str, **values: Any) -> Change:
    return lambda path: edit_table(
        path / file, lambda c: c.update({k.replace("__", "/"): v for k, v in values.items()})
    )


def without(file: str, *names: str) -> Change:
    return lambda path: edit_table(path / file, lambda c: [c.pop(n) for n in names])


def column(file: str, name: str, values: Any) -> Change:
    return lambda path: edit_table(path / file, lambda c: c.update({name: values}))


def gone(file: str) -> Change:
    return lambda path: (path / file).unlink()


def written(file: str, content: bytes) -> Change:
    return lambda path: (path / file).write_bytes(content)


def nan_state() -> pa.Array:
    rows = filmed().state.copy()
    rows[2, 3] = np.nan
    return pa.array(rows.tolist(), pa.list_(pa.float32()))


def ragged() -> pa.Array:
    return pa.array([[0.0] * (9 - (t == 3)) for t in range(STEPS)], pa.list_(pa.float32()))


def renamed(path: Path) -> None:
    edit_json(
        path / "meta/info.json",
        lambda i: i.update(
            features={re.sub("front_depth", "depth.top", k): f for k, f in i["features"].items()}
            | {"observation.images.side": i["features"][COLOR]}
        ),
    )


def linked(path: Path) -> None:
    (path / VIDEO).unlink()
    (path / VIDEO).symlink_to(path / VIDEO)


STAMPS = np.arange(STEPS, dtype=np.float32) / 20
REFUSED: dict[str, tuple[Change, str]] = {
    "version": (info(codebase_version="v1.6"), r"codebase_version is 'v1.6', flowlab reads v3.0, v2.1 and v2.0"),
    "version that is a list": (info(codebase_version=["v3.0"]), r"codebase_version is .*flowlab reads"),
    "fps": (info(fps=1e300), r"fps is 1e\+300, expected pictures a second"),
    "fps in words": (info(fps="thirty"), r"fps is 'thirty', expected"),
    "fps that is none": (info(fps=float("nan")), r"fps is nan, expected"),
    "features": (info(features=[1, 2]), r"features is \[1, 2\], expected a mapping"),
    "a feature": (
        lambda p: edit_json(p / "meta/info.json", lambda i: i["features"].update(x=3)),
        r"the feature 'x' is 3",
    ),
    "a shape": (of_feature("action", shape=[9, -1]), r"'action' has the shape \[9, -1\], expected whole numbers"),
    "a shape too large": (
        of_feature("action", shape=[10**9, 10**9]),
        r"'action' has the shape \[1000000000, 1000000000\], expected at most",
    ),
    "another shape": (
        of_feature("action", shape=[7]),
        r"action has 9 numbers a step, and meta/info.json gives it the shape \[7\]",
    ),
    "another depth picture": (
        of_feature(DEPTH, shape=[480, 640, 1]),
        r"has pictures of 128x96, and '.*front_depth' in .* has the shape \[480, 640, 1\]",
    ),
    "another picture": (
        of_feature(COLOR, shape=[480, 640, 3]),
        r"has pictures of 128x96, and '.*front' in .* has the shape \[480, 640, 3\]",
    ),
    "path that leads out": (
        info(data_path="../secret/{chunk_index}.parquet"),
        r"names '../secret/0.parquet', expected a file below",
    ),
    "path from the root": (info(video_path="/etc/{video_key}"), r"names '/etc/.*', expected a file below the dataset"),
    "path of objects": (
        info(data_path="{chunk_index.__class__}"),
        r"names '\{chunk_index.__class__\}', expected a file below",
    ),
    "path of great width": (info(data_path="{chunk_index:0999999999d}"), r"expected a file below the dataset"),
    "path of something else": (
        info(data_path="{episode_index:06d}.parquet"),
        r"has '\{episode_index\}', expected chunk_index, file_index",
    ),
    "path that is no text": (info(video_path=7), r"video_path is 7, expected a path"),
    "count of episodes": (
        info(total_episodes=10**15),
        r"says there are 1,000,000,000,000,000 episodes, and meta/episodes has 1; copy it again",
    ),
    "no episodes": (
        gone(EPISODES),
        r"has no meta/episodes/\*/\*.parquet, where a dataset of v3.0 tells of its episodes",
    ),
    "no table": (
        gone(TABLE),
        r"file-000.parquet: there is no such file, and the dataset says so; copy the dataset again",
    ),
    "no video": (gone(VIDEO), r"file-000.mp4: there is no such file, and the dataset says so"),
    "a link to itself": (linked, r"file-000.mp4: cannot be read \(Too many levels of symbolic links\)"),
    "a pointer": (
        written(VIDEO, b"version https://git-lfs.github.com/spec/v1\noid 1"),
        r"is a pointer of Git LFS.*'git lfs pull'",
    ),
    "a list of other files": (
        written(VIDEO, b"#EXTM3U\n#EXT-X-TARGETDURATION:9\n#EXTINF:9,\n/etc/passwd\n"),
        r"is no readable MP4 video",
    ),
    "no parquet": (written(TABLE, b"PAR1 nothing"), r"is no readable Parquet file"),
    "no table of episodes": (written(EPISODES, b""), r"is no readable Parquet file"),
    "steps": (
        columns(EPISODES, length=[10**12]),
        r"says the episode 0 has 1,000,000,000,000 steps, expected 1 to 1,000,000",
    ),
    "too few rows": (
        columns(EPISODES, length=[STEPS + 1]),
        r"has 5 rows of episode_000000, and meta/ says it has 6 steps",
    ),
    "an index that is none": (
        columns(EPISODES, episode_index=[-1]),
        r"episode_index is -1, expected a whole number from 0 on",
    ),
    "a file that is none": (
        column(EPISODES, "data/file_index", pa.array([None], pa.int64())),
        r"data/file_index is None, expected",
    ),
    "a start that is none": (
        column(EPISODES, f"videos/{COLOR}/from_timestamp", [float("nan")]),
        r"from_timestamp is nan, expected seconds",
    ),
    "pictures of another episode, too": (
        column(EPISODES, f"videos/{COLOR}/to_timestamp", [0.5]),
        r"is from 0 to 0.5 s in its file, and 5 steps at 20 a second last 0.25 s",
    ),
    "half a success": (columns(EPISODES, success=[0.5]), r"success of meta/episodes is 0.5, expected true or false"),
    "success in words": (columns(EPISODES, success=["false"]), r"success of meta/episodes is 'false', expected true"),
    "a count in words": (info(total_episodes="1"), r"total_episodes is '1', expected a whole number"),
    "a mark in words": (
        of_feature(DEPTH, info={"is_depth_map": "false"}),
        r"is_depth_map of '.*' is 'false', expected true or false",
    ),
    "axes in a list": (camera(axes=["opencv"]), r"axes is \['opencv'\], expected opencv"),
    "a matrix beyond numbers": (camera(K=[[10**400, 0, 1], [0, 1, 1], [0, 0, 1]]), r"K is .*finite numbers"),
    "a start beyond the end": (
        lambda p: edit_table(
            p / EPISODES,
            lambda c: c.update({f"videos/{COLOR}/from_timestamp": [9.0], f"videos/{COLOR}/to_timestamp": [9.25]}),
        ),
        r"ends after 0.250 s, and the last picture of episode_000000 would be at 9.200 s",
    ),
    "rows of nobody": (without(TABLE, "episode_index"), r"has no column episode_index"),
    "no actions": (without(TABLE, "action"), r"has no column action, which meta/info.json says there is"),
    "not a number": (
        column(TABLE, "observation.state", nan_state()),
        r"observation.state holds a value that is not finite in step 2",
    ),
    "rows of different lengths": (column(TABLE, "action", ragged()), r"'action' has rows of different lengths"),
    "words": (column(TABLE, "action", ["a"] * STEPS), r"'action' holds string, expected numbers"),
    "stamps": (
        column(TABLE, "timestamp", pa.array(STAMPS * 1.5)),
        r"timestamp is 0.07\d* in step 1 of episode_000000, and at 20 pictures a second it would be 0.05",
    ),
    "stamps that are none": (
        column(TABLE, "timestamp", pa.array(STAMPS * np.nan)),
        r"timestamp holds a value that is not finite",
    ),
    "numbers of frames": (
        column(TABLE, "frame_index", pa.array(range(3, 3 + STEPS))),
        r"frame_index is 3 in step 0.*would be 0",
    ),
    "no depth": (
        lambda p: edit_json(p / "meta/info.json", lambda i: i["features"].pop(DEPTH)),
        r"without depth pictures \(its pictures are .*front\)",
    ),
    "depth of nobody": (
        renamed,
        r"whose depth \(observation.images.depth.top\) belongs to none of its color pictures by its name",
    ),
    "a unit": (
        of_feature(DEPTH, info={"is_depth_map": True, "depth_unit": "inch"}),
        r"depth_unit of '.*front_depth' is 'inch', expected m or mm",
    ),
    "a matrix": (camera(K=[[1, 2], [3, 4]]), r"camera.K is \[\[1, 2\], \[3, 4\]\], expected 3 x 3 finite numbers"),
    "a matrix of objects": (camera(K={"a": 1}), r"camera.K is \{'a': 1\}, expected 3 x 3 finite numbers"),
    "a pose": (camera(T_world_cam=np.diag([1.0, 2, 3, 1]).tolist()), r"camera.T_world_cam.*rotation"),
    "axes": (camera(axes="left"), r"camera.axes is 'left', expected opencv"),
    "centers": (camera(pixel_centers=0.3), r"pixel_centers is 0.3, expected 0, or 0.5"),
}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return v3(tmp_path_factory.mktemp("whole") / "d", demos=1)


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_wrong_is_one_sentence(name: str, whole: Path, tmp_path: Path, capsys: Capture) -> None:
    change, sentence = REFUSED[name]
    path = Path(shutil.copytree(whole, tmp_path / "d"))
    change(path)
    code, out, err = call_cli(capsys, "track-real", path, "--dry-run", "--tracker", "lucas-kanade")
    assert code in (2, 3), out + err
    assert re.search(sentence, (out + err).replace("\n", " ")), out + err
    assert "Traceback" not in out + err


LINES: dict[str, tuple[str, bytes, str]] = {
    "no JSON": ("episodes", b"{episode_index: 0}\n", r"episodes.jsonl, line 1: not valid JSON"),
    "no mapping": ("episodes", b"[1, 2]\n", r"line 1: is \[1, 2\], expected a mapping"),
    "twice": ("episodes", b'{"episode_index": 0, "length": 5}\n' * 2, r"has the episode 0 twice"),
    "no length": ("episodes", b'{"episode_index": 0}\n', r"length is None, expected a whole number"),
    "a task of nothing": (
        "tasks",
        b'{"task_index": "x", "task": "y"}\n',
        r"task_index is 'x', expected a whole number",
    ),
}


@pytest.mark.parametrize("name", LINES)
def test_what_is_wrong_in_lines_is_one_sentence(name: str, tmp_path: Path, capsys: Capture) -> None:
    file, content, sentence = LINES[name]
    path = v21(tmp_path / "d", demos=1, color="png")
    (path / f"meta/{file}.jsonl").write_bytes(content)
    run = dry_run(capsys, path)
    assert run.code == 3
    assert re.search(sentence, run.problem), run.problem


def coded(**values: Any) -> Change:
    def change(path: Path) -> None:
        edit_json(
            path / "meta/info.json",
            lambda i: i["features"][DEPTH]["info"].update({f"video.{k}": v for k, v in values.items()}),
        )

    return change


CODES: dict[str, tuple[Change, str]] = {
    "no range": (
        coded(depth_min=5.0, depth_max=1.0),
        r"depth_min 5 and depth_max 1, expected 0 <= depth_min < depth_max",
    ),
    "no logarithm": (coded(shift=-3.0), r"shift -3, expected more than -depth_min"),
    "no number": (coded(depth_max="far"), r"video.depth_max of '.*' is 'far', expected a float"),
    "not finite": (coded(depth_max=float("inf")), r"depth_max inf, expected"),
    "colors": (
        lambda p: write_video(p / f"videos/{DEPTH}/chunk-000/file-000.mp4", filmed().rgb),
        r"is said to be depth and has pixels of yuv444p, expected gray12le",
    ),
}


@pytest.mark.parametrize("name", CODES)
def test_a_depth_code_that_is_none_is_refused(name: str, whole: Path, tmp_path: Path, capsys: Capture) -> None:
    change, sentence = CODES[name]
    path = v3(tmp_path / "d", demos=1, color="png", depth="video")
    change(path)
    run = dry_run(capsys, path)
    assert (run.code, bool(re.search(sentence, run.problem))) == (3, True), run.problem


def test_words_of_tasks_are_names_of_nothing_else(tmp_path: Path, capsys: Capture) -> None:
    path = v3(tmp_path / "d", demos=1, color="png")
    edit_table(path / EPISODES, lambda c: c.update(tasks=pa.array([["../../x\x1b[31m"]])))
    code, out, err = call_cli(capsys, "track-real", path, "--dry-run", "--tracker", "lucas-kanade")
    assert code == 0, err
    assert "\x1b" not in out + err
    assert re.search(r"task 'x-31m-[0-9a-f]{8}'", out), out


def test_pictures_that_are_none_are_bad_frames(tmp_path: Path) -> None:
    path = v3(tmp_path / "d", demos=1, color="png", depth="tiff")
    contents = [b"\x89PNG\r\n\x1a\n" + bytes(40), None, b"II*\0" + bytes(60), b"", b"GIF89a"]

    def change(table: dict[str, Any]) -> None:
        for name in (COLOR, DEPTH):
            table[name] = pa.array(
                [{"bytes": c, "path": "/etc/passwd"} for c in contents],
                pa.struct([("bytes", pa.binary()), ("path", pa.string())]),
            )

    edit_table(path / TABLE, change)
    streams = read_streams(choose_reader(path), path, Metadata())
    for pictures in (streams.color, streams.depth):
        for k in range(STEPS):
            with pytest.raises(BadImage) as told:
                pictures.read(k)
            assert "no picture embedded in row 1; it names '/etc/passwd' instead" in str(told.value) or k != 1


def test_a_table_that_unpacks_to_too_much_is_refused(whole: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lerobot_tables, "MAX_LOADED_BYTES", 300)
    with pytest.raises(DataError, match=r"'action' unpacks to 360 bytes, expected at most 300"):
        lerobot_tables.ParquetTables().columns(str(whole / TABLE), ["action"])


def test_a_library_that_crashes_is_told_and_the_next_dataset_read(whole: Path, tmp_path: Path) -> None:
    path = Path(shutil.copytree(whole, tmp_path / "d"))
    streams = read_streams(choose_reader(path), path, Metadata())
    pid = helper_process.HELPERS[lerobot_process._SERVE]._process.pid
    os.kill(pid, signal.SIGSTOP)
    threading.Timer(0.2, lambda: [os.kill(pid, s) for s in (signal.SIGSEGV, signal.SIGCONT)]).start()
    with pytest.raises(
        BadImage, match=r"the library that reads it crashes on it, so it is damaged or made to do that; copy it again"
    ):
        streams.color.read(1)
    read_streams(choose_reader(whole), whole, Metadata()).color.read(1)


@pytest.mark.skipif(shutil.which("strace") is None, reason="needs strace")
def test_a_video_that_lists_others_opens_none(tmp_path: Path) -> None:
    path = v3(tmp_path / "d", demos=1)
    shutil.copy(path / VIDEO, secret := (path / VIDEO).with_name("secret.mp4"))
    (path / VIDEO).write_text("ffconcat version 1.0\nfile secret.mp4\n")
    work = "from flowlab.recordings.recording import *; from sys import *; describe(argv[1], RecordingSettings())"
    call = ["strace", "-f", "-e", "trace=open,openat", "-o", tmp_path / "log", sys.executable, "-c", work, str(path)]
    done = subprocess.run(call, check=False, capture_output=True)
    assert b"is no readable MP4 video" in done.stderr, done.stderr
    assert json.dumps(str(secret)) not in (tmp_path / "log").read_text()
    assert str(path / VIDEO) in (tmp_path / "log").read_text()
