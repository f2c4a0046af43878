"""``flowlab bench`` as a user runs it: every unit is done once, however often the experiment is ended and begun."""

import csv
import gzip
import hashlib
import json
import math
import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from synthetic import call_cli, files_below
from trained_runs import NETWORK, header_of, lines_of, make_run, options, policy_of, weights_of

from flowlab.benchmark.experiment import _discard_run
from flowlab.benchmark.paper import CURVE_TASKS, QUERY_PLACES
from flowlab.benchmark.recipe import load_experiment
from flowlab.benchmark.results import read_result, write_result
from flowlab.benchmark.units import plan_units
from flowlab.checksums import with_checksum
from flowlab.cli import main
from flowlab.limits import MAX_TEXT_BYTES
from flowlab.policies.run_folder import read_resume, save_resume
from flowlab.sim.tasks import TASKS
from flowlab.storage.dataset import Dataset

Capture = pytest.CaptureFixture[str]
TASK = "drawer-open"
SHORT = (
    "run.minutes=null", "run.steps=2", "run.checkpoints=2", "run.validations=1",
    "diffusion.inference_steps=2",
)  # fmt: skip
UNITS = [f"{TASK}-dp3", f"{TASK}-fdp", f"{TASK}-fdp-m4"]
REPORT = ["report.html", "report.json", "report.csv", "episodes.csv"]
TINY: dict[str, Any] = {
    "name": "tiny",
    "tasks": [TASK],
    "policies": ["dp3", "fdp"],
    "demonstrations": 2,
    "recipe": "metaworld",
    "query_points": 8,
    "profile": str(NETWORK),
    "minutes": 30,
    "set": [*SHORT],
    "seeds": [0],
    "episodes": 2,
    "curve_episodes": 1,
    "variants": [{"name": "m4", "tasks": [TASK, "push"], "set": ["motion.points=4"]}],
    "device": "cpu",
}
"""Three policies, each of two steps; `set` comes after what `minutes` says."""


def write_recipe(folder: Path, **changes: Any) -> Path:
    path = folder / "tiny.yaml"
    path.write_text(yaml.safe_dump({k: v for k, v in {**TINY, **changes}.items() if v is not None}))
    return path


def kill_after_the_first_unit(out: Path, recipe: Path) -> None:
    """Start an experiment, and kill all its processes once a unit is done."""
    command: list[str | Path] = [sys.executable, "-m", "flowlab", "bench", "--out", out, "--recipe", recipe]
    command += ["--workers", "1"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, start_new_session=True)
    try:
        end = time.monotonic() + 300
        while not any(out.glob("units/[!.]*.json")):
            assert process.poll() is None, process.communicate()
            assert time.monotonic() < end, "waited in vain"
            time.sleep(0.005)
    finally:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()


