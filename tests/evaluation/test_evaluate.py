"""``flowlab eval`` as a user runs it: however it is run, and however it ends, every episode goes one way and once."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

import pytest
from safetensors.numpy import load_file, save_file
from synthetic import call_cli, files_below
from trained_runs import NETWORK, leftovers, make_run, options, policy_of

import flowlab
from flowlab.cli import main
from flowlab.errors import DataError
from flowlab.evaluation import execution
from flowlab.evaluation.checkpoints import CheckpointRef, find_checkpoint
from flowlab.evaluation.results import CheckpointEvaluation, EpisodeResult
from flowlab.evaluation.rollout import SimulatorPool, roll_out
from flowlab.evaluation.trials import Trial
from flowlab.policies.checkpoint import load_policy
from flowlab.sim.scene_settings import CameraSettings, SceneSettings

Capture = pytest.CaptureFixture[str]
TASK = "drawer-open"
SHORT = "--profile", str(NETWORK), *options(
    "n_action_steps=8", "run.minutes=null", "run.steps=2", "run.checkpoints=2", "run.validations=0",
    "diffusion.inference_steps=2",
)  # fmt: skip
PLACE = "evaluation/step-00000002-execute-8/episodes.jsonl"
SIX = ("--task", TASK, "--seeds", 0, "--episodes", 6)
"""More than are tried at a time, so that something is left when the first have ended."""


@pytest.fixture(scope="module")
def data(small_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return Path(shutil.copytree(small_dataset, tmp_path_factory.mktemp("data") / "small"))


def trained(data: Path, folder: Path, policy: str, *more: str) -> Path:
    return make_run(data, "--policy", policy, "--out", folder / policy, *SHORT, "--device", "cpu", *more)


@pytest.fixture(scope="module")
def fdp(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of two steps on two tasks, never evaluated. Copy it before evaluating it."""
    return trained(data, tmp_path_factory.mktemp("runs"), "fdp")


