"""``flowlab track-real`` as a user runs it: the same dataset however it comes about, and nothing bad left unsaid."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
from conftest import Cli
from synthetic import assert_same, call_cli, files_below
from synthetic_clip import record

from flowlab.storage.dataset import Dataset

SETTINGS = ("observer.points=256", "queries.points=40", "quality.min_sure_share=0", "quality.max_median_sigma_m=9")
SMALL = ("--tracker", "lucas-kanade", *(word for change in SETTINGS for word in ("--set", change)))
NAMES = ("1", "2", "10", "11", "12")


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five recordings of one task."""
    folder = tmp_path_factory.mktemp("recordings") / "slide"
    for k, name in enumerate(NAMES):
        record(folder / name, frames=12, seed=k)
    return folder


@pytest.fixture(scope="module")
def dataset(recordings: Path, tmp_path_factory: pytest.TempPathFactory, flowlab: Cli) -> Path:
    """All of them, labeled by two workers."""
    out = tmp_path_factory.mktemp("data") / "slide"
    result = flowlab("track-real", recordings, "--out", out, "--workers", 2, *SMALL)
    assert result.returncode == 0, result.stderr
    return out


def content(folder: Path) -> dict[str, bytes]:
    """Every file of a dataset that must not depend on how it came about."""
    files = [*folder.glob("shards/**/*"), *folder.glob("rejects/**/*")]
    files += [folder / name for name in ("flowlab.json", "stats.json", "rejects.jsonl")]
    return {str(f.relative_to(folder)): f.read_bytes() for f in files if f.is_file()}


def test_recordings_become_a_sound_dataset(dataset: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert call_cli(capsys, "validate", dataset) == (0, f"{dataset}: sound\n", "")
    assert [(r.name, r.seed) for r in Dataset(dataset).manifest.recordings] == list(zip(NAMES, range(5), strict=True))
    info = json.loads(call_cli(capsys, "info", dataset, "--json")[1])
    assert info["episodes"] == 5
    assert info["world_frame"].startswith("each recording's own")
    assert [r["name"] for r in info["recordings"]] == list(NAMES)
    assert [s["stage"] for s in info["stages"]] == [
        "recording", "observer", "queries", "track", "lift", "quality", "write",
    ]  # fmt: skip
    assert "stated error of visible points: median" in call_cli(capsys, "info", dataset)[1]


def test_one_worker_and_a_simulator_that_cannot_be_loaded_give_the_same_files(
    recordings: Path, dataset: Path, tmp_path: Path, flowlab: Cli
) -> None:
    environment = {**os.environ, "MUJOCO_GL": "no-such-backend"}
    command = ("track-real", recordings, "--out", tmp_path / "d", "--workers", 1, *SMALL)
    result = flowlab(*command, env=environment)
    assert result.returncode == 0, result.stderr
    assert content(tmp_path / "d") == content(dataset)


def wait_until(condition: Callable[[], bool], seconds: float = 60) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.01)


def workers_of(pid: int) -> list[str]:
    """Processes still running in the group of a killed run."""
    found = subprocess.run(["ps", "-o", "pid=", "-g", str(pid)], capture_output=True, text=True, check=False)
    return found.stdout.split()


@pytest.mark.slow
def test_killed_it_opens_and_the_same_command_finishes_it(
    recordings: Path, dataset: Path, tmp_path: Path, flowlab: Cli
) -> None:
    out = tmp_path / "killed"
    arguments = ["track-real", str(recordings), "--out", str(out), "--workers", "1", *SMALL]
    command = [sys.executable, "-m", "flowlab", *arguments]
    run = subprocess.Popen(command, stderr=subprocess.DEVNULL, start_new_session=True)
    wait_until(lambda: len(list(out.glob("receipts/*.json"))) >= 1)
    run.kill()
    run.wait()
    wait_until(lambda: not workers_of(run.pid))
    done = {p.name: p.stat().st_mtime_ns for p in out.glob("receipts/*.json")}
    assert 1 <= len(done) < 5
    assert sum(Dataset(out).missing.values()) == 5 - len(done)
    unfinished = flowlab("validate", out)
    assert unfinished.returncode == 3
    assert f"slide: {len(done)} of 5 recordings; run the same" in unfinished.stdout
    result = flowlab(*arguments)
    assert result.returncode == 0, result.stderr
    assert content(out) == content(dataset)
    again = {p.name: p.stat().st_mtime_ns for p in out.glob("receipts/*.json")}
    assert done.items() <= again.items(), "a recording was labeled twice"


