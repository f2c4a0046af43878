"""``flowlab grade`` as a user gives it: what it writes and prints, and what it says of mistakes."""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.image import imread

from flowlab.cli.grade import grade
from flowlab.errors import DataError, FlowlabError, MissingLibraryError, UsageError
from flowlab.geometry.camera import Camera
from flowlab.grading.origin import Origin
from flowlab.grading.run import grade as grade_in_python
from flowlab.recordings.writing import write_rgbd_recording

STEPS, WIDTH, HEIGHT = 12, 96, 72
CAMERA = Camera.from_fovy(WIDTH, HEIGHT, 50.0, np.eye(4))
EXAMPLES = Path(__file__).parents[2] / "examples"
GLOOMY = """
from flowlab.tracking.base import Tracker


class Gloomy(Tracker):
    name = "gloomy"
    license = "none"

    def open(self, clip):
        raise RuntimeError("not today")
"""
SLEEPY = GLOOMY.replace("Gloomy", "Sleepy").replace('raise RuntimeError("not today")', "__import__('time').sleep(300)")
SMALL = ("--size", "96x72", "--tracker", "lucas-kanade")


def write_slide(folder: Path, *, truth: bool = True) -> None:
    """A textured plane 1 m before the camera slides 1 px a step to the right; its points are known."""
    rng = np.random.default_rng(0)
    texture = np.kron(rng.integers(40, 215, (HEIGHT // 4, WIDTH // 2, 3)), np.ones((4, 4, 1))).astype(np.uint8)
    rgb = np.stack([texture[:, STEPS - t :][:, :WIDTH] for t in range(STEPS)])
    depth = np.ones((STEPS, HEIGHT, WIDTH), np.float32)
    query = rng.integers(15, 55, (20, 2)).astype(np.float32)
    uv = query + np.arange(STEPS)[:, None, None] * np.array([1.0, 0])
    tracks = np.append((uv - CAMERA.K[:2, 2]) / CAMERA.K[0, 0], np.ones((*uv.shape[:2], 1)), -1).astype(np.float32)
    known: dict[str, Any] = {"query_px": query, "tracks_cam": tracks, "visible": np.ones(uv.shape[:2], bool)}
    folder.parent.mkdir(parents=True, exist_ok=True)
    write_rgbd_recording(
        folder, rgb=rgb, depth=depth, camera=CAMERA, time_s=np.arange(STEPS) / 30, **(known if truth else {})
    )


def run(*arguments: str | Path) -> None:
    grade.main([str(a) for a in arguments], standalone_mode=False)


@pytest.fixture(scope="module")
def slides(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two recordings, one below another folder, and one whose truth is not known."""
    folder = tmp_path_factory.mktemp("slides")
    write_slide(folder / "one")
    write_slide(folder / "deeper" / "two")
    write_slide(folder / "unknown", truth=False)
    return folder


def test_recordings_below_a_folder_are_graded(slides: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run(slides, slides / "one", "--tracker", "lucas-kanade", "--out", tmp_path)
    printed = capsys.readouterr()
    values = json.loads((tmp_path / "grade.json").read_text())
    (tracker,) = values["trackers"]
    assert tracker["tracker"] == "lucas-kanade"
    assert [r["recording"] for r in tracker["recordings"]] == ["two", "one"]
    assert [r["frames"] for r in tracker["recordings"]] == [STEPS] * 2
    assert tracker["mean"]["all"]["median_mm"] < 2, "a textured plane that slides is easy"
    assert tracker["mean"]["tapvid"]["apd"] > 0.9
    assert "moving" not in tracker["mean"], "nobody said what the points lie on"
    assert values["simulated"] is None
    assert [(r["scene"], r["seed"], r["sensor"], r["size"]) for r in tracker["recordings"]] == [
        ("", None, "", [WIDTH, HEIGHT])
    ] * 2
    assert imread(tmp_path / "grade.png").shape[0] > 300
    for word in ("lucas-kanade", "visible", "two", "one", "3D-AJ", "grade.png"):
        assert word in printed.out
    assert max(map(len, printed.out.splitlines()[:-1])) <= 80


def test_a_report_says_what_was_graded_and_with_what(slides: Path, tmp_path: Path) -> None:
    report = grade_in_python([slides], tmp_path, trackers=["lucas-kanade"])
    assert report.graded == ("two", "one")
    own = "sensor of own recordings not stated"
    assert report.about == ("2 recordings", f"{2 * STEPS} frames, 40 query points", own, "96 × 72 px")
    (tracker,) = report.trackers
    film = replace(tracker.rows[0], origin=Origin("thin", 1000, "tof"))
    mixed = replace(report, trackers=(replace(tracker, rows=(film, tracker.rows[1])),))
    assert mixed.graded == ("thin", "one")
    assert mixed.about[0] == "2 recordings (seed 1000)"
    assert mixed.about[2:4] == ("simulated sensor: tof", own)
    carried = replace(film, origin=Origin("thin", 1000, "tof", "traveling"))
    both = replace(report, trackers=(replace(tracker, rows=(film, carried)),))
    assert both.graded == ("thin", "thin, traveling"), "one mean of both would be of neither"
    assert list(both.trackers[0].by_scene()) == ["thin", "thin, traveling"]
    assert [row["camera"] for row in both.to_json()["trackers"][0]["recordings"]] == ["", "traveling"]


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"camera": 3}, "camera: must be a name; found 3"),
        ({"camera": ""}, "camera: must be a name; found ''"),
        ({"sensor": True}, "sensor: must be a name; found True"),
        ({"size": "320x240"}, "size: must be a width and a height, as in size=\\(320, 240\\); found '320x240'"),
        ({"size": (3,)}, "size: must be a width and a height"),
    ],
)
def test_arguments_of_a_wrong_kind(wrong: dict[str, Any], words: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=words):
        grade_in_python(scenes="thin", out=tmp_path / "x", **wrong)
    assert not (tmp_path / "x").exists()


def test_json_is_all_that_is_printed(slides: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run(slides / "one", "--tracker", "lucas-kanade", "--out", tmp_path, "--json", "--chunk", "8", "--stride", "4")
    printed = capsys.readouterr()
    values = json.loads(printed.out)
    assert values == json.loads((tmp_path / "grade.json").read_text())
    assert (values["chunks"]["length"], values["chunks"]["stride"]) == (8, 4)
    assert printed.err == ""


def test_trackers_side_by_side(slides: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    both = ("--tracker", "lucas-kanade", "--tracker", "rigid-bodies")
    run(slides / "one", *both, "--out", tmp_path, "--set", "lucas-kanade.window=9")
    trackers = json.loads((tmp_path / "grade.json").read_text())["trackers"]
    assert [t["tracker"] for t in trackers] == ["lucas-kanade", "rigid-bodies"]
    assert trackers[0]["options"]["window"] == 9
    assert "rigid-bodies" in capsys.readouterr().out


def figures(out: Path) -> Any:
    """What a run found, but for the times it took."""
    return json.loads((out / "grade.json").read_text(), object_hook=_without_times)


def _without_times(values: dict[str, Any]) -> dict[str, Any]:
    return {k: v for k, v in values.items() if k not in ("cpu_s", "ms_per_frame")}


def test_who_does_the_work_makes_no_difference(
    slides: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.syspath_prepend(EXAMPLES)
    asked = (slides, "--tracker", "lucas-kanade", "--out")
    run(*asked, tmp_path / "serial", "--engine", "09_own_engine:SerialEngine")
    run(*asked, tmp_path / "local", "--workers", "2")
    assert figures(tmp_path / "serial") == figures(tmp_path / "local")
    assert sorted(p.name for p in (tmp_path / "local").iterdir()) == ["grade.json", "grade.png"], "no tracks are left"
    assert "two: 12 frames; CPU time: lucas-kanade" in capsys.readouterr().err
    with pytest.raises(UsageError, match="no engine is called 'lokal'; did you mean local"):
        run(*asked, tmp_path / "other", "--engine", "lokal")


def kill_a_run(recording: Path, out: Path, modules: Path) -> Path:
    """Start a run, and kill it with its workers as they label; what it leaves."""
    (modules / "sleepy.py").write_text(SLEEPY)
    command = [sys.executable, "-m", "flowlab", "grade", recording, "--tracker", "sleepy:Sleepy", "--out", out]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(modules), *filter(None, sys.path)])}
    process = subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, start_new_session=True)
    try:
        end = time.monotonic() + 60
        while not (out.is_dir() and list(out.iterdir())):
            assert process.poll() is None, process.communicate()
            assert time.monotonic() < end, "waited in vain"
            time.sleep(0.01)
    finally:
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
    (left,) = out.iterdir()
    return left


def test_what_a_killed_run_left_is_deleted_and_nothing_else(slides: Path, tmp_path: Path) -> None:
    out, outside = tmp_path / "out", tmp_path / "outside"
    for folder in (outside, outside / "deeper"):
        folder.mkdir()
        (folder / "precious.txt").write_text("keep")
    left = kill_a_run(slides / "one", out, tmp_path)
    assert left.is_dir()
    (left / "0-0.npz").symlink_to(outside)
    machine, _, rest = left.name.partition("+")
    dead, tracks = rest.split("+")
    (out / f"{machine}+{dead}+tracks-link").symlink_to(outside / "deeper")
    others = {
        f"{machine}+{os.getpid()}+{tracks}": "of a run that goes on",
        f"{machine}-b+{dead}+{tracks}": "of another machine's",
        f"{machine}+{dead}{tracks}": "of nobody's",
        ".tracks-mine": "of the user's",
        "tracks": "of the user's",
    }
    for name, whose in others.items():
        (out / name).mkdir()
        (out / name / "0-0.npz").write_text(whose)
    grade_in_python(slides / "one", out, trackers="lucas-kanade")  # the command's picture would be cleaned up for, too
    assert {p.name for p in out.iterdir()} == {"grade.json", *others}
    assert {name: (out / name / "0-0.npz").read_text() for name in others} == others
    assert [f.read_text() for f in outside.rglob("precious.txt")] == ["keep"] * 2


def test_a_tracker_that_fails_ends_it_with_its_own_words(
    slides: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "gloomy.py").write_text(GLOOMY)
    with pytest.raises(FlowlabError, match=r"one: could not be graded \(RuntimeError: not today\); no report was wri"):
        run(slides / "one", "--tracker", "gloomy:Gloomy", "--out", tmp_path / "out")
    assert not list((tmp_path / "out").iterdir())


@pytest.mark.slow
def test_tasks_are_simulated_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    try:
        run(*SMALL, "--tasks", "reach", "--sensor", "clean", "--out", tmp_path)
    except MissingLibraryError as error:
        pytest.skip(str(error))
    assert [p.name for p in (tmp_path / "recordings").iterdir()] == ["reach-0"]
    assert "reach-0: recorded" in capsys.readouterr().err
    values = json.loads((tmp_path / "grade.json").read_text())
    assert values["simulated"]["tasks"]["sensor"]["axial_noise"] == 0
    assert values["trackers"][0]["mean"]["moving"]["n"] > 100
    run(*SMALL, "--tasks", "reach", "--sensor", "clean", "--out", tmp_path)
    assert "there already" in capsys.readouterr().err
    run(*SMALL, "--tasks", "reach", "--seed", "1", "--out", tmp_path)
    assert (tmp_path / "recordings" / "reach-1").is_dir()
    assert "not graded, because" in capsys.readouterr().out, "noise costs queries"


def test_scenes_are_filmed_and_told_by_family(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    try:
        run(*SMALL, "--scenes", "thin,plain", "--seed", "7", "--out", tmp_path)
    except MissingLibraryError as error:
        pytest.skip(str(error))
    assert {p.name for p in (tmp_path / "recordings").iterdir()} == {"thin-7", "plain-7"}
    out = capsys.readouterr().out
    assert "by family of scenes, or task" in out
    assert "%" in out, "how often labels are confidently wrong"
    (tracker,) = json.loads((tmp_path / "grade.json").read_text())["trackers"]
    assert set(tracker["scenes"]) == {"thin", "plain"}
    assert 0 <= tracker["scenes"]["thin"]["confidently_wrong"] <= 1
    assert {row["scene"] for row in tracker["recordings"]} == {"thin", "plain"}
    assert {(row["seed"], row["sensor"], *row["size"]) for row in tracker["recordings"]} == {
        (7, "drawn by the seed", 96, 72)
    }


@pytest.mark.parametrize(
    ("arguments", "error", "expected"),
    [
        ((*SMALL, "--scenes", "tabeltop"), UsageError, "did you mean tabletop"),
        ((), UsageError, "nothing to grade; give folders .* or --tasks hammer,push"),
        ((*SMALL, "--tasks", "reach, hamer"), UsageError, "did you mean hammer"),
        (
            ("--tasks", "hammer", "--tracker", "rigid-body"),
            UsageError,
            "no tracker is called 'rigid-body'; did you mean rigid-bodies",
        ),
        (("--tasks", "hammer", "--size", "320"), UsageError, "--size 320: must look like 320x240"),
        (("--tasks", "hammer", "--chunk", "4"), UsageError, r"--chunk, --stride: stride \(8\) must be below length"),
        (("--tasks", "hammer", "--set", "window"), UsageError, "--set window: must look like KEY=VALUE"),
        ((*SMALL, "--tasks", "hammer", "--set", "size=3"), UsageError, "no option is called 'size'"),
        (("--tasks", "hammer", "--set", "body.x=3"), UsageError, "no tracker of this run is called 'body'"),
        (("--tasks", "hammer", "--set", "x=["), UsageError, "not valid YAML"),
        ((*SMALL, "--tasks", "hammer", "--weights", "w.pt"), UsageError, "no option is called 'weights'"),
        ((*SMALL, "no/such/folder"), DataError, "no/such/folder: there is no such folder"),
    ],
)
def test_mistakes_are_told(
    arguments: tuple[str, ...], error: type[FlowlabError], expected: str, tmp_path: Path
) -> None:
    with pytest.raises(error, match=expected):
        run(*arguments, "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists(), "nothing was begun"


def test_a_recording_without_truth(slides: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"unknown: no recording at or below it has a ground_truth.npz.*--tasks"):
        run(slides / "unknown", "--tracker", "lucas-kanade", "--out", tmp_path / "out")


def test_a_folder_that_cannot_be_written(slides: Path, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(FlowlabError, match="choose another --out"):
        run(slides / "one", "--tracker", "lucas-kanade", "--out", tmp_path / "file" / "out")


@pytest.mark.parametrize(
    "settings", [{"__EGL_VENDOR_LIBRARY_FILENAMES": "/nonexistent"}, {"MUJOCO_GL": "no-such-backend"}]
)
def test_without_opengl_it_says_what_to_install(settings: dict[str, str], tmp_path: Path) -> None:
    command = """if True:
        import sys
        from flowlab.cli.grade import grade
        from flowlab.errors import FlowlabError
        try:
            grade.main(sys.argv[1:], standalone_mode=False)
        except FlowlabError as error:
            sys.exit(str(error))"""
    inherited = {k: v for k, v in os.environ.items() if k not in ("MUJOCO_GL", "PYOPENGL_PLATFORM", "DISPLAY")}
    arguments = [*SMALL, "--tasks", "reach", "--out", str(tmp_path)]
    result = subprocess.run(
        [sys.executable, "-c", command, *arguments], capture_output=True, text=True, env=inherited | settings
    )
    assert result.returncode == 1
    last = result.stderr.strip().splitlines()[-1]
    assert last.startswith(("OpenGL cannot be used here", "MuJoCo cannot load OpenGL"))
    assert "apt-get install libegl1" in last
