"""The command line: quick help, one document or one sentence, and exit codes that mean what they say."""

import json
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import metaworld
import numpy as np
import pytest
import zarr
from conftest import Cli
from synthetic import call_cli, make_dataset, make_episode, make_manifest
from zarr.storage import ZipStore

import flowlab as package
from flowlab.storage.dataset import Dataset, begin

RUN = Path(__file__).parents[1] / "fixtures/old/runs/dp3"
COMMANDS = ["tasks", "extract-sim", "track-real", "grade", "info", "validate", "viz", "export"]
HEAVY = ["numpy", "zarr", "mujoco", "rerun", "numba", "scipy", "matplotlib", "metaworld", "jaxtyping", "cv2", "torch"]


@pytest.mark.parametrize("arguments", [["--help"], ["--version"], ["no-such-command"], ["validate", "--help"]])
def test_help_imports_nothing_heavy(arguments: list[str]) -> None:
    code = (
        "import sys; from flowlab.cli import main\n"
        f"try: main(*{arguments!r})\n"
        f"finally: print('heavy:', *(m for m in {HEAVY!r} if m in sys.modules))"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert result.stdout.splitlines()[-1] == "heavy:"


def test_help_names_every_command_and_the_exit_codes(flowlab: Cli) -> None:
    result = flowlab("--help")
    assert result.returncode == 0
    assert [name for name in COMMANDS if f"\n  {name} " not in result.stdout] == []
    words = " ".join(result.stdout.split())
    assert "0 done; 1 failed; 2 wrong usage; 3 data invalid; 4 some units failed; 130 interrupted" in words
    assert flowlab("--version").stdout.split()[-1] == package.__version__


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_itself(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    code, output, errors = call_cli(capsys, command, "--help")
    assert code == 0
    assert output.startswith(f"Usage: flowlab {command}")
    assert errors == ""


MISTAKES = {
    "unknown command": (["extract"], 2, "no command is called 'extract'; did you mean extract-sim"),
    "unknown task": (["extract-sim", "hamer", "--out", "x"], 2, "no task is called 'hamer'; did you mean hammer"),
    "no task": (["extract-sim", "--out", "x"], 2, "name the tasks to extract"),
    "unknown group": (["extract-sim", "--group", "esy", "--out", "x"], 2, "did you mean easy"),
    "unknown option": (["extract-sim", "hammer", "--episode", "3"], 2, "--episodes"),
    "no out": (["extract-sim", "hammer"], 2, "--out"),
    "no episodes": (["extract-sim", "hammer", "--episodes", "0", "--out", "x"], 2, "--episodes"),
    "no workers": (["extract-sim", "hammer", "--workers", "0", "--out", "x"], 2, "--workers"),
    "wrong share": (["extract-sim", "hammer", "--shard", "5/3", "--out", "x"], 2, "--shard 5/3: must be i/n"),
    "unknown recipe": (["extract-sim", "hammer", "--recipe", "x", "--out", "x"], 2, "there are: metaworld, "),
    "wrong setting": (["extract-sim", "hammer", "--set", "observer.points=0", "--out", "x"], 2, "greater than 0"),
    "setting not YAML": (["extract-sim", "hammer", "--set", "observer.points=[", "--out", "x"], 2, "observer.points=["),
    "color, no OpenGL": (["extract-sim", "push", "--set", "expert.scene.rgb=true", "--out", "x"], 2, "--renderer gl"),
    "file as out": (["extract-sim", "hammer", "--out", "file"], 3, "choose another --out"),
    "out below a file": (["extract-sim", "hammer", "--out", "file/below"], 3, "choose another --out"),
    "info of nothing": (["info", "none"], 3, "none: there is no such folder"),
    "validate nothing": (["validate", "none"], 3, "none: 1 finding"),
    "viz of nothing": (["viz", "none"], 3, "none: there is no such folder"),
    "export of nothing": (["export", "none", "--to", "dp3", "--out", "x"], 3, "none: there is no such folder"),
    "export to nothing": (["export", "none", "--to", "dp4", "--out", "x"], 2, "did you mean dp3"),
    "info of a file": (["info", "file"], 3, "file: not a flowlab dataset"),
    "info of a folder": (["info", "."], 3, ".: not a flowlab dataset (it has no flowlab.json)"),
}  # fmt: skip


@pytest.mark.parametrize("case", MISTAKES)
def test_a_mistake_gives_one_sentence_and_its_exit_code(
    case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments, expected, sentence = MISTAKES[case]
    (tmp_path / "file").touch()
    monkeypatch.chdir(tmp_path)
    code, output, errors = call_cli(capsys, *arguments)
    assert sentence in errors
    assert code == expected
    if case != "validate nothing":
        assert output == ""
    assert [p.name for p in tmp_path.iterdir()] == ["file"], "something was written"


def test_a_mistake_shows_no_traceback(tmp_path: Path, flowlab: Cli) -> None:
    for arguments in (["extract-sim", "hamer", "--out", tmp_path / "d"], ["info", tmp_path / "d"]):
        result = flowlab(*arguments)
        assert result.returncode in (2, 3)
        assert result.stdout == ""
        assert result.stderr.startswith("flowlab: ")
        assert result.stderr.count("\n") == 1


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_that_must_not_be_written_gives_one_sentence(tmp_path: Path, flowlab: Cli) -> None:
    tmp_path.chmod(0o555)
    result = flowlab("extract-sim", "hammer", "--out", tmp_path / "d")
    tmp_path.chmod(0o755)
    assert result.returncode == 3
    assert "cannot make a dataset here (Permission denied); choose another --out" in result.stderr


def test_a_missing_library_is_a_plain_failure(tmp_path: Path, flowlab: Cli) -> None:
    environment = {**os.environ, "MUJOCO_GL": "no-such-backend"}
    result = flowlab("extract-sim", "hammer", "--out", tmp_path / "d", env=environment)
    assert result.returncode == 1
    assert "MUJOCO_GL=no-such-backend" in result.stderr
    assert "Traceback" not in result.stderr


def test_tasks_are_those_of_metaworld(flowlab: Cli) -> None:
    tasks = json.loads(flowlab("tasks", "--json").stdout)
    assert {f"{t['task']}-v3" for t in tasks} == set(metaworld.ALL_V3_ENVIRONMENTS)
    assert len(tasks) == 50
    count = {d: sum(t["difficulty"] == d for t in tasks) for d in ("easy", "medium", "hard", "very-hard")}
    assert count == {"easy": 28, "medium": 11, "hard": 6, "very-hard": 5}  # the split of DP3's tables
    hard = json.loads(flowlab("tasks", "--group", "hard", "--json").stdout)
    assert {t["task"] for t in hard} == {
        "assembly",
        "hand-insert",
        "pick-out-of-hole",
        "pick-place",
        "push",
        "push-back",
    }
    table = flowlab("tasks").stdout
    assert all(t["task"] in table for t in tasks)


def test_info_says_what_the_shards_hold(small_dataset: Path, flowlab: Cli) -> None:
    result = flowlab("info", small_dataset, "--json")
    assert result.returncode == 0
    assert result.stderr == ""
    info = json.loads(result.stdout)
    assert set(info) == {
        "dataset", "recipe", "flowlab", "fingerprint", "episodes", "frames", "megabytes", "missing", "world_frame",
        "tasks", "listed", "arrays", "stages", "stats", "settings", "provenance",
    }  # fmt: skip
    ends = {
        p.name: np.asarray(zarr.open_group(ZipStore(p, mode="r"), mode="r")["meta/episode_ends"])
        for p in (small_dataset / "shards").iterdir()
    }
    assert info["episodes"] == sum(map(len, ends.values())) == 6
    assert info["frames"] == sum(e[-1] for e in ends.values())
    size = sum(f.stat().st_size for f in small_dataset.rglob("*") if f.is_file())
    assert info["megabytes"] == pytest.approx(size / 1e6, abs=0.006)
    rejected = [json.loads(line) for line in (small_dataset / "rejects.jsonl").read_text().splitlines()]
    for task in info["tasks"]:
        mine = [e for name, e in ends.items() if name.startswith(task["task"])]
        assert task["episodes"] == sum(map(len, mine)) == task["requested"] == 3
        assert task["frames"] == sum(e[-1] for e in mine)
        assert task["rejected"] == sum(r["task"] == task["task"] for r in rejected)
    calls = {s["stage"]: (s["calls"], s["rejects"]) for s in info["stages"]}
    tried = 6 + len(rejected)
    assert list(calls) == ["expert", "observer", "queries", "rigid-flow", "accept", "write"]
    assert calls == {**dict.fromkeys(calls, (tried, 0)), "accept": (tried, len(rejected)), "write": (6, 0)}
    first = next(p for p in sorted((small_dataset / "shards").iterdir()))
    for array in info["arrays"]:
        meta = json.loads(zipfile.ZipFile(first).read(f"{array['array']}/zarr.json"))
        assert array["shape"] == " x ".join(map(str, meta["shape"]))
        assert array["dimensions"] == ", ".join(meta["dimension_names"])
        assert array["type"] == meta["data_type"]
        assert array["unit"] == meta["attributes"]["unit"]
    manifest = json.loads((small_dataset / "flowlab.json").read_text())
    assert info["settings"] == manifest["settings"]
    assert info["stats"] == json.loads((small_dataset / "stats.json").read_text())
    assert info["missing"] == {}
    assert info["fingerprint"] == Dataset(small_dataset).fingerprint


def test_info_for_people_says_the_same(small_dataset: Path, flowlab: Cli) -> None:
    result = flowlab("info", small_dataset)
    assert result.returncode == 0
    dataset = Dataset(small_dataset)
    for word in (
        dataset.fingerprint,
        "drawer-open",
        "push-back",
        "data/tracks",
        f"frames       {sum(ref.frames for ref in dataset.refs)}",
        "missing      none",
    ):
        assert word in result.stdout


def test_a_dataset_without_episodes_can_be_looked_at(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """As it is when its making has just begun."""
    begin(tmp_path, make_manifest({"roll": 3}))
    code, output, errors = call_cli(capsys, "info", tmp_path, "--json")
    assert (code, errors) == (0, "")
    assert json.loads(output)["episodes"] == 0
    assert json.loads(output)["missing"] == {"roll": 3}
    assert call_cli(capsys, "info", tmp_path)[0] == 0
    code, _, errors = call_cli(capsys, "viz", tmp_path)
    assert code == 3
    assert "no episode 0; there are 0" in errors


FAILS_AT_SEED_1 = """
from flowlab.pipeline.stage import Stage
from flowlab.records import Episode

class Fail(Stage):
    def process(self, record: Episode) -> Episode:
        if record.seed == 1:
            raise RuntimeError("the tide is too high")
        return record
"""


def test_failed_units_end_in_exit_code_4_and_nothing_else_is_lost(tmp_path: Path, flowlab: Cli) -> None:
    (tmp_path / "failing.py").write_text(FAILS_AT_SEED_1)
    stages = ["expert", "observer", "queries", "rigid-flow", "failing:Fail", "accept", "write"]
    (tmp_path / "r.yaml").write_text(json.dumps({"name": "r", "stages": [{"stage": s} for s in stages]}))
    command = ("extract-sim", "drawer-open", "--episodes", 3, "--recipe", "r.yaml", "--out", "d", "--workers", 1)
    result = flowlab(*command, cwd=tmp_path)
    assert result.returncode == 4
    assert (
        "1 unit failed, the first (drawer-open-000000-000001) with: RuntimeError: the tide is too high" in result.stderr
    )
    assert "Traceback" not in result.stderr
    assert "RuntimeError: the tide is too high" in (tmp_path / "d/failures.log").read_text()
    assert [r.seed for r in Dataset(tmp_path / "d").refs] == [2]


def test_extraction_reports_in_one_json_document(small_dataset: Path, tmp_path: Path, flowlab: Cli) -> None:
    """The dataset is complete already, so this is quick."""
    data = shutil.copytree(small_dataset, tmp_path / "d")
    command = ("extract-sim", "drawer-open", "push-back", "--episodes", 3, "--out", data, "--workers", 1)
    result = flowlab(*command, "--json")
    assert result.returncode == 0
    assert result.stderr == ""
    report = json.loads(result.stdout)
    assert report["episodes"] == 6
    assert report["missing"] == {}
    assert report["fingerprint"] == Dataset(small_dataset).fingerprint
    rejects = [json.loads(line) for line in (small_dataset / "rejects.jsonl").read_text().splitlines()]
    assert report["rejects"] == rejects
    people = flowlab(*command)
    assert f"6 episodes, {report['frames']} frames" in people.stdout
    assert "6 of 6 episodes" in people.stderr
    assert "of 6 episodes" not in people.stdout


def test_a_dry_run_writes_nothing(tmp_path: Path, flowlab: Cli) -> None:
    command = ("extract-sim", "drawer-open", "--episodes", 4, "--out", tmp_path / "d", "--workers", 2, "--dry-run")
    result = flowlab(*command, "--json")
    assert result.returncode == 0, result.stderr
    plan = json.loads(result.stdout)
    assert (plan["tasks"], plan["episodes_wanted"], plan["episodes_to_do"]) == (1, 4, 4)
    assert list(tmp_path.iterdir()) == []


SLOW_TO_LOAD = {"torch", "scipy", "pandas", "open3d", "numba", "mujoco", "metaworld", "trimesh", "sklearn", "pyarrow"}
"""What costs a third of a second and more to import."""
AT_ONCE = {
    "info": ["info", "data"],
    "validate": ["validate", "data"],
    "viz of a still": ["viz", "data", "--png", "a.png"],
    "train without data": ["train", "nothere", "--policy", "fdp", "--out", "run"],
    "train of an unknown policy": ["train", "data", "--policy", "nope", "--out", "run"],
    "train with a wrong setting": ["train", "data", "--policy", "fdp", "--out", "run", "--set", "run.steps=-3"],
    "train for two lengths": [
        "train",
        "data",
        "--policy",
        "fdp",
        "--out",
        "run",
        "--minutes",
        "3",
        "--set",
        "run.steps=9",
    ],
    "train with an unknown logger": ["train", "data", "--policy", "fdp", "--out", "run", "--log", "nope"],
    "info of a run": ["info", "run"],
    "eval of what is no run": ["eval", "data"],
    "eval of an unknown task": ["eval", "run", "--tasks", "nope"],
    "eval by an unknown engine": ["eval", "run", "--engine", "nope"],
    "report of what was not evaluated": ["report", "run", "--out", "out"],
    "bench of an unknown recipe": ["bench", "--recipe", "nope", "--out", "out"],
    "serve of what is no run": ["serve", "data"],
    "hub push of what is nothing": ["hub", "push", "out", "user/name"],
}
REFUSED = ("train", "eval", "report", "bench", "serve", "hub")


@pytest.mark.parametrize("what", AT_ONCE)
def test_what_should_be_quick_imports_nothing_slow(what: str, tmp_path: Path) -> None:
    make_dataset(tmp_path / "data", [[make_episode(1)]])
    if "run" in AT_ONCE[what][:2]:
        shutil.copytree(RUN, tmp_path / "run")
    slow = SLOW_TO_LOAD - ({"scipy"} if what == "validate" else set())  # which looks for nearest points
    code = (
        "import sys; from flowlab.cli import main\n"
        f"try: main(*{AT_ONCE[what]!r})\n"
        f"finally: print('slow:', *sorted({slow!r} & set(sys.modules)))"
    )
    run = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert run.stdout.splitlines()[-1] == "slow:", run.stderr
    assert (run.returncode == 0) == (not what.startswith(REFUSED))
