"""``import flowlab``: quick, and whole; its functions are what the commands call."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from synthetic import call_cli, files_below

import flowlab
from flowlab.errors import UsageError

OLD = Path(__file__).parent / "fixtures" / "old"


def test_every_public_name_is_there() -> None:
    assert set(flowlab.__all__) == {*flowlab._LAZY, "__version__", "data"}
    for name in flowlab.__all__:
        assert getattr(flowlab, name) is not None
    assert set(flowlab.__all__) <= set(dir(flowlab))
    with pytest.raises(AttributeError, match="has no attribute 'Episod'"):
        flowlab.Episod  # noqa: B018


def test_importing_flowlab_imports_nothing_heavy() -> None:
    code = (
        "import flowlab, sys; print([m for m in ('numpy', 'torch', 'zarr', 'pydantic', 'click') if m in sys.modules])"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"


def test_extract_is_what_the_command_does(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    done = []
    small = ["observer.points=64", "queries.points=8"]
    made = flowlab.extract(
        ["drawer-open"], tmp_path / "a", episodes=2, settings=small, workers=1, on_progress=done.append
    )
    sets = [word for change in small for word in ("--set", change)]
    command = ["extract-sim", "drawer-open", "--episodes", "2", "--workers", "1", "--out", tmp_path / "b", *sets]
    code, _, errors = call_cli(capsys, *command)
    assert code == 0, errors
    assert len(made) == 2
    assert made.tasks == ("drawer-open",)
    assert (done[-1].accepted, done[-1].wanted) == (2, 2)
    a, b = ({name: content for name, (content, _) in files_below(tmp_path / x / "shards").items()} for x in ("a", "b"))
    assert a == b
    assert made.fingerprint == flowlab.open_dataset(tmp_path / "b").fingerprint
    again = flowlab.extract("drawer-open", tmp_path / "a", episodes=2, settings=small, workers=1, shard="0/1")
    assert again.fingerprint == made.fingerprint
    with pytest.raises(UsageError, match="no task is called 'drawer-opn'"):
        flowlab.extract("drawer-opn", tmp_path / "c")
    with pytest.raises(UsageError, match="no engine is called 'slurm'; there are: local"):
        flowlab.extract("drawer-open", tmp_path / "c", engine="slurm")
    assert not (tmp_path / "c").exists()


def test_label_is_what_the_command_does(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    small = ["observer.points=64", "queries.points=8"]
    take = OLD / "recording" / "slide" / "take-1"
    made = flowlab.label(take, tmp_path / "a", task="push", tracker="lucas-kanade", settings=small, workers=1)
    sets = [word for change in small for word in ("--set", change)]
    command = ["track-real", take, "--task", "push", "--tracker", "lucas-kanade", "--workers", "1", *sets]
    code, _, errors = call_cli(capsys, *command, "--out", tmp_path / "b")
    assert code == 0, errors
    assert made.provenance.tracker == "lucas-kanade"
    theirs = flowlab.open_dataset(tmp_path / "b")
    assert (made.fingerprint, made.manifest.requested) == (theirs.fingerprint, {"push": 1})
    assert [len(made), len(made.rejects)] == [len(theirs), len(theirs.rejects)]


ENGINE = '''
from flowlab.engines.base import Engine, UnitResult


class Here(Engine):
    """Does units in this process, one after the other."""

    def __enter__(self):
        self.units = []
        open("workers", "w").write(str(self.workers))
        return self

    def submit(self, unit):
        self.units.append(unit)

    def next_result(self):
        unit = self.units.pop(0)
        return UnitResult(unit, self.work(unit))
'''


def test_an_engine_of_ones_own_does_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "engine_of_mine.py").write_text(ENGINE)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.chdir(tmp_path)
    command = ["extract-sim", "drawer-open", "--episodes", "1", "--set", "observer.points=64", "--json"]
    code, output, errors = call_cli(capsys, *command, "--out", "a", "--engine", "engine_of_mine:Here", "--workers", "3")
    assert code == 0, errors
    assert Path("workers").read_text() == "3"
    code, other, errors = call_cli(capsys, *command, "--out", "b", "--workers", "1")
    assert code == 0, errors
    assert json.loads(output)["fingerprint"] == json.loads(other)["fingerprint"]


def test_a_recipe_of_ones_own_may_be_an_object(tmp_path: Path) -> None:
    from flowlab.pipeline.recipe import load_recipe

    recipe = load_recipe("metaworld", ["observer.points=64"])
    made = flowlab.extract(
        "drawer-open", tmp_path / "a", episodes=1, recipe=recipe, settings=["queries.points=5"], workers=1
    )
    assert made[0].point_cloud.shape[1:] == (64, 3)
    assert made[0].tracks.xyz_world.shape[1:] == (5, 3)
    assert np.isfinite(made[0].tracks.xyz_world).all()