@pytest.mark.slow
def test_shards_of_a_job_array_fill_one_dataset_together(
    recordings: Path, dataset: Path, tmp_path: Path, flowlab: Cli
) -> None:
    command = ("track-real", recordings, "--out", tmp_path / "d", "--workers", 1, *SMALL)
    first = flowlab(*command, "--shard", "0/2", "--json")
    assert json.loads(first.stdout)["missing"] == {"slide": 2}
    second = flowlab(*command, "--shard", "1/2", "--json")
    assert json.loads(second.stdout)["missing"] == {}
    assert content(tmp_path / "d") == content(dataset)


def test_recordings_are_appended_and_the_others_left_alone(
    recordings: Path, dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "d"
    command = ("track-real", "--out", out, "--workers", "1", *SMALL)
    assert call_cli(capsys, *command, recordings / "10", recordings / "2")[0] == 0
    before = {n: f for n, f in files_below(out).items() if n.startswith(("shards", "receipts"))}
    assert call_cli(capsys, *command, recordings)[0] == 0
    after = files_below(out)
    assert {n: after[n] for n in before} == before
    grown = Dataset(out)
    assert [(r.name, r.seed) for r in grown.manifest.recordings] == [
        ("2", 0), ("10", 1), ("1", 2), ("11", 3), ("12", 4),
    ]  # fmt: skip
    assert grown.manifest.requested == {"slide": 5}
    assert_same(grown.episode(0).tracks, Dataset(dataset).episode(1).tracks)


def truncate(picture: Path) -> None:
    picture.write_bytes(picture.read_bytes()[:100])


def test_bad_frames_are_named_and_too_many_of_them_reject_a_recording(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    one, many = (record(tmp_path / "rec/slide" / name, frames=12) for name in ("one", "many"))
    truncate(one / "color/000004.png")
    for t in (2, 3, 4, 5):
        truncate(many / f"depth/{t:06d}.png")
    command = ("track-real", tmp_path / "rec", "--out", tmp_path / "d", "--workers", "1", *SMALL)
    code, output, errors = call_cli(capsys, *command, "--json")
    assert code == 0, errors
    report = json.loads(output)
    (bad,) = report["bad_frames"]
    assert bad["recording"] == str(one)
    assert "color/000004.png" in bad["frame"]
    assert bad["reason"]
    (reject,) = report["rejects"]
    assert reject["source"] == str(many)
    assert "4 of 12 frames are bad" in reject["reason"]
    assert "depth/000002.png" in reject["reason"]
    _, people, _ = call_cli(capsys, *command)
    assert f"left out of {one}: " in people
    assert "color/000004.png" in people
    assert f"rejected {many} at recording: " in people
    (episode,) = Dataset(tmp_path / "d").episodes()
    assert len(episode) == 11
    assert call_cli(capsys, "validate", tmp_path / "d")[0] == 0


def test_a_dry_run_says_what_it_recognizes_and_writes_nothing(
    recordings: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    before = files_below(recordings)
    code, output, _ = call_cli(capsys, "track-real", recordings, "--dry-run", "--estimate", "--json", *SMALL)
    assert code == 0
    plan = json.loads(output)
    assert [(r["task"], Path(r["recording"]).name, r["rows"], r["problem"]) for r in plan["recordings"]] == [
        ("slide", name, 12, None) for name in NAMES
    ]
    first = plan["recordings"][0]
    assert first["streams"][0] == {
        "stream": "color", "count": 12, "fps": 10.0, "first_s": 0.0, "last_s": pytest.approx(1.1), "gaps_s": [],
    }  # fmt: skip
    assert (first["reader"], first["color_size"], first["depth_unit_m"]) == ("plain", [160, 120], 0.001)
    assert first["sync_ms"]["depth"] == [0.0, 0.0]
    assert first["calibration"]["intrinsics"] == "recording.yaml"
    assert plan["frames"] == 60
    assert plan["cpu_ms_per_frame"] > 0
    assert plan["estimate"] == "measured on the first 12 frames of slide/1"
    code, people, _ = call_cli(capsys, "track-real", recordings, "--dry-run", "--estimate", *SMALL)
    for words in (
        "task 'slide', 12 rows, read as a plain recording",
        "12 at 10 per second, no gaps",
        "depth unit   0.001 m",
        "state of 2 numbers, action of 2",
        "estimated minutes",
        "measured on the first 12 frames",
    ):
        assert words in people
    assert list(tmp_path.iterdir()) == []
    assert files_below(recordings) == before


def test_a_dry_run_names_gaps_bad_frames_and_what_is_missing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = record(tmp_path / "slide/a", frames=20)
    truncate(folder / "depth/000007.png")
    times = (folder / "times.txt").read_text().split()
    (folder / "times.txt").write_text("\n".join(times[:12] + [str(float(t) + 0.5) for t in times[12:]]))
    described = (folder / "recording.yaml").read_text().splitlines(keepends=True)
    (folder / "recording.yaml").write_text("".join(line for line in described if "intrinsics" not in line))
    code, output, errors = call_cli(capsys, "track-real", tmp_path, "--dry-run", "--estimate", *SMALL)
    assert code == 3
    assert "1 of 1 recording cannot be used as they are" in errors
    assert "1 gap, the longest of 0.60 s at 1.10 s" in output
    assert "depth/000007.png" in output
    assert f"problem      {folder}" in output
    assert "intrinsics" in output
    assert "no recording can be labeled" in output


def test_a_recording_yaml_that_cannot_be_read_costs_its_own_recording_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for k, name in enumerate(("good", "bad")):
        record(tmp_path / "slide" / name, frames=4, seed=k)
    with (tmp_path / "slide" / "bad" / "recording.yaml").open("a") as file:
        file.write("success: false\n")
    code, out, _ = call_cli(capsys, "track-real", tmp_path / "slide", "--dry-run", "--json")
    bad, good = json.loads(out)["recordings"]
    assert code == 3
    assert "'success' stands twice, in lines" in bad["problem"]
    assert (good["rows"], good["problem"]) == (4, None)
    code, out, err = call_cli(capsys, "track-real", tmp_path / "slide", "--out", tmp_path / "data", *SMALL)
    assert len(Dataset(tmp_path / "data")) == 1
    assert "'success' stands twice" in out + err


def test_short_options_are_settings(recordings: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "c.yaml").write_text("depth_unit_m: 0.002\n")
    command = ["track-real", recordings / "1", "--out", tmp_path / "d", *SMALL, "--workers", "1", "--task", "x"]
    command += ["--chunk", "10", "--stride", "4", "--calibration", tmp_path / "c.yaml"]
    code, _, errors = call_cli(capsys, *command, "--set", "observer.crop.high=[2, 2, 3]")
    assert code == 0, errors
    data = Dataset(tmp_path / "d")
    assert data.manifest.settings["track"]["chunks"] == {"length": 10, "stride": 4}
    assert data.manifest.settings["recording"]["calibration"] == str(tmp_path / "c.yaml")
    assert [r.task for r in data.refs] == ["x"]
    assert data.episode(0).point_cloud[..., 2].max() == pytest.approx(2.0), "twice as deep"


MISTAKES = {
    "no path": ("--out x", 2, "PATH"),
    "no out": ("rec", 2, "--out data/pour; or look first with --dry-run"),
    "unknown tracker": (
        "rec --out x --tracker rigid-bodie",
        2,
        "no tracker is called 'rigid-bodie'; did you mean rigid-bodies",
    ),
    "unknown tracker, dry": ("rec --dry-run --tracker rigid-bodie", 2, "no tracker is called 'rigid-bodie'"),
    "unknown option": (
        "rec --out x --tracker lucas-kanade --set track.options.windw=3",
        2,
        "tracker 'lucas-kanade': no option is called 'windw'; did you mean window",
    ),
    "weights for a tracker without": (
        "rec --out x --tracker lucas-kanade --weights w.pth",
        2,
        "tracker 'lucas-kanade': no option is called 'weights'",
    ),
    "stride beyond chunk": ("rec --out x --chunk 8 --stride 8", 2, "stride (8) must be below length (8)"),
    "no such path": ("nowhere --out x", 2, "nowhere: there is no such file or folder"),
    "no recordings": ("empty --out x", 2, "empty: no recording at or below it; looked for"),
    "no calibration": ("rec --out x --calibration c.yaml", 3, "c.yaml: there is no such file"),
    "recipe of simulation": ("rec --out x --recipe metaworld", 2, "needs a 'recording' stage"),
    "task that is no name": ("rec --out x --task a/b", 2, "'a/b' cannot be the name of a task"),
    "file as out": ("rec --out file", 3, "choose another --out"),
    "same name twice": ("rec --out x --task t", 2, "two recordings of the task 't' are called 'a'"),
    "share that makes no sense": ("rec --out x --shard 3/3", 2, "--shard 3/3: must be i/n"),
}


@pytest.mark.parametrize("case", MISTAKES)
def test_a_mistake_gives_one_sentence_and_its_exit_code(
    case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments, expected, sentence = MISTAKES[case]
    for task in ("one", "two"):
        record(tmp_path / "rec" / task / "a", frames=3)
    (tmp_path / "file").touch()
    (tmp_path / "empty").mkdir()
    monkeypatch.chdir(tmp_path)
    code, output, errors = call_cli(capsys, "track-real", *arguments.split())
    assert sentence in errors
    assert code == expected
    assert output == ""
    assert sorted(p.name for p in tmp_path.iterdir()) == ["empty", "file", "rec"], "something was written"


def test_simulation_refuses_the_recipe_of_recordings(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, _, errors = call_cli(capsys, "extract-sim", "hammer", "--out", tmp_path / "x", "--recipe", "real")
    assert code == 2
    assert "needs a stage that simulates" in errors
    assert list(tmp_path.iterdir()) == []


def test_other_settings_are_refused(recordings: Path, dataset: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = files_below(dataset)
    code, _, errors = call_cli(capsys, "track-real", recordings, "--out", dataset, *SMALL, "--chunk", "20")
    assert code == 3
    assert "settings.track.chunks.length: the dataset has 33, this run has 20" in errors
    assert files_below(dataset) == before


@pytest.mark.slow
def test_ctrl_c_ends_cleanly(recordings: Path, tmp_path: Path) -> None:
    out = tmp_path / "d"
    command = [
        sys.executable,
        "-m",
        "flowlab",
        "track-real",
        str(recordings),
        "--out",
        str(out),
        "--workers",
        "1",
        *SMALL,
    ]
    # Jobs in the background of a shell inherit that Ctrl-C is ignored.
    unignored = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    run = subprocess.Popen(command, text=True, start_new_session=True, preexec_fn=unignored, **pipes)  # type: ignore[call-overload]
    wait_until(lambda: len(list(out.glob("receipts/*.json"))) >= 1)
    os.killpg(run.pid, signal.SIGINT)
    _, errors = run.communicate(timeout=60)
    assert run.returncode == 130
    assert "the same command does the rest" in errors
    assert "Traceback" not in errors
