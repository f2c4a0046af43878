"""``flowlab train`` as a user runs it: what it leaves and says, for all kinds of data, and what is said of mistakes."""

import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Cli
from synthetic import SETTINGS, call_cli, files_below, make_dataset, make_episode, make_manifest, make_provenance
from trained_runs import (
    NETWORK,
    SMALL,
    leftovers,
    lines_of,
    make_recorded,
    make_rolls,
    make_run,
    options,
    policy_of,
    step_in,
    train,
    weights_of,
)

from flowlab.storage.dataset import begin
from flowlab.storage.recorded import Recorded
from flowlab.training import precision

Capture = pytest.CaptureFixture[str]
KEPT = ["policy.json", "run.json", "metrics.jsonl", "curve.png", "resume.safetensors"]
ERRORS = {
    "fdp": ["action_l1", "flow_moving_mm", "flow_static_mm"],
    "dp3": ["action_l1"],
    "mba": ["action_l1", "pose_mm"],
}

STILL = options("run.steps=1", "run.checkpoints=1", "optimizer.learning_rate=1e-12")
"""A run that changes nothing."""


@pytest.fixture(scope="module")
def rolls(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_rolls(tmp_path_factory.mktemp("data") / "rolls")


def check_run(run: Path, steps: int = 20, checkpoints: int = 5) -> None:
    """Exactly the files that a finished run has, all of them whole."""
    every = [f"checkpoints/step-{round(steps * k / checkpoints):08d}.safetensors" for k in range(1, checkpoints + 1)]
    assert sorted(str(f.relative_to(run)) for f in run.rglob("*") if f.is_file()) == sorted({*KEPT, *every})
    assert (run / "curve.png").read_bytes().startswith(b"\x89PNG")
    for path in every:
        assert step_in(run / path) == int(path[17:25])
        assert all(np.isfinite(w).all() for w in weights_of(run, int(path[17:25])).values())


@pytest.mark.parametrize("policy", ["fdp", "dp3", "mba"])
def test_a_run_leaves_all_that_is_needed_to_use_it(policy: str, rolls: Path, tmp_path: Path, capsys: Capture) -> None:
    train(capsys, rolls, "--policy", policy, "--out", tmp_path / "run", *SMALL)
    check_run(tmp_path / "run")
    assert policy_of(tmp_path / "run")["policy"]["settings"]["policy"] == policy
    (line,) = lines_of(tmp_path / "run", "train")
    losses = {"loss", "action_loss"} | ({"motion_loss"} if policy != "dp3" else set())
    assert line.keys() == {"kind", "step", "lr", "samples_per_s", "cpu_s", "wall_s"} | losses
    assert line["step"] == 20
    needs_frame = lines_of(tmp_path / "run", "validation")
    assert [look["step"] for look in needs_frame] == [5, 10, 15, 20]
    baselines = {"action_l1": ("zero", "hold")}
    for look in needs_frame:
        told = {f"{e}_{b}" for e in ERRORS[policy] for b in baselines.get(e, ("zero", "constant"))}
        assert look.keys() == {"kind", "step", "cpu_s", "wall_s", *ERRORS[policy], *told}
    assert call_cli(capsys, "validate", rolls) == (0, f"{rolls}: sound\n", "")


def test_a_user_reads_what_is_trained_and_how_good_it_is(rolls: Path, tmp_path: Path, flowlab: Cli) -> None:
    result = flowlab("train", rolls, "--policy", "fdp", "--out", tmp_path / "run", *SMALL, "--precision", "fp32")
    assert result.returncode == 0, result.stderr
    said = " ".join(result.stderr.split())
    assert re.match(
        r"fdp, 0\.\d M weights, 20 steps on 3 demonstrations of roll; 1 held out; (cpu|cuda:0), fp32 points are given "
        r"in the world frame: .* step 20 of 20: [\d,]+ windows/s, loss \d\.\d{4}, held out: action \d\.\d{4}",
        said,
    ), said
    found = lines_of(tmp_path / "run", "validation")[-1]
    for error in ERRORS["fdp"]:
        (row,) = [line for line in result.stdout.splitlines() if re.search(rf"\b{error}\b", line)]
        assert f"{found[error]:,.4g}" in row
        assert f"{found[f'{error}_zero']:,.4g}" in row
    *_, last = result.stdout.splitlines()
    assert last == f"{tmp_path / 'run'}: trained for 20 steps; the curve is {tmp_path / 'run/curve.png'}"


def test_a_program_reads_the_same_as_json(rolls: Path, tmp_path: Path, capsys: Capture) -> None:
    code, out, err = call_cli(capsys, "train", rolls, "--policy", "dp3", "--out", tmp_path / "run", *SMALL, "--json")
    assert (code, err) == (0, "")
    report = json.loads(out)
    about = {"run": str(tmp_path / "run"), "policy": "dp3", "step": 20, "steps": 20, "finished": True}
    assert {key: report[key] for key in about} == about
    for kind, name in (("train", "training"), ("validation", "validation")):
        last = lines_of(tmp_path / "run", kind)[-1]
        assert report[name] == {k: v for k, v in last.items() if k not in ("kind", "step", "cpu_s", "wall_s")}


def test_minutes_are_kept_to(rolls: Path, tmp_path: Path, capsys: Capture) -> None:
    """Also against a number of steps in the profile; and the learning rate has fallen by then."""
    profile = tmp_path / "seven.yaml"
    profile.write_text(f"extends: {NETWORK}\nrun: {{steps: 7, checkpoints: 2}}\n")
    small = "--profile", profile
    train(capsys, rolls, "--policy", "dp3", "--out", tmp_path / "run", *small, "--minutes", "0.03", "--device", "cpu")
    *_, last = lines_of(tmp_path / "run")
    assert 0.6 < last["cpu_s"] / 1.8 < 1.4
    first, *_, final = lines_of(tmp_path / "run", "train")
    assert final["step"] > 50
    assert final["lr"] < first["lr"] / 20
    check_run(tmp_path / "run", final["step"], 2)


_SLOW = pytest.mark.slow


@pytest.mark.parametrize("policy", ["fdp", pytest.param("dp3", marks=_SLOW), pytest.param("mba", marks=_SLOW)])
def test_one_demonstration_is_learned_by_heart(policy: str, rolls: Path, tmp_path: Path, capsys: Capture) -> None:
    """Its actions are random numbers, so nothing but the demonstration tells them."""
    more = ("action.widths=[64,64]", "batch.draws=4", "batch.shift_m=0", "optimizer.learning_rate=1e-2")
    small = [*SMALL, *options(*more, "run.steps=200", "run.validations=1", "run.checkpoints=1")]
    train(capsys, rolls, "--policy", policy, "--out", tmp_path / "run", *small, "--overfit", 1)
    run = json.loads((tmp_path / "run/run.json").read_text())
    assert run["train"] == run["held_out"] == [0]
    (found,) = lines_of(tmp_path / "run", "validation")
    assert found["action_l1"] < 0.1 * min(found["action_l1_hold"], found["action_l1_zero"])
    if policy == "fdp":
        assert found["flow_moving_mm"] < 0.7 * min(found["flow_moving_mm_constant"], found["flow_moving_mm_zero"])
    if policy == "mba":
        assert found["pose_mm"] < 0.5 * found["pose_mm_zero"]


def test_the_seed_is_a_setting(rolls: Path, tmp_path: Path, capsys: Capture) -> None:
    for name, how in {"a": ["--seed", "7"], "b": options("run.seed=7"), "c": []}.items():
        train(capsys, rolls, "--policy", "dp3", "--out", tmp_path / name, *SMALL, *STILL, *how)
    a, b, c = (policy_of(tmp_path / name)["policy"]["settings"]["run"]["seed"] for name in "abc")
    assert (a, b, c) == (7, 7, 0)


def test_the_papers_networks_train(rolls: Path, tmp_path: Path, capsys: Capture) -> None:
    """U-Nets, 1000 epochs made one, and no demonstration held out."""
    small = options(
        "encoder.points=64", "motion.points=8", "batch.windows=16", "action.widths=[8,16]",
        "motion.denoiser.widths=[8,16,24]", "run.epochs=4", "run.checkpoints=2",
    )  # fmt: skip
    out = train(capsys, rolls, "--policy", "fdp", "--profile", "paper", "--out", tmp_path / "run", *small)
    assert "held-out" not in out
    assert lines_of(tmp_path / "run", "validation") == []
    windows = 4 * (20 - 8 + 1)  # an action is decided on at every step but the last seven
    check_run(tmp_path / "run", round(4 * windows / 16), 2)
    settings = policy_of(tmp_path / "run")["policy"]["settings"]
    assert (settings["motion"]["flow_representation"], settings["encoder"]["octaves"]) == ("channels", 0)


def test_a_profile_of_ones_own(rolls: Path, tmp_path: Path, capsys: Capture) -> None:
    (tmp_path / "mine.yaml").write_text(f"extends: {NETWORK}\nrun: {{minutes: null, steps: 11}}\n")
    train(capsys, rolls, "--policy", "mba", "--profile", tmp_path / "mine.yaml", "--out", tmp_path / "run")
    check_run(tmp_path / "run", 11)


def test_several_tasks_share_a_policy(tmp_path: Path, capsys: Capture) -> None:
    tasks = ("pour", "push", "roll")
    units = [[make_episode(k, task=task, steps=20) for k in range(3)] for task in tasks]
    make_dataset(tmp_path / "d", units)
    train(capsys, tmp_path / "d", "--policy", "fdp", "--out", tmp_path / "run", *SMALL)
    assert policy_of(tmp_path / "run")["policy"]["tasks"] == list(tasks)
    embedding = [w.shape[0] for name, w in weights_of(tmp_path / "run", 20).items() if "task" in name]
    assert embedding == [3]
    run = json.loads((tmp_path / "run/run.json").read_text())
    assert run["held_out"] == [2, 5, 8], "the last of each"
    assert run["train"] == [0, 1, 3, 4, 6, 7]


def test_dp3_trains_on_a_store_in_its_own_layout(rolls: Path, tmp_path: Path, capsys: Capture) -> None:
    assert call_cli(capsys, "export", rolls, "--to", "dp3", "--out", tmp_path / "roll.zarr")[0] == 0
    code, _, err = call_cli(
        capsys, "train", tmp_path / "roll.zarr", "--policy", "dp3", "--out", tmp_path / "run", *SMALL
    )
    assert code == 0, err
    assert "no scene is shifted or turned in training" in err, "the store does not say what its actions are"
    check_run(tmp_path / "run")
    about = policy_of(tmp_path / "run")["policy"]
    assert (about["observer"], about["tasks"], about["channels"]["gripper"]) == (None, ["roll"], None)
    before = files_below(tmp_path)
    for policy, reason in (("fdp", "has no query points, which fdp is trained on"), ("mba", "has no object poses")):
        command = ("train", tmp_path / "roll.zarr", "--policy", policy, "--out", tmp_path / policy, *SMALL)
        code, out, err = call_cli(capsys, *command)
        assert (code, out) == (3, "")
        assert reason in err
        assert "train --policy" in err
        assert err.count("\n") == 1
    assert files_below(tmp_path) == before


def test_recordings_train_with_actions_that_are_places(tmp_path: Path, capsys: Capture) -> None:
    table = tuple(Recorded(task="pour", name=f"take-{k}", seed=k, source=f"/rec/take-{k}") for k in range(4))
    about: dict[str, Any] = {"recording": {"reader": "plain"}, **SETTINGS, "track": {"tracker": "rigid-bodies"}}
    make_dataset(
        tmp_path / "d", [[make_recorded(k) for k in range(4)]], settings=about, recordings=table,
        provenance=make_provenance(about, camera={}),
        recipe="real",
    )  # fmt: skip
    code, _, err = call_cli(capsys, "train", tmp_path / "d", "--policy", "fdp", "--out", tmp_path / "run", *SMALL)
    assert code == 0, err
    assert "world frame" not in err
    assert "no scene is shifted" not in err
    check_run(tmp_path / "run")
    policy = policy_of(tmp_path / "run")["policy"]
    found = {"gripper": [0, 1, 2], "state_positions": [[0, 1, 2]], "action_position": [0, 1, 2]}
    assert {key: policy["channels"][key] for key in found} == found
    assert (policy["state_width"], policy["action_width"]) == (8, 8)
    reach = max(policy["normalizer"]["action"]["unit"][:3])
    assert reach < 0.2, "of places relative to the gripper, within the horizon"


@pytest.fixture(scope="module")
def taught(rolls: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run to begin others from."""
    return make_run(rolls, "--policy", "dp3", "--out", tmp_path_factory.mktemp("taught") / "run", *SMALL)


def test_a_run_begins_with_the_weights_of_another(taught: Path, tmp_path: Path, capsys: Capture) -> None:
    """And with its scales: the same weights would mean something else on others."""
    make_dataset(tmp_path / "d", [[make_episode(k, steps=30) for k in range(9, 12)]])
    for begun, step in ((taught, 20), (taught / "checkpoints/step-00000008.safetensors", 8)):
        out = tmp_path / f"run-{step}"
        train(capsys, tmp_path / "d", "--policy", "dp3", "--out", out, *SMALL, *STILL, "--seed", 5, "--from", begun)
        old, new = weights_of(taught, step), weights_of(out, 1)
        assert old.keys() == new.keys()
        for name in old:
            np.testing.assert_allclose(new[name], old[name], atol=1e-7)
        assert json.loads((out / "run.json").read_text())["began_from"] == str(begun)
        assert policy_of(out)["policy"]["normalizer"] == policy_of(taught)["policy"]["normalizer"]
    other = tmp_path / "other"
    train(capsys, tmp_path / "d", "--policy", "dp3", "--out", other, *SMALL, *STILL, "--seed", 5)
    assert policy_of(other)["policy"]["normalizer"] != policy_of(taught)["policy"]["normalizer"]


def test_clouds_made_otherwise_are_refused_with_the_difference(taught: Path, tmp_path: Path, capsys: Capture) -> None:
    make_rolls(tmp_path / "d", settings={**SETTINGS, "observer": {"points": 64, "crop": None, "noise": {"sigma": 0.5}}})
    command = ("train", tmp_path / "d", "--policy", "dp3", "--out", tmp_path / "run", *SMALL, "--from", taught)
    code, out, err = call_cli(capsys, *command)
    assert (code, out) == (3, "")
    about, difference = err.splitlines()
    assert f"{tmp_path / 'd'}: its point clouds were made with other settings than those that {taught}" in about
    assert difference == '  observer.noise: the dataset has {"sigma": 0.5}, the policy has null'
    assert not (tmp_path / "run").exists()


def test_another_network_is_refused(rolls: Path, taught: Path, tmp_path: Path, capsys: Capture) -> None:
    for policy, change in (("dp3", "action.widths=[40]"), ("fdp", "run.seed=0"), ("dp3", "n_obs_steps=1")):
        command = ("train", rolls, "--policy", policy, "--out", tmp_path / "run", *SMALL, *options(change))
        code, out, err = call_cli(capsys, *command, "--from", taught)
        assert (code, out) == (2, "")
        assert "step-00000020.safetensors: its network has another shape than the one asked for" in err
        assert err.count("\n") == 1
        assert not (tmp_path / "run").exists()


WRONG: dict[str, tuple[list[str], int, str]] = {
    "no policy of that name": (["--policy", "fpd"], 2, "no policy is called 'fpd'; did you mean fdp?"),
    "no profile of that name": (["--profile", "fsat"], 2, "no profile is called 'fsat'; did you mean fast?"),
    "no profile file": (["--profile", "no.yaml"], 2, "no.yaml: there is no such file, expected the profile"),
    "no group of settings": (options("motoin.points=3"), 2, "no setting of fdp is called 'motoin'; there are: "),
    "no setting": (options("motion.point=3"), 2, "motion.point: no setting is called 'point'; did you mean points?"),
    "no value": (options("motion.points"), 2, "--set motion.points: must look like batch.windows=64"),
    "wrong value": (options("motion.points=many"), 2, "motion.points: "),
    "too many query points": (options("motion.points=9"), 3, "motion.points is 9, and the dataset has 8 query points"),
    "too many points": (
        options("encoder.points=65"), 2, "encoder.points is 65, and the dataset's clouds have 64; add --set encoder."
        "points=64",
    ),
    "groups of channels": (
        options("action={kind: unet, widths: [12, 16], step_embedding: 8}"), 2, "widths are multiples of 8: (12, 16)",
    ),
    "odd horizon": (
        options("horizon=18", "action={kind: unet, widths: [8, 16, 24], step_embedding: 8}"), 2,
        "a U-Net of 3 levels cannot halve 18 steps so often",
    ),
    "no layers": (options("encoder.widths=[]"), 2, "encoder.widths: "),
    "no layers for the state": (options("encoder.state_widths=[]"), 2, "encoder.state_widths: "),
    "no levels": (options("action={kind: unet, widths: [], step_embedding: 8}"), 2, "action.widths: "),
    "embedding of odd length": (options("action.step_embedding=3"), 2, "action.step_embedding: "),
    "embedding too short": (options("action.step_embedding=2"), 2, "action.step_embedding: "),
    "beta": (options("optimizer.betas=[2, 0.9]"), 2, "optimizer.betas.0: "),
    "seed": (["--seed", "99999999999999999999"], 2, "seed"),
    "minutes without end": (["--minutes", "inf"], 2, "minutes"),
    "minutes that are no number": (["--minutes", "soon"], 2, "'soon' is not a valid float"),
    "log": (["--log", "tensorbord"], 2, "no logger is called 'tensorbord'; did you mean tensorboard?"),
    "device": (["--device", "gpu"], 2, "--device gpu: "),
    "device nobody can train on": (["--device", "meta"], 2, "--device meta: "),
    "option": (["--polcy", "fdp"], 2, "No such option"),
    "no weights to begin with": (["--from", "nowhere"], 3, "nowhere: not a training run (it has no policy.json)"),
    "out below a file": (["--out", "file/run"], 3, "file/run: cannot be written"),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_what_is_wrong_is_said_in_one_sentence(
    case: str, rolls: Path, tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    wrong, code, sentence = WRONG[case]
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    found, out, err = call_cli(capsys, "train", rolls, "--policy", "fdp", "--out", "run", *SMALL, *wrong)
    assert (found, out) == (code, "")
    assert sentence in err
    assert err.startswith(("flowlab: ", "Usage: "))
    assert len(err) < 600
    assert len(err.splitlines()) == (1 if err.startswith("flowlab") else 4)
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_what_is_missing_is_said_with_an_example(rolls: Path, tmp_path: Path, capsys: Capture) -> None:
    for given in ([], ["--policy", "fdp"], ["--out", tmp_path / "run"]):
        code, out, err = call_cli(capsys, "train", rolls, *given)
        assert (code, out) == (2, "")
        assert f"as in 'flowlab train {rolls} --policy fdp --out runs/fdp'; --resume goes on with a run\n" in err
        assert err.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_data_that_cannot_be_trained_on(tmp_path: Path, capsys: Capture) -> None:
    begin(tmp_path / "empty", make_manifest({"roll": 3}))
    make_dataset(tmp_path / "no-poses", [[make_episode(k, object_pose=False) for k in range(3)]])
    (tmp_path / "else").mkdir()
    before = {name: files_below(tmp_path / name) for name in ("empty", "no-poses", "else")}
    for name, policy, sentence in (
        ("nowhere", "fdp", "nowhere: there is no such folder"),
        ("else", "fdp", "else: not a flowlab dataset (it has no flowlab.json)"),
        ("empty", "fdp", "empty: there are no episodes to train on yet; run the command that makes the dataset again"),
        ("no-poses", "mba", "no-poses: has no object poses, which mba is trained on; make the dataset with them"),
    ):
        command = ("train", tmp_path / name, "--policy", policy, "--out", tmp_path / "run", *SMALL)
        code, out, err = call_cli(capsys, *command)
        assert (code, out) == (3, "")
        assert sentence in err
        assert err.count("\n") == 1
    assert {name: files_below(tmp_path / name) for name in before} == before
    assert sorted(p.name for p in tmp_path.iterdir()) == ["else", "empty", "no-poses"]


def test_a_run_is_not_overwritten(rolls: Path, taught: Path, tmp_path: Path, capsys: Capture) -> None:
    shutil.copytree(taught, tmp_path / "run")
    before = files_below(tmp_path)
    command = ("train", rolls, "--policy", "dp3", "--out", tmp_path / "run", *SMALL, "--seed", "5")
    code, out, err = call_cli(capsys, *command)
    assert (code, out) == (2, "")
    assert "run: holds a run already, which began in another way; choose another --out, or go on with it by" in err
    assert files_below(tmp_path) == before


def test_resume_goes_on_as_the_run_began(rolls: Path, taught: Path, tmp_path: Path, capsys: Capture) -> None:
    shutil.copytree(taught, tmp_path / "run")
    before = files_below(tmp_path)
    changed = {
        "--policy": "dp3", "--out": "x", "--profile": "paper", "--minutes": "1", "--set": "run.steps=40", "--seed": "1",
        "--overfit": "1", "--from": str(taught),
    }  # fmt: skip
    for option, value in changed.items():
        code, out, err = call_cli(capsys, "train", tmp_path / "run", "--resume", option, value)
        assert (code, out) == (2, "")
        assert err == f"flowlab: --resume goes on as the run began, so leave out {option}\n"
    assert files_below(tmp_path) == before
    code, out, err = call_cli(capsys, "train", rolls, "--resume")
    assert (code, out) == (3, "")
    assert f"{rolls}: not a training run (it has no policy.json); what a kill left of one begins again" in err


def test_bf16_is_refused_where_it_would_be_slower(
    rolls: Path, tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:

    monkeypatch.setattr(precision, "has_bf16", lambda device: False)
    small = ("train", rolls, "--policy", "dp3", *SMALL, "--device", "cpu")
    code, out, err = call_cli(capsys, *small, "--out", tmp_path / "a", "--precision", "bf16")
    assert (code, out) == (2, "")
    assert err == "flowlab: --precision bf16: cpu has no units for it, and would be slower; use fp32\n"
    assert not (tmp_path / "a").exists()
    assert call_cli(capsys, *small, "--out", tmp_path / "b")[0] == 0
    assert json.loads((tmp_path / "b/run.json").read_text())["precision"] == "fp32"


def test_where_the_cache_cannot_be_written_arrays_are_decoded_into_the_run(
    tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """For a root user, a file in the way must do. The dataset is never written to; the same command goes on there."""
    make_rolls(tmp_path / "d")
    (tmp_path / "cache").write_text("in the way")
    monkeypatch.setenv("FLOWLAB_CACHE", str(tmp_path / "cache"))
    before = files_below(tmp_path / "d")
    for _ in range(2):
        train(capsys, tmp_path / "d", "--policy", "dp3", "--out", tmp_path / "run", *SMALL)
    assert files_below(tmp_path / "d") == before
    assert sorted(p.name for p in (tmp_path / "run").iterdir()) == sorted([*KEPT, "cache", "checkpoints"])


def test_what_was_decoded_is_used_until_the_data_change(tmp_path: Path, capsys: Capture) -> None:
    make_rolls(tmp_path / "d")
    command = ["--policy", "dp3", *SMALL, *STILL]
    train(capsys, tmp_path / "d", "--out", tmp_path / "a", *command)
    decoded = files_below(tmp_path / "d/cache")
    train(capsys, tmp_path / "d", "--out", tmp_path / "b", *command)
    assert files_below(tmp_path / "d/cache") == decoded
    shutil.rmtree(tmp_path / "d/shards")
    shutil.rmtree(tmp_path / "d/receipts")
    make_dataset(tmp_path / "d", [[make_episode(k, steps=25) for k in range(5)]])
    train(capsys, tmp_path / "d", "--out", tmp_path / "c", *command)
    runs = [json.loads((tmp_path / name / "run.json").read_text()) for name in "abc"]
    assert [len(run["train"]) for run in runs] == [3, 3, 4]
    assert policy_of(tmp_path / "b")["fingerprint"] != policy_of(tmp_path / "c")["fingerprint"]
    assert leftovers(tmp_path) == []


def test_help_lists_the_policies_and_loggers_that_are_installed(capsys: Capture) -> None:
    code, out, _ = call_cli(capsys, "train", "--help")
    assert code == 0
    said = " ".join(out.split())
    assert "There are: dp3, fdp, mba; or module:Class." in said
    assert "There are: tensorboard, wandb; or module:Class." in said
