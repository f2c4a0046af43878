"""Results that flowlab wrote before it called things by today's names (commit 79a7dbb) are read as they were."""

import csv
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from synthetic import call_cli, files_below

from flowlab.benchmark.experiment import known_results
from flowlab.benchmark.recipe import load_experiment
from flowlab.benchmark.results import read_result, write_result
from flowlab.benchmark.units import plan_units
from flowlab.errors import DataError

Capture = pytest.CaptureFixture[str]
OLD = Path(__file__).parents[1] / "fixtures/old"
PAPER = Path(__file__).parents[2] / "docs/results/paper"
NAMES = {"executed": "n_action_steps", "layout": "scene_seed"}
"""Columns of ``episodes.csv``, old and new; the committed report has the old."""


def values(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return [{NAMES.get(k, k): v for k, v in row.items()} for row in csv.DictReader(file)]


def leaves(found: Any, where: tuple[Any, ...] = ()) -> Iterator[tuple[tuple[Any, ...], Any]]:
    """Every number and word, by where it is."""
    pairs = found.items() if isinstance(found, dict) else enumerate(found) if isinstance(found, list) else ()
    if not isinstance(found, dict | list):
        yield where, found
    for key, value in pairs:
        yield from leaves(value, (*where, key))


def without_settings(report: dict[str, Any]) -> dict[tuple[Any, ...], Any]:
    """All of a report but the settings of training, which have other names today."""
    for about in report["summary"]["training"]:
        about["training"].pop("settings")
    return dict(leaves(report))


def in_old_words(outcome: dict[str, Any]) -> dict[str, Any]:
    return {{"scene_seed": "layout"}.get(k, k): v for k, v in outcome.items()}


def test_the_committed_results_give_the_numbers_that_the_old_code_gave(tmp_path: Path, capsys: Capture) -> None:
    """Its report is committed beside them: CSV, JSON and figures."""
    before = files_below(PAPER)
    code, _, err = call_cli(capsys, "report", PAPER, "--out", tmp_path)
    assert code == 0, err
    assert (tmp_path / "report.csv").read_bytes() == (PAPER / "report.csv").read_bytes()
    assert values(tmp_path / "episodes.csv") == values(PAPER / "episodes.csv")
    found, wanted = (json.loads((folder / "report.json").read_text()) for folder in (tmp_path, PAPER))
    assert {f["training"]["settings"]["n_action_steps"] for f in found["summary"]["training"]} == {8}
    assert without_settings(found) == without_settings(wanted)
    assert files_below(PAPER) == before


def test_units_made_before_are_those_of_todays_recipe() -> None:
    """A long experiment goes on over versions: settings that came later have their defaults in what is there."""
    recipe, made = load_experiment("table1", tasks=("assembly",)), PAPER.parent / "table1"
    units = plan_units(recipe)
    assert (
        set(known_results(recipe, units, made))
        == {u.name for u in units}
        == {f"assembly-{policy}" for policy in ("fdp", "dp3", "mba")}
    )
    longer = load_experiment(
        "table1",
        tasks=("assembly",),
        set=("run.validations=1", "n_action_steps=8", "motion.summary=mixed"),
        policies=("fdp",),
    )
    assert known_results(longer, plan_units(longer), made)
    other = load_experiment(
        "table1",
        tasks=("assembly",),
        set=("run.validations=1", "n_action_steps=8", "encoder.scale=axes"),
        policies=("dp3",),
    )
    with pytest.raises(DataError, match=r"encoder\.scale"):
        known_results(other, plan_units(other), made)


def test_an_old_unit_is_read_and_written_by_todays_names(tmp_path: Path) -> None:
    old = json.loads((OLD / "unit.json").read_text())
    result = read_result(OLD / "unit.json")
    assert [e.n_action_steps for e in result.evaluations] == [e["executed"] for e in old["evaluations"]]
    for evaluation, theirs in zip(result.evaluations, old["evaluations"], strict=True):
        assert [o.scene_seed for o in evaluation.outcomes] == [o["layout"] for o in theirs["outcomes"]]
        assert [o.scene_seed for o in evaluation.outcomes] == [o.trial.scene_seed for o in evaluation.outcomes]
    settings, theirs = result.training.settings, old["training"]["settings"]
    assert (settings["n_obs_steps"], settings["n_action_steps"]) == (theirs["history"], theirs["executed"])
    assert settings["motion"]["flow_representation"] == theirs["motion"]["layout"]
    assert settings["optimizer"] == theirs["optimiser"]
    write_result(tmp_path / "new.json", result)
    assert read_result(tmp_path / "new.json") == result
    names = {part for where, _ in leaves(json.loads((tmp_path / "new.json").read_text())) for part in where}
    assert not {"executed", "layout", "history", "optimiser"} & names


def test_an_old_experiment_is_done_and_not_done_again(tmp_path: Path, capsys: Capture) -> None:
    """Its settings, in the old words, are those that the recipe asks for today."""
    units = tmp_path / "out/units"
    units.mkdir(parents=True)
    for name in ("push-back-dp3", "push-back-fdp", "push-back-mba", "push-back-fdp-m50"):
        shutil.copy(PAPER / f"units/{name}.json", units)
    before = files_below(units)
    asked = ("--task", "push-back", "--variants", "m50", "--budget", "4m", "--json")
    code, out, err = call_cli(capsys, "bench", "--out", tmp_path / "out", *asked)
    assert code == 0, err
    assert [r["name"] for r in json.loads(out)] == [f"push-back-{x}" for x in ("fdp", "dp3", "mba", "fdp-m50")]
    assert files_below(units) == before
    assert not (tmp_path / "out/runs").exists()


def test_an_old_runs_evaluation_goes_on_where_it_was(tmp_path: Path, capsys: Capture) -> None:
    """Two episodes were tried then; they are not tried again, and a third adds to them."""
    run = Path(shutil.copytree(OLD / "runs/fdp", tmp_path / "fdp"))
    lines = run / "evaluation/step-00000004-execute-4/episodes.jsonl"
    before = lines.read_bytes()
    assert before.count(b'"layout"') == 2
    asked = ("--seeds", "0", "--workers", "1", "--json")
    code, out, err = call_cli(capsys, "eval", run, "--episodes", 2, *asked)
    assert code == 0, err
    assert lines.read_bytes() == before
    (evaluation,) = json.loads(out)[0]["evaluations"]
    theirs = [json.loads(line) for line in before.splitlines()]
    assert [in_old_words(o) for o in evaluation["outcomes"]] == theirs
    code, _, err = call_cli(capsys, "eval", run, "--episodes", 3, *asked)
    assert code == 0, err
    assert lines.read_bytes().startswith(before)
    added = json.loads(lines.read_bytes().removeprefix(before))
    assert (added["episode"], added["scene_seed"]) == (2, 1_000_002)


def test_an_old_policy_does_again_what_it_did(tmp_path: Path, capsys: Capture) -> None:
    """With its evaluation gone, the same episodes go as they went then."""
    run = Path(shutil.copytree(OLD / "runs/fdp", tmp_path / "fdp"))
    lines = run / "evaluation/step-00000004-execute-4/episodes.jsonl"
    then = [json.loads(line) for line in lines.read_bytes().splitlines()]
    shutil.rmtree(run / "evaluation")
    code, _, err = call_cli(capsys, "eval", run, "--episodes", 2, "--seeds", "0", "--workers", "1", "--json")
    assert code == 0, err
    now = sorted((json.loads(line) for line in lines.read_bytes().splitlines()), key=lambda x: x["episode"])
    for mine, theirs in zip(map(in_old_words, now), then, strict=True):
        mine.pop("sha256")
        assert mine.pop("flow") == pytest.approx(theirs.pop("flow"), rel=0.02), "another CPU rounds otherwise"
        assert mine == theirs
