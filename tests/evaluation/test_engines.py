"""Who does the work makes no difference to what comes out, and an engine of one's own is named like any plugin."""

import json
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
from synthetic import call_cli
from trained_runs import NETWORK, make_run, options

import flowlab
from flowlab.engines.base import Engine, UnitResult

Capture = pytest.CaptureFixture[str]
LINES = "evaluation/step-00000002-execute-4/episodes.jsonl"
STARTED: list[dict[str, Any]] = []


class InThisProcess(Engine[Any, Any]):
    """An engine as somebody may write it: one unit after the other, here."""

    def __init__(self, work: Callable[[Any], Any], *, workers: int, imports: Sequence[str] = ()) -> None:
        super().__init__(work, workers=workers, imports=imports)
        STARTED.append({"workers": workers, "imports": list(imports)})
        self._units: list[Any] = []

    def submit(self, unit: Any) -> None:
        self._units.append(unit)

    def next_result(self) -> UnitResult[Any, Any]:
        unit = self._units.pop(0)
        return UnitResult(unit, self.work(unit))


@pytest.fixture(scope="module")
def run(small_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of two steps. Copy it before evaluating it."""
    out = tmp_path_factory.mktemp("runs") / "dp3"
    data = shutil.copytree(small_dataset, tmp_path_factory.mktemp("data") / "small")
    short = options("run.minutes=null", "run.steps=2", "run.checkpoints=1", "run.validations=0")
    return make_run(data, "--policy", "dp3", "--out", out, "--profile", NETWORK, *short, "--device", "cpu")


def test_an_engine_of_ones_own_gives_the_same_episodes(run: Path, tmp_path: Path, capsys: Capture) -> None:
    mine, theirs = (Path(shutil.copytree(run, tmp_path / name / "dp3")) for name in ("mine", "theirs"))
    asked = ("--task", "drawer-open", "--seeds", "0", "--episodes", "2", "--workers", "1", "--json")
    STARTED.clear()
    code, said, err = call_cli(capsys, "eval", mine, *asked, "--engine", "test_engines:InThisProcess")
    assert code == 0, err
    assert STARTED == [{"workers": 1, "imports": ["flowlab.evaluation.episode_batches"]}]
    code, wanted, err = call_cli(capsys, "eval", theirs, *asked)
    assert code == 0, err
    assert json.loads(said) == json.loads(wanted)
    assert (mine / LINES).read_bytes() == (theirs / LINES).read_bytes()


def test_the_function_is_what_the_command_calls(run: Path, tmp_path: Path, capsys: Capture) -> None:
    """The same results, told how far it is; nothing is tried twice."""
    mine, theirs = (Path(shutil.copytree(run, tmp_path / name / "dp3")) for name in ("mine", "theirs"))
    told: list[tuple[int, int]] = []
    asked: dict[str, Any] = {"tasks": ["drawer-open"], "seeds": [0], "episodes": 2}
    (result,) = flowlab.evaluate(mine, **asked, workers=1, on_progress=lambda done, of: told.append((done, of)))
    assert isinstance(result, flowlab.PolicyResult)
    assert (told[0], told[-1]) == ((0, 2), (2, 2))
    assert result.success_rate == sum(o.success for o in result.final) / 2
    code, said, err = call_cli(
        capsys, "eval", theirs, "--task", "drawer-open", "--seeds", "0", "--episodes", 2, "--workers", 1, "--json"
    )
    assert code == 0, err
    assert json.loads(said) == [result.model_dump(mode="json", exclude_defaults=True)]
    before = (mine / LINES).stat().st_mtime_ns
    assert flowlab.evaluate([str(mine)], **asked) == [result]
    assert (mine / LINES).stat().st_mtime_ns == before


def test_episodes_whose_worker_failed_are_told_and_tried_again(run: Path, tmp_path: Path, capsys: Capture) -> None:
    mine = Path(shutil.copytree(run, tmp_path / "dp3"))
    asked = ("eval", mine, "--task", "drawer-open", "--seeds", "0,1", "--episodes", "3", "--workers", "1")
    code, said, err = call_cli(capsys, *asked, "--engine", "failing_engine:FirstFails")
    assert (code, said) == (4, "")
    left, _, sentence = err.splitlines()[-1].removeprefix("flowlab: ").partition(" of ")
    assert sentence == (
        "6 episodes could not be tried; the first failure: ValueError: low tide; the same command tries them again"
    )
    done = (mine / LINES).read_text()
    assert done.count("\n") == 6 - int(left) > 0, "the other units were done"
    assert call_cli(capsys, *asked)[0] == 0
    assert (mine / LINES).read_text().startswith(done), "what was done is left alone"
    assert (mine / LINES).read_text().count("\n") == 6


def test_a_device_that_is_not_there_is_said(run: Path, tmp_path: Path, capsys: Capture) -> None:
    mine = Path(shutil.copytree(run, tmp_path / "dp3"))
    asked = ("eval", mine, "--task", "drawer-open", "--episodes", "1", "--engine", "test_engines:InThisProcess")
    code, said, err = call_cli(capsys, *asked, "--device", "cuda:99")
    assert (code, said) == (2, "")
    assert "device is 'cuda:99', which PyTorch cannot use here; use cpu, cuda or cuda:1" in err


@pytest.mark.parametrize("command", ["eval", "bench"])
def test_an_engine_that_is_not_there_is_said(command: str, run: Path, tmp_path: Path, capsys: Capture) -> None:
    asked = ("eval", run) if command == "eval" else ("bench", "--out", tmp_path / "out")
    code, said, err = call_cli(capsys, *asked, "--engine", "lokal")
    assert (code, said) == (2, "")
    assert err == "flowlab: no engine is called 'lokal'; did you mean local?\n"