@pytest.fixture(scope="module")
def recipe(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_recipe(tmp_path_factory.mktemp("recipe"))


@pytest.fixture(scope="module")
def experiment(recipe: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An experiment that was killed after its first unit, and went on. Copy it before changing it."""
    out = tmp_path_factory.mktemp("experiment") / "tiny"
    kill_after_the_first_unit(out, recipe)
    done = {name: file for name, file in files_below(out / "units").items() if not name.startswith(".")}
    assert 1 <= len(done) < 3
    with redirect_stdout(StringIO()), redirect_stderr(StringIO()):
        main("bench", "--out", str(out), "--recipe", str(recipe), "--workers", "2")
    after = files_below(out / "units")
    assert {name: after[name] for name in done} == done, "what was done is left alone"
    return out


def unit(out: Path, name: str) -> dict[str, Any]:
    values: dict[str, Any] = read_result(out / f"units/{name}.json").model_dump(mode="json", exclude_defaults=True)
    return values


def without_times(result: dict[str, Any]) -> dict[str, Any]:
    """But for how long its episodes took, which were tried already."""
    evaluations = [{k: v for k, v in e.items() if k != "cpu_s"} for e in result["evaluations"]]
    return result | {"evaluations": evaluations}


def bench(capsys: Capture, out: Path, recipe: Path, *more: str) -> tuple[int, str, str]:
    return call_cli(capsys, "bench", "--out", out, "--recipe", recipe, *more)


def test_a_unit_that_failed_is_told_and_the_others_are_done(
    experiment: Path, recipe: Path, tmp_path: Path, capsys: Capture
) -> None:
    out = Path(shutil.copytree(experiment, tmp_path / "tiny"))
    for name in UNITS[:2]:
        for file in out.glob(f"units/{name}.*"):
            file.unlink()
    code, said, err = bench(capsys, out, recipe, "--engine", "failing_engine:FirstFails")
    sentence = f"flowlab: 1 unit failed, the first {UNITS[0]}: ValueError: low tide; the same command tries again"
    assert (code, said, err.splitlines()[-1]) == (4, "", sentence)
    assert sorted(p.stem for p in out.glob("units/*.json")) == UNITS[1:]


def test_every_policy_is_trained_and_evaluated_on_the_same_episodes(experiment: Path) -> None:
    assert sorted(p.name for p in experiment.iterdir() if p.is_dir() and p.name != "figures") == [
        "data", "runs", "units",
    ]  # fmt: skip
    assert sorted(p.name for p in (experiment / "units").iterdir()) == sorted(
        f"{name}{end}" for name in UNITS for end in (".csv.gz", ".json")
    )
    for name in UNITS:
        found, run = unit(experiment, name), experiment / "runs" / name
        policy, _, variant = name.removeprefix(f"{TASK}-").partition("-")
        assert (found["name"], found["tasks"]) == (name, [TASK])
        assert found["label"] == name.removeprefix(f"{TASK}-")
        about = found["training"]
        assert (about["policy"], about["steps"], about["demonstrations"]) == (policy, 2, 2)
        assert about["device"] == "cpu"
        assert about["settings"] == policy_of(run)["policy"]["settings"]
        motion = about["settings"].get("motion", {})
        assert motion.get("points") == ({"m4": 4, "": 8}[variant] if policy == "fdp" else None)
        assert (about["settings"]["run"]["steps"], about["settings"]["run"]["minutes"]) == (2, None)
        tensors = header_of(run / "checkpoints/step-00000002.safetensors")
        shapes = [tensor["shape"] for key, tensor in tensors.items() if key != "__metadata__"]
        assert about["weights"] == sum(math.prod(shape) for shape in shapes)
        assert about["cpu_s"] == pytest.approx(lines_of(run)[-1]["cpu_s"], abs=0.051)
        assert about["held_out"]["action_l1"] > 0
        tried = {
            e["step"]: [(o["seed"], o["episode"], o["scene_seed"]) for o in e["outcomes"]] for e in found["evaluations"]
        }
        assert tried == {1: [(0, 0, 1_000_000)], 2: [(0, 0, 1_000_000), (0, 1, 1_000_001)]}
        for e in found["evaluations"]:
            assert e["n_action_steps"] == 4
            log = run / f"evaluation/step-{e['step']:08d}-execute-4/episodes.jsonl"
            lines = [json.loads(line) for line in log.read_text().splitlines()]
            assert all(line.pop("sha256") for line in lines)
            assert sorted(lines, key=lambda x: x["episode"]) == e["outcomes"]


def test_all_policies_of_a_task_share_a_dataset(experiment: Path) -> None:
    assert [p.name for p in (experiment / "data").iterdir()] == [TASK]
    data = Dataset(experiment / "data" / TASK)
    assert [(ref.task, ref.seed) for ref in data.refs] == [(TASK, k) for k in range(3)]
    assert data.manifest.settings["queries"]["points"] == 8
    for name in UNITS:
        run = json.loads((experiment / f"runs/{name}/run.json").read_text())
        assert (run["train"], run["held_out"]) == ([0, 1], [2])


def test_a_unit_is_trained_as_by_hand(experiment: Path, tmp_path: Path) -> None:
    changes = options("data.demonstrations=2", "data.held_out=1", *SHORT, "motion.points=4")
    changes += ["--profile", str(NETWORK)]
    data = shutil.copytree(experiment / "data" / TASK, tmp_path / "d")
    run = make_run(data, "--policy", "fdp", "--out", tmp_path / "run", *changes, "--device", "cpu")
    mine, theirs = weights_of(run, 2), weights_of(experiment / f"runs/{UNITS[2]}", 2)
    assert mine.keys() == theirs.keys()
    for name in mine:
        np.testing.assert_allclose(mine[name], theirs[name], rtol=1e-3, atol=1e-5)


def test_a_report_tells_of_all_of_them(experiment: Path) -> None:
    assert {p.name for p in experiment.iterdir() if p.is_file()} == set(REPORT)
    page = (experiment / "report.html").read_text()
    assert all(label in page for label in ("dp3", "fdp", "fdp-m4"))
    with (experiment / "episodes.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    found = sorted((r["result"], int(r["episode"]), r["scene_seed"]) for r in rows if r["step"] == "2")
    assert found == [(name, k, str(1_000_000 + k)) for name in UNITS for k in range(2)]


def test_again_there_is_nothing_to_do_even_without_runs_and_data(
    experiment: Path, recipe: Path, tmp_path: Path, capsys: Capture
) -> None:
    out = Path(shutil.copytree(experiment, tmp_path / "tiny"))
    shutil.rmtree(out / "runs")
    shutil.rmtree(out / "data")
    before = files_below(out / "units")
    code, said, err = bench(capsys, out, recipe)
    assert code == 0, err
    assert err.splitlines()[-1] == "3 of 3 policies done"
    assert said.splitlines()[-1].startswith(str(out / "report.html"))
    assert files_below(out / "units") == before
    assert not (out / "runs").exists()
    assert not (out / "data").exists()
    for name in REPORT[1:]:
        assert (out / name).read_bytes() == (experiment / name).read_bytes()
    code, said, err = bench(capsys, out, recipe, "--json")
    assert (code, err) == (0, "")
    assert json.loads(said) == [unit(out, name) for name in UNITS]
    assert files_below(out / "units") == before


def test_a_unit_that_is_lost_is_done_again_alone(
    experiment: Path, recipe: Path, tmp_path: Path, capsys: Capture
) -> None:
    """From the run and the episodes that are there: it comes out as it was, and the rest is not touched."""
    out = Path(shutil.copytree(experiment, tmp_path / "tiny"))
    for end in (".json", ".csv.gz"):
        (out / f"units/{UNITS[1]}{end}").unlink()
    before = files_below(out)
    code, _, err = bench(capsys, out, recipe, "--workers", "1")
    assert code == 0, err
    assert without_times(unit(out, UNITS[1])) == without_times(unit(experiment, UNITS[1]))
    after = files_below(out)
    assert {name: after[name] for name in before if name.startswith("units")} == {
        name: was for name, was in before.items() if name.startswith("units")
    }
    for name, (content, _) in after.items():
        if name.startswith(("runs", "data")):
            assert content == before[name][0], name


def test_a_run_killed_between_its_last_weights_and_its_resume_file_is_brought_to_its_end(
    experiment: Path, recipe: Path, tmp_path: Path, capsys: Capture
) -> None:
    out = Path(shutil.copytree(experiment, tmp_path / "killed"))
    (out / "units" / f"{UNITS[0]}.json").unlink()
    run = out / "runs" / UNITS[0]
    _, groups = read_resume(run)
    save_resume(run, 1, groups)
    assert bench(capsys, out, recipe, "--workers", "1")[0] == 0
    assert read_resume(run)[0] == 2


def test_what_was_made_with_other_settings_is_refused_with_the_difference(
    experiment: Path, tmp_path: Path, capsys: Capture
) -> None:
    out = Path(shutil.copytree(experiment, tmp_path / "tiny"))
    changed = write_recipe(tmp_path, set=[*SHORT, "optimizer.learning_rate=0.5"])
    before = files_below(out)
    code, said, err = bench(capsys, out, changed)
    assert (code, said) == (3, "")
    first, second = err.splitlines()
    place = out / f"units/{UNITS[0]}.json"
    assert first == (
        f"flowlab: {place}: was made with other settings; choose another --out, or delete it to make it anew:"
    )
    assert second == "  settings.optimizer.learning_rate: it has 0.002, the recipe has 0.5"
    assert files_below(out) == before
    place.unlink()  # then the run is in the way
    code, said, err = bench(capsys, out, changed, "--policies", "dp3", "--variants", "none")
    assert (code, said) == (3, "")
    assert f"flowlab: {out / 'runs' / UNITS[0]}: was made with other settings" in err
    assert "the recipe has 0.5" in err
    assert not place.exists()


@pytest.mark.parametrize("asked", [("--episodes", "3"), ("--seeds", "5")])
def test_other_episodes_than_were_tried_are_not_passed_over(
    asked: tuple[str, str], experiment: Path, recipe: Path, tmp_path: Path, capsys: Capture
) -> None:
    """They are refused, or else tried."""
    out = Path(shutil.copytree(experiment, tmp_path / "tiny"))
    code, said, _ = bench(capsys, out, recipe, *asked, "--json")
    assert code in (0, 3)
    wanted = [(0, 0), (0, 1), (0, 2)] if asked[0] == "--episodes" else [(5, 0), (5, 1)]
    for result in json.loads(said) if code == 0 else []:
        assert [(o["seed"], o["episode"]) for o in result["evaluations"][-1]["outcomes"]] == wanted


def test_a_damaged_unit_is_said(experiment: Path, recipe: Path, tmp_path: Path, capsys: Capture) -> None:
    out = Path(shutil.copytree(experiment, tmp_path / "tiny"))
    place = out / f"units/{UNITS[2]}.json"
    values = {k: v for k, v in json.loads(place.read_text()).items() if k != "sha256"}
    values["training"]["settings"]["n_action_steps"] = {}
    no_steps = "training: settings: n_action_steps is {}, expected a number of steps"
    cases = (("{", "not valid JSON"), ('{"name": "x"}', "label: Field required"))
    for text, sentence in (*cases, (json.dumps(with_checksum(values)), no_steps)):
        place.write_text(text)
        code, said, err = bench(capsys, out, recipe)
        assert (code, said) == (3, "")
        assert err.startswith(f"flowlab: {place}: {sentence}")
        assert err.count("\n") == 1


def test_the_episodes_of_a_unit_are_columns_that_others_read(experiment: Path) -> None:
    """As ``episodes.csv`` has them; the same result is the same bytes."""
    for name in UNITS:
        place = experiment / f"units/{name}.csv.gz"
        with gzip.open(place, "rt", newline="") as file:
            rows = list(csv.DictReader(file))
        with (experiment / "episodes.csv").open(newline="") as file:
            wanted = [row for row in csv.DictReader(file) if row.pop("result") == name and row.pop("label")]
        assert rows == wanted
        result = read_result(experiment / f"units/{name}.json")
        before = place.read_bytes()
        write_result(experiment / f"units/{name}.json", result)
        assert place.read_bytes() == before
        assert [e.cpu_s is not None and e.cpu_s > 0 for e in result.evaluations] == [True, True]


def spoil(columns: Path, how: str) -> None:
    """Change a file of episodes; where it is not to be known by its checksum, that is set anew."""
    rows = gzip.decompress(columns.read_bytes()).decode()
    if how == "cut":
        columns.write_bytes(columns.read_bytes()[:-9])
        return
    changed = {
        "number": rows.replace(",1000000,", ",many,"),
        "column": rows.replace("n_action_steps", "executed"),
        "row": rows + "1,2\n",
        "evaluation": rows.replace("\n2,4,", "\n3,4,"),
        "zeros": rows + "0" * (MAX_TEXT_BYTES + 1),
    }
    packed = gzip.compress(changed[how].encode())
    columns.write_bytes(packed)
    place = columns.with_name(columns.name.replace(".csv.gz", ".json"))
    values = {k: v for k, v in json.loads(place.read_text()).items() if k != "sha256"}
    place.write_text(json.dumps(with_checksum(values | {"episodes_sha256": hashlib.sha256(packed).hexdigest()})))


SPOILED = {
    "cut": "damaged (its content does not match its checksum)",
    "number": "is no table of episodes",
    "column": "is no table of episodes (it has no column n_action_steps)",
    "row": "is no table of episodes",
    "evaluation": "has episodes at step 3, 4 steps executed, of which",
    "zeros": "is no table of episodes (it unpacks to more than",
    "gone": "there is no such file",
}


@pytest.mark.parametrize("how", SPOILED)
def test_damaged_episodes_are_said(how: str, experiment: Path, recipe: Path, tmp_path: Path, capsys: Capture) -> None:
    out = tmp_path / "tiny"
    shutil.copytree(experiment / "units", out / "units")
    columns = out / f"units/{UNITS[1]}.csv.gz"
    columns.unlink() if how == "gone" else spoil(columns, how)
    for command in (("bench", "--out", out, "--recipe", recipe), ("report", out)):
        code, said, err = call_cli(capsys, *command)
        assert (code, said) == (3, "")
        assert err.startswith(f"flowlab: {columns}: {SPOILED[how]}")
        assert err.count("\n") == 1


def test_what_another_kind_of_machine_made_is_the_same_experiment(
    experiment: Path, recipe: Path, tmp_path: Path, capsys: Capture
) -> None:
    """Results count by their settings and episodes: not by processor, precision, library or time."""
    out = tmp_path / "tiny"
    for name in UNITS:
        result = read_result(experiment / f"units/{name}.json")
        other = {
            "device": "cuda",
            "precision": "fp32",
            "processor": "another",
            "cpu_s": 1e4,
            "versions": {"torch": "9"},
        }
        training = result.training.model_copy(update=other)
        write_result(out / f"units/{name}.json", result.model_copy(update={"training": training}))
    before = files_below(out / "units")
    code, _, err = bench(capsys, out, recipe, "--device", "cpu")
    assert (code, err.splitlines()[-1]) == (0, "3 of 3 policies done")
    assert files_below(out / "units") == before
    assert not (out / "data").exists()


def test_runs_that_nobody_keeps_are_gone_once_their_units_are_done(
    experiment: Path, tmp_path: Path, capsys: Capture
) -> None:
    """Those of units that were done before, too."""
    out = Path(shutil.copytree(experiment, tmp_path / "tiny"))
    (out / f"units/{UNITS[1]}.json").unlink()
    sparing = write_recipe(tmp_path, keep_runs=False)
    code, _, err = bench(capsys, out, sparing, "--workers", "1")
    assert code == 0, err
    assert without_times(unit(out, UNITS[1])) == without_times(unit(experiment, UNITS[1]))
    assert list((out / "runs").iterdir()) == []


def test_a_run_that_somebody_linked_to_stays_and_that_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "kept").mkdir()
    (tmp_path / "out/runs").mkdir(parents=True)
    (tmp_path / "out/runs/push-fdp").symlink_to(tmp_path / "kept")
    _discard_run(load_experiment(str(write_recipe(tmp_path, keep_runs=False))), tmp_path / "out", "push-fdp")
    assert (tmp_path / "kept").is_dir()
    assert "push-fdp: is a link, so the run it leads to stays" in caplog.text


def test_parts_of_an_experiment_are_whole_tasks_and_together_all_of_it(
    experiment: Path, tmp_path: Path, capsys: Capture
) -> None:
    out = tmp_path / "tiny"
    shutil.copytree(experiment / "units", out / "units")
    more = write_recipe(tmp_path, tasks=["push", TASK, "reach"], minutes=None, steps=2, set=SHORT[2:])
    asked = ("bench", "--out", tmp_path / "none", "--recipe", more, "--dry-run", "--shard")
    parts = [call_cli(capsys, *asked, f"{k}/2")[1].splitlines() for k in range(2)]
    assert [line for part in parts for line in part[:-1]] == [
        "push-dp3", "push-fdp", "reach-dp3", "reach-fdp", "push-fdp-m4", *UNITS,
    ]  # fmt: skip
    assert parts[1][-1] == "3 policies, 2 steps of training and 2 episodes each"
    code, said, err = bench(capsys, out, more, "--dry-run")
    assert (code, said.splitlines()[-2:]) == (
        0, ["3 of 8 policies done, 5 left", "5 policies, 2 steps of training and 2 episodes each"],
    )  # fmt: skip
    code, said, err = bench(capsys, out, more, "--shard", "1/2", "--json")
    assert (code, err) == (0, "")
    assert [result["name"] for result in json.loads(said)] == UNITS
    code, said, err = bench(capsys, tmp_path / "none", more, "--shard", "3/4")
    assert (code, said) == (0, "")
    assert err.splitlines() == [
        "0 of 8 policies done, 8 left",
        "nothing of this experiment is done yet, and nothing of it belongs to part 3/4",
    ]
    code, said, err = bench(capsys, out, more, "--shard", "2/2")
    assert (code, err) == (2, "flowlab: --shard 2/2: must be i/n with i from 0 to n-1, as in --shard 0/4\n")


def test_a_dry_run_says_what_would_be_done(recipe: Path, tmp_path: Path, capsys: Capture) -> None:
    code, said, err = bench(capsys, tmp_path / "out", recipe, "--dry-run", "--workers", "2")
    assert (code, err) == (0, "")
    assert said.splitlines() == [
        *UNITS, "3 policies, 30 minutes of training each: 1.5 hours of one core, 0.8 on 2",
    ]  # fmt: skip
    more = ("--task", "push", "--task", TASK, "--policies", "mba, fdp", "--variants", "m4", "--budget", "1.5h")
    code, said, err = bench(capsys, tmp_path / "out", recipe, *more, "--dry-run", "--workers", "1")
    assert (code, err) == (0, "")
    *units, last = said.splitlines()
    own = {f"{task}-{policy}" for task in ("push", TASK) for policy in ("mba", "fdp")}
    assert set(units[:4]) == own
    assert set(units[4:]) == {f"{TASK}-fdp-m4", "push-fdp-m4"}
    assert last == "6 policies, 90 minutes of training each: 9.0 hours of one core, 9.0 on 1"
    assert list(tmp_path.iterdir()) == []


def test_the_recipe_that_comes_with_flowlab_is_the_papers() -> None:
    """Hard tasks and those of the ablation for three policies; variants of 3D FDP on the tasks they name."""
    recipe = load_experiment("paper")
    units = plan_units(recipe)
    assert len(units) == len({u.name for u in units})
    tasks = {u.task for u in units}
    hard = {"assembly", "hand-insert", "pick-out-of-hole", "pick-place", "push", "push-back"}
    assert tasks == hard | {"basketball", "box-close", "hammer", "handle-press", "handle-pull"}
    labels = {task: {u.label for u in units if u.task == task} for task in tasks}
    assert all({"fdp", "dp3", "mba"} <= found for found in labels.values())
    assert {task for task in tasks if "fdp-m50" in labels[task]} == hard
    for u in units:
        assert u.settings.run.minutes == recipe.minutes
        flow = u.settings.needs.flow
        assert flow is None or flow.points <= recipe.query_points
        assert u.dataset == f"data/{u.task}" + {"fdp-object": "-object", "fdp-stratified": "-stratified"}.get(
            u.label, ""
        )
        points = {"fdp-m50": 50, "fdp-m200": 200}.get(u.label, 100)
        assert (None if flow is None else flow.points) == (points if u.label.startswith("fdp") else None)
    assert [u.name for u in plan_units(load_experiment("paper", tasks=("push",), policies=("dp3",), variants=()))] == [
        "push-dp3"
    ]


def test_the_papers_tables_come_whole(capsys: Capture, tmp_path: Path) -> None:
    """All tasks, the hardest first, equal steps for all policies; what varies in the ablations has the same steps."""
    units = plan_units(load_experiment("table1"))
    groups = list(dict.fromkeys(TASKS[u.task].difficulty for u in units))
    assert groups == ["hard", "very-hard", "medium", "easy"]
    assert [u.label for u in units] == ["fdp", "dp3", "mba"] * 50
    assert {u.task for u in units} == set(TASKS)
    ablations = plan_units(load_experiment("ablations"))
    assert len({u.settings.run.steps for u in [*units, *ablations]}) == 1
    assert {u.settings.run.seed for u in units} == {0}
    tasks = {label: [u.task for u in ablations if u.label == label] for label in {u.label for u in ablations}}
    hard = ["assembly", "hand-insert", "pick-out-of-hole", "pick-place", "push", "push-back"]
    assert tasks["fdp-m50"] == tasks["fdp-m200"] == hard
    assert {*hard, *QUERY_PLACES.columns, *CURVE_TASKS} == set(tasks["fdp"])
    assert set(tasks["fdp-object"]) == set(tasks["fdp-stratified"]) == set(QUERY_PLACES.columns)
    for label in ("dp3", "dp3-seed1", "dp3-seed2", "fdp-seed1", "fdp-seed2"):
        assert set(tasks[label]) == set(CURVE_TASKS)
    code, said, _ = call_cli(
        capsys, "bench", "--recipe", "ablations", "--variants", "seed1", "--out", tmp_path, "--dry-run"
    )
    assert code == 0
    assert [name for name in said.splitlines() if "seed" in name] == [
        f"{task}-{policy}-seed1" for policy in ("fdp", "dp3") for task in CURVE_TASKS
    ]
    short = ("bench", "--recipe", "table1", "--budget", "1m", "--task", "push", "--out", tmp_path, "--dry-run")
    assert call_cli(capsys, *short)[1].splitlines()[-1].startswith("3 policies, 1 minutes of training each: ")


WRONG: dict[str, tuple[list[str], str]] = {
    "recipe": (["--recipe", "papr"], "no experiment is called 'papr'; did you mean paper?"),
    "recipe file": (["--recipe", "no.yaml"], "no.yaml: there is no such file, expected the experiment"),
    "policy": (["--policies", "fdp,fpd"], "no policy is called 'fpd'; did you mean fdp?"),
    "task": (["--task", "drawer-opn"], "no task is called 'drawer-opn'; did you mean drawer-open"),
    "group": (["--group", "hardest"], "hardest"),
    "variant": (["--variants", "m5"], "no variant of this recipe is called 'm5'; there are: m4"),
    "budget": (["--budget", "x"], "--budget x: must be a time, as in 10m, 90s or 1.5h"),
    "budget without unit": (["--budget", "10"], "--budget 10: must be a time"),
    "no time": (["--budget", "0m"], "--budget 0m: must be a time"),
    "time without end": (["--budget", "infh"], "--budget infh: must be a time"),
    "time that is none": (["--budget", "nanm"], "--budget nanm: must be a time"),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_is_wrong_is_said_in_one_sentence(
    case: str, recipe: Path, tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    wrong, sentence = WRONG[case]
    monkeypatch.chdir(tmp_path)
    code, said, err = bench(capsys, tmp_path / "out", recipe, *wrong)
    assert (code, said) == (2, "")
    assert err.startswith("flowlab: ")
    assert sentence in err
    assert err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


BROKEN: dict[str, tuple[dict[str, Any], str]] = {
    "key": ({"episods": 3}, "episods: no setting is called 'episods'; did you mean episodes"),
    "key that is missing": ({"seeds": None}, "seeds: Field required"),
    "neither minutes nor steps": ({"minutes": None}, "give either minutes or steps of training"),
    "minutes and steps": ({"steps": 2}, "give either minutes or steps of training"),
    "value": ({"minutes": "soon"}, "minutes: "),
    "no time": ({"minutes": 0}, "minutes: "),
    "setting": ({"set": ["motoin.points=3"]}, "no setting of dp3 is called 'motoin'; there are: action, "),
    "profile": ({"profile": "fsat"}, "no profile is called 'fsat'; did you mean fast?"),
    "policy of a variant": (
        {"variants": [{"name": "a", "tasks": [TASK], "set": [], "policy": "fpd"}]}, "no policy is called 'fpd'",
    ),
    "recipe of the datasets": ({"recipe": "metawrld"}, "no recipe is called 'metawrld'; did you mean metaworld"),
    "seed without scenes": ({"seeds": [4000]}, "seed 4000: evaluation seeds are from 0 to 3999"),
    "variants of one name": (
        {"variants": [{"name": "a", "tasks": [TASK], "set": [f"motion.points={k}"]} for k in (2, 3)]}, "fdp-a",
    ),
}  # fmt: skip
BROKEN["too many query points"] = ({"query_points": 1}, "query points, and the datasets get 1; raise query_points")
BROKEN["no policies"] = ({"policies": []}, "policies: ")


@pytest.mark.parametrize("case", BROKEN)
def test_a_recipe_that_is_wrong_is_refused_before_anything_is_done(case: str, tmp_path: Path, capsys: Capture) -> None:
    changes, sentence = BROKEN[case]
    path = write_recipe(tmp_path, **changes)
    more = ("--dry-run",) if case != "recipe of the datasets" else ()
    code, said, err = bench(capsys, tmp_path / "out", path, *more)
    assert (code, said) == (2, "")
    assert err.startswith("flowlab: ")
    assert sentence in err
    assert err.count("\n") == 1
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize(("text", "sentence"), [("[", "not valid YAML"), ("- push", "is a mapping with the keys name")])
def test_a_file_that_is_no_recipe(text: str, sentence: str, tmp_path: Path, capsys: Capture) -> None:
    path = tmp_path / "tiny.yaml"
    path.write_text(text)
    code, said, err = bench(capsys, tmp_path / "out", path)
    assert (code, said) == (2, "")
    assert err.startswith(f"flowlab: experiment {path}: {sentence}")