@pytest.fixture(scope="module")
def dp3(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return trained(data, tmp_path_factory.mktemp("runs"), "dp3")


@pytest.fixture(scope="module")
def evaluated(fdp: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six episodes by one worker, undisturbed. Copy it before changing it."""
    run = copy(fdp, tmp_path_factory.mktemp("evaluated"))
    with redirect_stdout(StringIO()), redirect_stderr(StringIO()):
        main("eval", str(run), *map(str, SIX), "--workers", "1")
    return run


def copy(run: Path, folder: Path, name: str | None = None) -> Path:
    return Path(shutil.copytree(run, folder / (name or run.name)))


def evaluate(capsys: Capture, *arguments: str | Path | int) -> str:
    """``flowlab eval``, here, which must succeed; its output."""
    code, out, err = call_cli(capsys, "eval", *map(str, arguments))
    assert code == 0, err
    return out


def lines_of(run: Path, place: str = PLACE) -> list[dict[str, Any]]:
    """Without their digests."""
    lines = [json.loads(line) for line in (run / place).read_text().splitlines()]
    assert all(line.pop("sha256") for line in lines)
    return lines


def in_order(run: Path) -> list[str]:
    """Lines of the file, which come in the order in which episodes end."""
    return sorted((run / PLACE).read_text().splitlines())


def episodes(lines: Sequence[dict[str, Any]]) -> list[tuple[str, int, int, int]]:
    return sorted((x["task"], x["seed"], x["episode"], x["scene_seed"]) for x in lines)


def test_every_episode_is_there_once_with_its_scene(evaluated: Path) -> None:
    lines = lines_of(evaluated)
    assert episodes(lines) == [(TASK, 0, k, 1_000_000 + k) for k in range(6)]
    for line in lines:
        assert 1 <= line["steps"] <= 200
        assert line["success"] or line["steps"] == 200
        assert line["success"] or not line["success_dp3"]
        assert line.get("note", "") == ""
    assert [str(p.relative_to(evaluated)) for p in (evaluated / "evaluation").rglob("*") if p.is_file()] == [PLACE]


def test_an_episode_is_what_the_policy_does_in_its_scene(evaluated: Path) -> None:
    """The checkpoint, tried in the scene its dataset was made in, gives the same line."""
    policy = load_policy(evaluated).policy
    (episode,) = roll_out(policy, SimulatorPool(TASK, SceneSettings()), [Trial(TASK, 0, 1)])
    (line,) = [x for x in lines_of(evaluated) if x["episode"] == 1]
    assert json.loads(episode.result.model_dump_json(exclude_defaults=True)) == line


def test_any_number_of_workers_gives_the_same(fdp: Path, evaluated: Path, tmp_path: Path, capsys: Capture) -> None:
    run = copy(fdp, tmp_path)
    out = evaluate(capsys, run, *SIX, "--workers", 3, "--json")
    assert in_order(run) == in_order(evaluated)
    (result,) = json.loads(out)
    assert (result["name"], result["label"]) == ("fdp", "fdp")
    (evaluation,) = result["evaluations"]
    assert (evaluation["step"], evaluation["n_action_steps"]) == (2, 8)
    by_episode = sorted(lines_of(evaluated), key=lambda x: x["episode"])
    assert evaluation["outcomes"] == by_episode


def test_more_episodes_add_to_those_that_are_there(evaluated: Path, tmp_path: Path, capsys: Capture) -> None:
    run = copy(evaluated, tmp_path)
    kept = (run / PLACE).read_bytes().splitlines(keepends=True)[:4]
    (run / PLACE).write_bytes(b"".join(kept))
    evaluate(capsys, run, *SIX)
    assert (run / PLACE).read_bytes().startswith(b"".join(kept))
    assert in_order(run) == in_order(evaluated)
    before = files_below(run)
    result = json.loads(evaluate(capsys, run, "--task", TASK, "--seeds", "0", "--episodes", "3", "--json"))[0]
    assert files_below(run) == before, "nothing was left to do"
    assert [x["episode"] for x in result["evaluations"][0]["outcomes"]] == [0, 1, 2]


def kill_after_the_first_line(run: Path, *arguments: str | Path | int) -> None:
    """Start an evaluation, and kill all its processes once something is written."""
    command = [sys.executable, "-m", "flowlab", "eval", str(run), *map(str, arguments)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, start_new_session=True)
    try:
        end = time.monotonic() + 240
        while not ((run / PLACE).exists() and b"\n" in (run / PLACE).read_bytes()):
            assert process.poll() is None, process.communicate()
            assert time.monotonic() < end, "waited in vain"
            time.sleep(0.005)
    finally:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def test_a_killed_evaluation_goes_on_where_it_was(fdp: Path, evaluated: Path, tmp_path: Path, capsys: Capture) -> None:
    run = copy(fdp, tmp_path)
    kill_after_the_first_line(run, *SIX, "--workers", 1)
    kept = (run / PLACE).read_bytes()
    assert 1 <= kept.count(b"\n") < 6
    (run / PLACE).write_bytes(kept + b'{"task": "drawer-op')  # had it died while writing
    evaluate(capsys, run, *SIX)
    assert (run / PLACE).read_bytes().startswith(kept), "nothing is tried twice"
    assert in_order(run) == in_order(evaluated)
    assert leftovers(run) == []


def test_policies_meet_the_same_scenes(evaluated: Path, dp3: Path, tmp_path: Path, capsys: Capture) -> None:
    runs = [copy(evaluated, tmp_path), copy(dp3, tmp_path)]
    before = in_order(runs[0])
    place = tmp_path / "report"
    out = evaluate(
        capsys, *runs, "--task", TASK, "--seeds", "0", "--episodes", "2", "--json", "--out", place
    )  # fmt: skip
    assert in_order(runs[0]) == before
    results = json.loads(out)
    assert [r["name"] for r in results] == ["fdp", "dp3"]
    tried = [episodes(r["evaluations"][0]["outcomes"]) for r in results]
    assert tried[0] == tried[1] == episodes(lines_of(runs[1])) == [(TASK, 0, k, 1_000_000 + k) for k in range(2)]
    assert all("flow" not in x for x in lines_of(runs[1])), "it predicts none"
    files = {"report.html", "report.json", "report.csv", "episodes.csv"}
    assert {p.name for p in place.iterdir() if p.is_file()} == files
    assert (place / "episodes.csv").read_text().count("\n") == 5, "a line each, and one of names"


def test_all_tasks_that_a_policy_knows_are_tried_with_all_seeds(fdp: Path, tmp_path: Path, capsys: Capture) -> None:
    run = copy(fdp, tmp_path)
    out = evaluate(capsys, run, "--seeds", "0, 3", "--episodes", "1")
    lines = lines_of(run)
    assert episodes(lines) == [
        (task, seed, 0, (seed + 1) * 1_000_000) for task in ("drawer-open", "push-back") for seed in (0, 3)
    ]
    for task in ("drawer-open", "push-back"):
        (row,) = [line for line in out.splitlines() if task in line]
        words = [w for w in row.replace("│", " ").split() if w]
        solved = sum(x["success"] for x in lines if x["task"] == task)
        assert words[:4] == [task, "fdp", str(solved), "2"]


def test_a_single_step_of_every_plan_is_executed(fdp: Path, tmp_path: Path, capsys: Capture) -> None:
    run = copy(fdp, tmp_path)
    out = evaluate(capsys, run, "--task", TASK, "--seeds", "0", "--episodes", "1", "--execute", "1", "--json")
    (line,) = lines_of(run, PLACE.replace("execute-8", "execute-1"))
    assert not (run / PLACE).exists()
    assert json.loads(out)[0]["evaluations"][0]["n_action_steps"] == 1
    if "flow" in line:
        assert line["flow"]["pairs"] == line["flow"]["ends"], "of a single step, the mean is the end"
    policy = load_policy(run).policy
    (episode,) = roll_out(policy, SimulatorPool(TASK, SceneSettings()), [Trial(TASK, 0, 0)], n_action_steps=1)
    assert episode.result.steps == line["steps"]
    assert len(episode.predicted) == len(episode.rollout)


def test_how_many_steps_to_execute_is_chosen_on_other_layouts(
    fdp: Path, tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a policy that solves nothing all are equal, and the fewest plans win; nothing is tried twice."""
    monkeypatch.setattr(execution, "_LAYOUTS", 1)
    run, asked = copy(fdp, tmp_path), ("--task", TASK, "--seeds", 0, "--episodes", 1, "--execute", "auto")
    code, out, err = call_cli(capsys, "eval", run, *map(str, asked), "--workers", "1")
    assert code == 0, err
    choosing, _, evaluating = err.partition("evaluating")
    assert "choosing how many steps to execute: 3 of 3 episodes" in choosing
    assert evaluating.startswith(": 1 of 1 episode")
    before = files_below(run)
    (result,) = json.loads(evaluate(capsys, run, *asked, "--json"))
    assert result["execution"] == {"solved": {"2": 0, "4": 0, "8": 0}, "of": 1}
    assert [(e["n_action_steps"], len(e["outcomes"])) for e in result["evaluations"]] == [(8, 1)]
    for steps in (2, 4, 8):
        (line,) = lines_of(run, PLACE.replace("evaluation", "execution").replace("execute-8", f"execute-{steps}"))
        assert (line["seed"], line["scene_seed"]) == (3999, 4_000_000_000), "a layout that is not reported"
    assert "fdp: executes 8 steps of every plan: of 1 other layouts solved are 0 by 8, 0 by 4, 0 by 2" in out
    assert files_below(run) == before
    code, err = refused(capsys, run, "--execute", "auto", "--seeds", "0,3999")
    assert (code, "seed 3999: its layouts are those on which --execute auto chooses" in err) == (2, True)


@pytest.mark.parametrize(("solved", "best"), [((5, 9, 8), 4), ((9, 9, 9), 8), ((3, 4, 4), 4), ((0, 0, 1), 2)])
def test_what_solves_most_is_executed(fdp: Path, solved: tuple[int, int, int], best: int) -> None:
    """Of equal ones that with the fewest plans."""

    def tried(refs: Sequence[CheckpointRef], trials: Sequence[Trial]) -> list[CheckpointEvaluation]:
        by = dict(zip((8, 4, 2), solved, strict=True))
        about: dict[str, Any] = {"success_dp3": False, "steps": 9}
        return [
            CheckpointEvaluation(step=r.step, n_action_steps=r.n_action_steps, outcomes=tuple(
                EpisodeResult(task=t.task, seed=t.seed, episode=t.episode, scene_seed=t.scene_seed,
                              success=k < by[r.n_action_steps], **about)
                for k, t in enumerate(trials)))
            for r in refs
        ]  # fmt: skip

    assert execution.choose_execution(find_checkpoint(fdp), [TASK], tried).best == best


def test_checkpoints_make_a_curve(fdp: Path, tmp_path: Path, capsys: Capture) -> None:
    run = copy(fdp, tmp_path)
    asked = ("--task", TASK, "--seeds", "0", "--episodes", "1", "--json")
    (result,) = json.loads(evaluate(capsys, run, "--checkpoints", *asked))
    assert [e["step"] for e in result["evaluations"]] == [1, 2]
    first, last = (lines_of(run, PLACE.replace("02-", f"0{k}-")) for k in (1, 2))
    assert [e["outcomes"] for e in result["evaluations"]] == [first, last]
    before = files_below(run)
    (one,) = json.loads(evaluate(capsys, run / "checkpoints/step-00000001.safetensors", *asked))
    assert [e["step"] for e in one["evaluations"]] == [1]
    assert one["evaluations"][0]["outcomes"] == first
    assert files_below(run) == before


def refused(capsys: Capture, *arguments: str | Path | int) -> tuple[int, str]:
    """Exit code and the one sentence that was said."""
    code, out, err = call_cli(capsys, "eval", *map(str, arguments))
    assert out == ""
    assert err.startswith("flowlab: ")
    assert err.count("\n") == 1
    return code, err


WRONG: dict[str, tuple[list[str], int, str]] = {
    "task": (["--task", "drawer-opn"], 2, "no task that it was trained on is called 'drawer-opn'; did you mean"),
    "task of others": (["--task", "hammer"], 2, "no task that it was trained on is called 'hammer'; there are: drawer"),
    "seed without scenes": (["--seeds", "0,4000"], 2, "seed 4000: evaluation seeds are from 0 to 3999"),
    "more than is planned": (["--execute", "16"], 2, "plans 15 steps ahead, so execute 1 to 15"),
    "data for a simulation": (["--data", "d"], 2, "--data is about held-out demonstrations; add --offline"),
    "films of no episodes": (
        ["--offline", "--films", "2", "--out", "o"], 2, "--offline tries no episodes, so leave out --films, --out"
    ),
    "no such run": (["nowhere"], 3, "nowhere: not a training run (it has no policy.json)"),
    "no such checkpoint": (
        ["nowhere/checkpoints/step-00000001.safetensors"], 3, "nowhere: not a training run (it has no policy.json)",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_what_is_wrong_is_said_in_one_sentence(
    case: str, fdp: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    wrong, code, sentence = WRONG[case]
    monkeypatch.chdir(tmp_path)
    before = files_below(fdp)
    found, err = refused(capsys, fdp, *wrong)
    assert found == code
    assert sentence in err
    assert files_below(fdp) == before
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("seeds", "found"), [("0,x", "x"), (",", ""), ("-1", "-1")])
def test_seeds_that_are_none_are_refused_as_lists_of_numbers_are(
    seeds: str, found: str, fdp: Path, capsys: Capture
) -> None:
    code, out, err = call_cli(capsys, "eval", str(fdp), f"--seeds={seeds}")
    assert (code, out) == (2, "")
    assert f"Invalid value for '--seeds': {seeds}: found '{found}', expected numbers or ranges from 0" in err


def test_a_run_that_has_not_got_anywhere(fdp: Path, tmp_path: Path, capsys: Capture) -> None:
    run = copy(fdp, tmp_path)
    shutil.rmtree(run / "checkpoints")
    for more in ([], ["--checkpoints"]):
        code, err = refused(capsys, run, *more)
        assert code == 3
        assert f"{run}: has no checkpoint yet; resume it with 'flowlab train {run} --resume'" in err


def test_a_damaged_checkpoint_and_a_damaged_line(evaluated: Path, tmp_path: Path, capsys: Capture) -> None:
    run = copy(evaluated, tmp_path)
    text = (run / PLACE).read_text().splitlines(keepends=True)
    (run / PLACE).write_text("".join([text[0], "???\n", *text[1:]]))
    code, err = refused(capsys, run, *SIX)
    assert code == 3
    assert f"{run / PLACE}: line 2 is damaged (expected how an episode went, found '???'); delete the line" in err
    weights = run / "checkpoints/step-00000002.safetensors"
    weights.write_bytes(weights.read_bytes()[:100])
    code, err = refused(capsys, run, *SIX)
    assert code == 3
    assert f"{weights}: damaged" in err


def test_a_policy_that_knows_another_world_is_refused(data: Path, tmp_path: Path, capsys: Capture) -> None:
    store = tmp_path / "push.zarr"
    assert call_cli(capsys, "export", data, "--to", "dp3", "--task", "push-back", "--out", store)[0] == 0
    run = trained(store, tmp_path, "dp3")
    code, err = refused(capsys, run)
    assert code == 3
    assert f"{run}: was trained on recordings or on a DP3 store ({store}), so no simulation shows what it knows" in err
    assert f"'flowlab eval {run} --offline'" in err


def test_a_run_that_cannot_be_written_is_one_sentence(fdp: Path, tmp_path: Path, capsys: Capture) -> None:
    """Root is not told by permissions, so a file is in the way; a link may not lead out of a stranger's run."""
    run, home = copy(fdp, tmp_path), tmp_path / "home"
    asked = (run, "--episodes", "1", "--seeds", "0", "--workers", "1")
    (run / "evaluation").write_text("")
    code, err = refused(capsys, *asked)
    assert code == 3
    assert "cannot be written (" in err
    assert err.endswith("; make room, or copy the run to where it can be written\n")
    (run / "evaluation").unlink()
    home.mkdir()
    (run / "evaluation").symlink_to(home, target_is_directory=True)
    code, err = refused(capsys, *asked)
    assert code == 3
    assert f"is a link that leads out of {run}" in err
    (run / "evaluation").unlink()
    (run / PLACE).parent.mkdir(parents=True)
    (run / PLACE).symlink_to(home / "file")
    assert refused(capsys, *asked)[0] == 3
    assert list(home.iterdir()) == []
    (run / PLACE).unlink()
    (run / PLACE).symlink_to((run / PLACE).name)
    assert refused(capsys, *asked)[0] == 3


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("scene", {"camera": 5}, "policy.json: scene: camera: "),
        ("observer", {"crop": {"low": [{"a": 1}, 0, 0], "high": [1, 1, 1]}}, "the policy's observer: crop.low.0: "),
        ("queries", {"points": "many"}, "the policy's queries: points: "),
    ],
)
def test_settings_that_are_none_are_one_sentence(key: str, value: object, said: str, fdp: Path, tmp_path: Path) -> None:
    """In parts of a run that are looked at when they are used."""
    run = copy(fdp, tmp_path)
    about = policy_of(run)
    about.pop("sha256")
    (about if key == "scene" else about["policy"])[key] = value
    (run / "policy.json").write_text(json.dumps(about))
    for path in run.glob("checkpoints/*"):  # as of an earlier version, which told nothing of policy.json
        save_file(load_file(path), path, {"step": str(int(path.stem[5:]))})
    with pytest.raises(DataError, match=re.escape(said)):
        flowlab.evaluate(run, episodes=1, seeds=0, workers=1)
    if key != "scene":
        with pytest.raises(DataError, match=re.escape(said)):
            flowlab.Policy.load(run, TASK)


def test_runs_without_a_common_task(fdp: Path, tmp_path: Path, capsys: Capture) -> None:
    other = copy(fdp, tmp_path, "other")
    about = policy_of(other)
    about["policy"]["tasks"] = ["hammer", "push"]
    about.pop("sha256")
    (other / "policy.json").write_text(json.dumps(about))
    code, err = refused(capsys, fdp, other)
    assert code == 2
    assert f"no task is common to all runs ({fdp} drawer-open, push-back; {other} hammer, push)" in err


@pytest.fixture
def elsewhere(tmp_path: Path, capsys: Capture) -> Path:
    """A run on a demonstration of scene 1,000,000, seen by a smaller camera."""
    scene = options("first_seed=1000000", "expert.scene.camera.width=96", "expert.scene.camera.height=96")
    command = ("extract-sim", TASK, "--episodes", "1", "--workers", "1", "--out", tmp_path / "d")
    code, _, err = call_cli(capsys, *command, *scene)
    assert code == 0, err
    return trained(tmp_path / "d", tmp_path, "fdp")


def test_scenes_that_were_demonstrated_are_refused(elsewhere: Path, tmp_path: Path, capsys: Capture) -> None:
    """A dataset may begin anywhere; evaluation numbers begin at 1,000,000. What is left is seen as it was there."""
    assert policy_of(elsewhere)["scene_seeds"] == {TASK: [1_000_000]}
    before = files_below(tmp_path)
    code, err = refused(capsys, elsewhere, "--episodes", "2")
    assert code == 2
    assert f"{elsewhere}: its dataset holds the scene 1000000 of {TASK}, which evaluation seed 0 would try" in err
    assert files_below(tmp_path) == before
    evaluate(capsys, elsewhere, "--episodes", "1", "--seeds", "1", "--workers", "1")
    (line,) = lines_of(elsewhere)
    assert episodes([line]) == [(TASK, 1, 0, 2_000_000)]
    policy, same = load_policy(elsewhere).policy, []
    for scene in (SceneSettings(camera=CameraSettings(width=96, height=96)), SceneSettings()):
        (episode,) = roll_out(policy, SimulatorPool(TASK, scene), [Trial(TASK, 1, 0)])
        same.append(json.loads(episode.result.model_dump_json(exclude_defaults=True)) == line)
    assert same == [True, False]


@pytest.mark.slow
def test_films_show_what_was_counted(evaluated: Path, tmp_path: Path, capsys: Capture) -> None:
    run, out = copy(evaluated, tmp_path), tmp_path / "out"
    said = evaluate(capsys, run, "--task", TASK, "--seeds", "0", "--episodes", "2", "--films", "1", "--out", out)
    lines = sorted(lines_of(run), key=lambda x: x["episode"])[:2]
    expected = []
    for solved, word in ((True, "solved"), (False, "failed")):
        expected += [f"fdp-{TASK}-seed-0-{x['episode']}-{word}" for x in lines if x["success"] == solved][:1]
    assert expected
    assert {p.name for p in (out / "films").iterdir()} == {f"{x}.{end}" for x in expected for end in ("mp4", "rrd")}
    page = (out / "report.html").read_text()
    for name in expected:
        film = out / f"films/{name}.mp4"
        assert f"film: {film}" in said
        assert film.stat().st_size > 10_000
        assert f"films/{name}.mp4" in page
    assert in_order(run) == in_order(evaluated)
