"""``flowlab bench --expert``: MetaWorld's own expert on the layouts that policies get."""

import gzip
import hashlib
import json
from pathlib import Path
from typing import Any

import pytest
import yaml
from policy_results import outcomes, result
from report_pages import read_page
from synthetic import call_cli, files_below

from flowlab.benchmark.expert_results import ExpertResult, read_experts, write_expert
from flowlab.benchmark.results import write_result
from flowlab.checksums import with_checksum
from flowlab.evaluation.trials import SCENES_PER_SEED
from flowlab.sim.recorder import ExpertSettings, TaskSimulator
from flowlab.sim.scene_settings import SceneSettings

Capture = pytest.CaptureFixture[str]
TASK = "push-back"
"""In which the expert fails now and then."""
RECIPE = {
    "name": "tiny", "tasks": [TASK], "policies": ["dp3"], "demonstrations": 2, "recipe": "metaworld",
    "query_points": 8, "profile": "fast", "steps": 2, "seeds": [0, 1], "episodes": 4, "curve_episodes": 0,
}  # fmt: skip


@pytest.fixture(scope="module")
def recipe(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recipe") / "tiny.yaml"
    path.write_text(yaml.safe_dump(RECIPE))
    return path


@pytest.fixture(scope="module")
def recorded() -> dict[int, int | None]:
    """After how many steps the task was solved when the expert was recorded as for a dataset, by scene seed."""
    simulator, full = TaskSimulator(TASK, SceneSettings()), ExpertSettings(stop="full")
    seeds = [(s + 1) * SCENES_PER_SEED + e for s in (0, 1) for e in range(4)]
    success = {seed: simulator.record_expert(seed, full).success.tolist() for seed in seeds}
    return {seed: found.index(True) + 1 if any(found) else None for seed, found in success.items()}


def rows(out: Path) -> list[dict[str, str]]:
    head, *lines = gzip.decompress((out / f"expert/{TASK}.csv.gz").read_bytes()).decode().splitlines()
    return [dict(zip(head.split(","), line.split(","), strict=True)) for line in lines]


def test_the_expert_does_as_in_demonstrations_on_the_layouts_of_policies(
    tmp_path: Path, recipe: Path, recorded: dict[int, int | None], capsys: Capture
) -> None:
    """Episodes are added to those that are there, and none is tried twice."""
    ask: list[Any] = ["bench", "--recipe", recipe, "--out", tmp_path, "--expert", "--workers", "1"]
    code, out, _ = call_cli(capsys, *ask, "--dry-run")
    assert (code, out.splitlines()) == (0, [f"{TASK}: 8 episodes", "1 task, 8 episodes of their experts left"])
    assert call_cli(capsys, *ask, "--episodes", "1")[0] == 0
    first = rows(tmp_path)
    assert call_cli(capsys, *ask)[0] == 0
    found = {int(r["scene_seed"]): int(r["steps"]) if r["success"] == "1" else None for r in rows(tmp_path)}
    assert found == recorded
    assert len(set(recorded.values()) - {None}) > 1
    assert [r for r in rows(tmp_path) if r["episode"] == "0"] == first
    before = files_below(tmp_path)
    code, out, _ = call_cli(capsys, *ask, "--json")
    assert (code, [len(r["outcomes"]) for r in json.loads(out)]) == (0, [8])
    assert files_below(tmp_path) == before


def test_a_task_that_failed_is_told_and_tried_again(tmp_path: Path, capsys: Capture) -> None:
    recipe, out = tmp_path / "two.yaml", tmp_path / "out"
    recipe.write_text(yaml.safe_dump(RECIPE | {"tasks": ["reach", "push"], "seeds": [0], "episodes": 1}))
    ask: list[Any] = ["bench", "--recipe", recipe, "--out", out, "--expert"]
    code, said, err = call_cli(capsys, *ask, "--engine", "failing_engine:FirstFails")
    sentence = "flowlab: 1 task failed, the first reach: ValueError: low tide; the same command tries again"
    assert (code, said, err.splitlines()[-1]) == (4, "", sentence)
    assert [p.name for p in out.glob("expert/*.json")] == ["push.json"]
    before = (out / "expert/push.json").stat().st_mtime_ns
    code, said, _ = call_cli(capsys, *ask, "--json", "--workers", "1")
    assert (code, [r["task"] for r in json.loads(said)]) == (0, ["reach", "push"])
    assert (out / "expert/push.json").stat().st_mtime_ns == before


def test_options_about_policies_are_refused(tmp_path: Path, recipe: Path, capsys: Capture) -> None:
    code, _, err = call_cli(
        capsys, "bench", "--recipe", recipe, "--out", tmp_path, "--expert", "--budget", "9m", "--policies", "fdp"
    )
    assert (code, "--expert trains nothing, so leave out --policies, --budget" in err) == (2, True)


def expert(solved: str, **changes: Any) -> ExpertResult:
    values = {"task": "push", "cpu_s": 1.0, "versions": {"metaworld": "3.1.1"}, "outcomes": outcomes("push", solved)}
    return ExpertResult.model_validate({**values, **changes})


@pytest.fixture
def experiment(tmp_path: Path) -> Path:
    write_result(tmp_path / "units/push-dp3.json", result("dp3", outcomes("push", "ssffs")))
    write_expert(tmp_path / "expert/push.json", expert("sfsf"))
    return tmp_path


def test_a_report_has_the_expert_beside_the_policies(experiment: Path, capsys: Capture) -> None:
    code, out, _ = call_cli(capsys, "report", experiment, "--json")
    assert code == 0
    (found,) = json.loads(out)["experts"]
    assert (found["success"]["successes"], found["success"]["n"]) == (2, 4)
    (beside,) = found["policies"]
    counts = {key: beside["paired"][key] for key in ("both", "first_only", "second_only", "neither")}
    assert counts == {"both": 1, "first_only": 1, "second_only": 1, "neither": 1}
    assert (beside["steps"], beside["expert_steps"]) == (10.0, 10.0)
    (row,) = (experiment / "report.csv").read_text().splitlines()[1:]
    assert row.endswith(",2,4")


def test_the_page_shows_the_expert(tmp_path: Path) -> None:
    page = read_page(tmp_path, result("dp3", outcomes("push", "ssffs")), experts=[expert("sfsf")])
    assert page.rows("task", "dp3", "expert") == [["push", "60.0 23–88", "50.0 15–85 n 4"]]
    assert page.rows("task", "policy", "layouts")[0][:7] == ["push", "dp3", "4", "2", "2", "1", "1"]


def test_experts_of_several_folders_are_put_together(experiment: Path, tmp_path: Path) -> None:
    more = tmp_path / "more"
    write_expert(more / "expert/push.json", expert("sfsfs"))
    (found,) = read_experts([experiment, more])
    assert [o.success for o in found.outcomes] == [True, False, True, False, True]


@pytest.mark.parametrize("name", ["push.json", "push.csv.gz"])
def test_damage_is_refused(experiment: Path, capsys: Capture, name: str) -> None:
    path = experiment / "expert" / name
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    code, _, err = call_cli(capsys, "report", experiment)
    assert code != 0
    assert "Traceback" not in err
    assert str(experiment / "expert") in err
    assert call_cli(capsys, "validate", experiment)[0] != 0


def test_an_expert_under_another_name_and_one_without_episodes_are_refused(experiment: Path, capsys: Capture) -> None:
    folder = experiment / "expert"
    for suffix in ("json", "csv.gz"):
        (folder / f"reach.{suffix}").write_bytes((folder / f"push.{suffix}").read_bytes())
    code, _, err = call_cli(capsys, "report", experiment)
    assert (code != 0, "reach.json: is of push, expected the task that it is named after" in err) == (True, True)
    write_expert(folder / "reach.json", expert("", task="reach"))
    code, _, err = call_cli(capsys, "report", experiment)
    assert (code != 0, "reach.json: has no episodes" in err) == (True, True)


@pytest.mark.parametrize(
    ("column", "value", "words"),
    [
        ("success", "2", "its success is 2, expected 0 or 1"),
        ("steps", "-3", "steps: Input should be greater than or equal to 0"),
        ("seed", "-2", "seed: Input should be greater than or equal to -1"),
    ],
)
def test_episodes_that_cannot_be_are_refused(
    experiment: Path, capsys: Capture, column: str, value: str, words: str
) -> None:
    """Whatever checksum a stranger gives them."""
    table, about = experiment / "expert/push.csv.gz", experiment / "expert/push.json"
    head, first, *others = gzip.decompress(table.read_bytes()).decode().splitlines()
    cells = dict(zip(head.split(","), first.split(","), strict=True)) | {column: value}
    packed = gzip.compress("\n".join([head, ",".join(cells.values()), *others, ""]).encode())
    table.write_bytes(packed)
    values = {k: v for k, v in json.loads(about.read_text()).items() if k != "sha256"}
    values["episodes_sha256"] = hashlib.sha256(packed).hexdigest()
    about.write_text(json.dumps(with_checksum(values)))
    code, _, err = call_cli(capsys, "report", experiment)
    assert (code != 0, words in err, "Traceback" in err) == (True, True, False), err


def test_another_simulator_is_not_mixed_in(experiment: Path, tmp_path: Path, capsys: Capture) -> None:
    write_result(tmp_path / "more/units/push-fdp.json", result("fdp", outcomes("push", "s")))
    write_expert(tmp_path / "more/expert/push.json", expert("s", versions={"metaworld": "3.0.0"}))
    code, _, err = call_cli(capsys, "report", experiment, tmp_path / "more", "--out", tmp_path / "out")
    assert code != 0
    assert "metaworld 3.0.0" in err
