"""A policy trained on what a stage of one's own made is evaluated as one trained on the built-in stage's."""

import json
import shutil
from pathlib import Path

import pytest
from synthetic import call_cli
from trained_runs import NETWORK, make_run, options, policy_of, saved_by

Capture = pytest.CaptureFixture[str]
LINES = "evaluation/step-00000002-execute-4/episodes.jsonl"
OWN_EXPERT = '''
from flowlab.pipeline.stages.simulation import ExpertStage


class Mine(ExpertStage):
    """As the built-in one, under another name."""
'''
REST = ("observer", "queries", "rigid-flow", "accept", "write")


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Runs of two steps, on one and the same demonstrations of scenes 1,000,001 to 1,000,003 made by either stage."""
    place = tmp_path_factory.mktemp("recipes")
    (place / "my_own_expert.py").write_text(OWN_EXPERT)
    return _make(place, "mine", "my_own_expert:Mine"), _make(place, "theirs", "expert")


def _make(place: Path, name: str, expert: str) -> Path:
    from contextlib import redirect_stderr, redirect_stdout
    from io import StringIO

    from flowlab.cli import main

    stages = [{"stage": stage} for stage in (expert, *REST)]
    recipe = {"name": name, "episodes": 3, "first_seed": 1_000_001, "stages": stages}
    (place / f"{name}.yaml").write_text(json.dumps(recipe))
    data = place / name / "data"
    with redirect_stdout(StringIO()), redirect_stderr(StringIO()):
        main("extract-sim", "drawer-open", "--recipe", f"{place}/{name}.yaml", "--workers", "1", "--out", str(data))
    short = options("run.minutes=null", "run.steps=2", "run.checkpoints=1", "run.validations=0")
    command = (data, "--policy", "fdp", "--profile", NETWORK, *short, "--device", "cpu", "--out", place / name / "fdp")
    return make_run(*command)


def test_it_knows_scene_and_channels_and_its_episodes_go_the_same(
    runs: tuple[Path, Path], tmp_path: Path, capsys: Capture
) -> None:
    mine, theirs = (Path(shutil.copytree(run, tmp_path / run.parent.name / "fdp")) for run in runs)
    for key in ("scene", "scene_seeds", "fingerprint"):
        assert policy_of(mine)[key] == policy_of(theirs)[key]
    assert policy_of(mine)["policy"] == policy_of(theirs)["policy"]
    assert saved_by(mine) == saved_by(theirs)
    for run in (mine, theirs):
        code, _, err = call_cli(capsys, "eval", run, "--seeds", "1", "--episodes", "2", "--workers", "1", "--json")
        assert code == 0, err
    assert (mine / LINES).read_bytes() == (theirs / LINES).read_bytes()
    assert (mine / LINES).read_bytes().count(b"\n") == 2


def test_scenes_that_it_was_trained_on_are_refused(runs: tuple[Path, Path], capsys: Capture) -> None:
    mine, _ = runs
    assert policy_of(mine)["scene_seeds"] == {"drawer-open": [1_000_001, 1_000_002, 1_000_003]}
    code, said, err = call_cli(capsys, "eval", mine, "--seeds", "0", "--episodes", "2")
    assert (code, said) == (2, "")
    assert f"{mine}: its dataset holds the scene 1000001 of drawer-open, which evaluation seed 0 would try" in err


def test_its_held_out_demonstrations_are_known(runs: tuple[Path, Path], capsys: Capture) -> None:
    """Without a simulator; of another dataset, those are left out whose scene was trained on."""
    mine, theirs = runs
    for data in ((), ("--data", theirs.parent / "data")):
        code, said, err = call_cli(capsys, "eval", mine, "--offline", "--json", *data)
        assert code == 0, err
        assert [d["seed"] for d in json.loads(said)[str(mine)]["demonstrations"]] == [1_000_003]
