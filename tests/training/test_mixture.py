"""Training from several datasets: each with its share, all of one kind, and nothing that is held out seen twice."""

import json
import math
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from synthetic import call_cli, make_dataset, make_episode, make_provenance
from trained_runs import SMALL, lines_of, make_run, options, policy_of, saved_by, small_settings, without_times

import flowlab
from flowlab.checksums import CHECKSUM, with_checksum
from flowlab.data import source
from flowlab.data.mixture import check_weights
from flowlab.data.replay_buffer import load_buffer
from flowlab.data.source import open_training_source
from flowlab.errors import DataError, UsageError
from flowlab.evaluation.held_out import open_held_out
from flowlab.hub.names import HubName
from flowlab.hub.published_policy import finish_policy, stage_policy
from flowlab.policies.checkpoint import load_policy
from flowlab.policies.run_config import check_positions, read_run_config
from flowlab.policies.tensor_files import write_tensors
from flowlab.policies.trained import FREE
from flowlab.records import Episode
from flowlab.storage.recorded import Recorded
from flowlab.training.run import ComputeSettings, prepare_run
from flowlab.training.train import Watch

Capture = pytest.CaptureFixture[str]
HUB = "user/b@0123456789012345678901234567890123456789"
MARK = 1000.0
"""Added to the state of what is in a dataset, as often as its number, so that every row tells where it is from."""


def marked(
    folder: Path, number: int, lengths: Sequence[int], first: int = 0, task: str = "roll", **changes: Any
) -> Path:
    """A dataset of so many steps each, whose rows tell its number."""
    made = [make_episode(first + k, task=task, steps=n) for k, n in enumerate(lengths)]
    make_dataset(folder, [[replace(e, state=e.state + np.float32(MARK * number))] for e in made], **changes)
    return folder


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Path]:
    """Six demonstrations, three longer ones, and a single one of another task; some have one number in two datasets."""
    folder = tmp_path_factory.mktemp("mixture")
    return (
        marked(folder / "a", 0, [20] * 6),
        marked(folder / "b", 1, [30, 21, 25], first=2, provenance=make_provenance(hub=HUB)),
        marked(folder / "c", 2, [9], task="push"),
    )


@pytest.fixture(scope="module")
def unbroken(data: tuple[Path, ...], tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("unbroken") / "run"
    return make_run(*data, "--weights", "5,3,2", "--policy", "dp3", "--out", out, *SMALL)


def test_every_step_has_windows_of_each_dataset_by_its_weight(data: tuple[Path, ...], tmp_path: Path) -> None:
    chosen = small_settings("dp3", "batch.windows=80", "batch.segment=8", "data.held_out=0")
    trainer = prepare_run(data, tmp_path / "run", chosen, ComputeSettings(device="cpu"), weights=[5.0, 3.0, 2.0])
    buffer = load_buffer(open_training_source(*data), tmp_path)
    for step in range(20):
        windows = trainer._sampler.windows(step)
        origin = np.round(buffer.state[windows.now].mean(1) / MARK).astype(int)
        assert np.bincount(origin).tolist() == [40, 24, 16]
        assert [buffer.episodes[e].origin for e in windows.episode] == origin.tolist()


def test_what_was_mixed_is_told_by_the_run_and_by_info(data: tuple[Path, ...], unbroken: Path, capsys: Capture) -> None:
    assert json.loads((unbroken / "run.json").read_text())["weights"] == [5.0, 3.0, 2.0]
    told = policy_of(unbroken)["mixture"]
    assert [x["fingerprint"] for x in told] == [flowlab.open_dataset(d).fingerprint for d in data]
    assert [x["weight"] for x in told] == [5.0, 3.0, 2.0]
    assert [(x["demonstrations"], x["held_out"]) for x in told] == [(5, 1), (3, 0), (1, 0)]
    code, out, _ = call_cli(capsys, "info", unbroken)
    assert code == 0
    assert f"hub:{HUB}: 0.3 of the windows, from 3 demonstrations; weight 3, content {told[1]['fingerprint']}" in out
    facts = json.loads(call_cli(capsys, "info", unbroken, "--json")[1])
    named = [str(data[0]), f"hub:{HUB}", str(data[2])]
    assert [(x["dataset"], x["share"]) for x in facts["mixture"]] == list(zip(named, (0.5, 0.3, 0.2), strict=True))
    assert call_cli(capsys, "validate", unbroken)[1] == f"{unbroken}: sound\n"


def test_a_run_with_weights_that_was_stopped_goes_on_to_the_same_bits(
    data: tuple[Path, ...], unbroken: Path, tmp_path: Path, capsys: Capture
) -> None:
    asked = iter([False] * 7 + [True])
    stopped = flowlab.train(
        [*data], tmp_path / "run", policy="dp3", profile=SMALL[1], weights=[5, 3, 2],
        watch=Watch(should_stop=lambda: next(asked)),
    )  # fmt: skip
    assert (stopped.step, stopped.finished) == (8, False)
    other = ["train", *data, "--policy", "dp3", "--out", tmp_path / "run", *SMALL]
    for weights in (["--weights", "5,3,3"], []):
        code, _, err = call_cli(capsys, *other, *weights)
        assert code == 2
        assert "weights: the run has [5.0, 3.0, 2.0], this command has" in err
    assert call_cli(capsys, "train", tmp_path / "run", "--resume")[0] == 0
    assert saved_by(tmp_path / "run") == saved_by(unbroken)
    assert without_times(lines_of(tmp_path / "run")) == without_times(lines_of(unbroken))
    assert load_policy(tmp_path / "run").trained.mixture == load_policy(unbroken).trained.mixture


def test_a_policy_of_a_mixture_is_published_with_its_weights_and_without_paths(
    data: tuple[Path, ...], unbroken: Path, tmp_path: Path, capsys: Capture
) -> None:
    name = HubName.parse("hub:user/mixed@0123456789012345678901234567890123456789")
    (tmp_path / "staged").mkdir()
    stage_policy(unbroken, tmp_path / "staged", name, None)
    assert str(data[0].parent) not in "".join(p.read_text() for p in (tmp_path / "staged").glob("*.[jm][sd]*"))
    page = (tmp_path / "staged" / "README.md").read_text().replace("\\", "")
    assert f"on a (0.5 of the windows), hub:{HUB} (0.3 of the windows), c (0.2 of the windows)." in page
    shutil.copytree(tmp_path / "staged", tmp_path / "fetched")
    (tmp_path / "pulled").mkdir()
    finish_policy(tmp_path / "fetched", tmp_path / "pulled", name)
    code, out, _ = call_cli(capsys, "info", tmp_path / "pulled")
    assert code == 0
    assert "a: 0.5 of the windows, from 5 demonstrations (1 held out); weight 5" in out


def test_a_dataset_that_was_pulled_again_is_the_same(
    data: tuple[Path, ...], unbroken: Path, tmp_path: Path, capsys: Capture
) -> None:
    run = shutil.copytree(unbroken, tmp_path / "run")
    local = marked(tmp_path / "b", 1, [30, 21, 25], first=2)  # the same content, from nowhere
    moved = json.loads((run / "run.json").read_text())
    moved["more_datasets"][0] = str(local)
    (run / "run.json").write_text(json.dumps(moved))
    code, _, err = call_cli(capsys, "train", run, "--resume")
    assert code == 0, err


def _rewritten(run: Path, name: str, **changes: Any) -> None:
    """A file of a run as a stranger may give it: with a checksum that is right."""
    values = {k: v for k, v in json.loads((run / name).read_text()).items() if k != CHECKSUM}
    (run / name).write_text(json.dumps(with_checksum(values | changes, FREE if name == "run.json" else ())))


def test_runs_of_strangers_are_told_in_one_sentence(unbroken: Path, tmp_path: Path, capsys: Capture) -> None:
    mixture = policy_of(unbroken)["mixture"]
    wrong: list[tuple[str, dict[str, Any], str]] = [
        ("run.json", {"steps": -5}, "steps: "),
        ("run.json", {"train": [-1]}, "train.0: "),
        ("policy.json", {"mixture": [mixture[0] | {"demonstrations": -3}]}, "mixture.0.demonstrations: "),
        ("policy.json", {"mixture": [mixture[0] | {"held_out": 10**400}]}, "mixture.0.held_out: "),
    ]
    for k, (name, changes, said) in enumerate(wrong):
        run = shutil.copytree(unbroken, tmp_path / f"{k}")
        _rewritten(run, name, **changes)
        code, _, err = call_cli(capsys, "info", run)
        assert (code, err.count("\n")) == (3, 1)
        assert f"{run / name}: {said}" in err
    run = shutil.copytree(unbroken, tmp_path / "device")
    (run / "run.json").unlink()
    (run / "run.json").symlink_to("/dev/zero")
    assert "is a device or a pipe" in call_cli(capsys, "info", run)[2]
    plan = read_run_config(unbroken)
    with pytest.raises(DataError, match="tells of demonstration 9, counted from 0, and there are 9; restore it"):
        check_positions(unbroken, plan.model_copy(update={"train": (9,)}), 9)


@pytest.mark.parametrize("step", [math.inf, None, [1], -4, 1.5, "x", 10**400])
def test_weights_that_do_not_tell_their_step_are_one_sentence(
    step: Any, unbroken: Path, tmp_path: Path, capsys: Capture
) -> None:
    run = shutil.copytree(unbroken, tmp_path / "run")
    write_tensors(run / "checkpoints/step-99999999.safetensors", {"a": torch.zeros(1)}, {"step": step})
    for command in ("info", "validate"):
        code, out, err = call_cli(capsys, command, run)
        assert code in (1, 3)
        assert "not written by flowlab, or damaged (it does not tell its step)" in out + err


# What is refused.

WRONG_WEIGHTS = {
    "1,2": "there are 2 for 3 datasets; give one for each, in the order of the datasets, as in 0.33,0.33,0.33",
    "1,2,3,4": "there are 4 for 3 datasets",
    "1,0,1": "number 2 is 0, expected a finite number above 0; leave out a dataset that is not to be trained on",
    "1,1,-0.5": "number 3 is -0.5, expected a finite number above 0",
    "nan,1,1": "number 1 is nan, expected a finite number above 0",
    "1,inf,1": "number 2 is inf, expected a finite number above 0",
    "1,1,1e-400": "number 3 is 0, expected",
    "0.7;0.3;1": "--weights 0.7;0.3;1: must be numbers with commas between them, as in 0.7,0.3",
    "": "must be numbers with commas between them",
    "1,1,1e-9": "c has 5e-10 of the windows, less than one of the 80 runs of 4 windows in 20 steps; give it more",
}  # fmt: skip


@pytest.mark.parametrize("weights", WRONG_WEIGHTS)
def test_weights_that_are_none_are_refused_before_anything_is_written(
    weights: str, data: tuple[Path, ...], tmp_path: Path, capsys: Capture
) -> None:
    command = ["train", *data, "--policy", "dp3", "--out", tmp_path / "run", *SMALL]
    code, _, err = call_cli(capsys, *command, "--weights", weights)
    assert (code, (tmp_path / "run").exists()) == (2, False)
    assert WRONG_WEIGHTS[weights] in err


@pytest.mark.parametrize("weights", [0.5, "1,1,1", {"a": 1}, ["1", "1", "1"], [True, 1, 1], [1 + 1j, 1, 1], object()])
def test_python_refuses_what_are_no_numbers(weights: Any) -> None:
    with pytest.raises(UsageError, match=r"weights: must be one number for each dataset, as in 0\.7,0\.3; found"):
        check_weights(weights, 3)


def test_python_takes_any_numbers() -> None:
    assert check_weights(np.array([7, 3]), 2) == check_weights((7, 3.0), 2) == (7.0, 3.0)
    assert check_weights(None, 2) == ()


def test_one_dataset_has_no_weight(data: tuple[Path, ...], unbroken: Path, tmp_path: Path, capsys: Capture) -> None:
    code, _, err = call_cli(capsys, "train", data[0], "--policy", "dp3", "--out", tmp_path / "r", "--weights", "1")
    assert (code, "there is one dataset, and weights are its share beside others" in err) == (2, True)
    code, _, err = call_cli(capsys, "train", unbroken, "--resume", "--weights", "1")
    assert (code, "leave out --weights" in err) == (2, True)


def test_a_weight_of_what_is_all_held_out_is_refused(tmp_path: Path, capsys: Capture) -> None:
    places = [marked(tmp_path / "a", 0, [20, 20]), marked(tmp_path / "b", 1, [20], first=7)]
    command = ["train", *places, "--policy", "dp3", "--out", tmp_path / "run", *SMALL, "--weights", "1,1"]
    code, _, err = call_cli(capsys, *command)
    assert code == 3
    assert f"{places[1]}: its weight is 1, and none of its demonstrations (1) is trained on (1 held out)" in err
    assert call_cli(capsys, *command, "--set", "data.held_out=0")[0] == 0
    command[command.index(tmp_path / "run")] = tmp_path / "overfit"
    code, _, err = call_cli(capsys, *command, "--overfit", "1")
    assert (code, "its weight is 1, and none of its demonstrations (1)" in err) == (3, True)


def _sped_up(e: Episode) -> Episode:
    return replace(e, time_s=e.time_s / 3)


MOVED = {"K": [[1.0, 0, 0], [0, 1, 0], [0, 0, 1]]}
HAND = {"name": "hand", "index": [0, 1, 2], "kind": "position", "frame": "world", "unit": "m"}
OTHERS: dict[str, tuple[dict[str, Any], str]] = {
    "kind": ({"kind": "imported"}, 'kind: {a} has "recorded", {b} has "imported"'),
    "world frame": ({"world_frame": "y up"}, 'world_frame: {a} has "z up", {b} has "y up"'),
    "camera": ({"camera": MOVED}, "camera.K: {a} has [["),
    "points": ({"observer": {"points": 32}}, "observer.points: {a} has 64, {b} has 32"),
    "crop": ({"observer": {"points": 64, "crop": {"low": [0, 0, 0]}}}, "observer.crop: {a} has null, {b} has {{"),
    "queries": ({"queries": {"points": 9}}, "queries.points: {a} has 8, {b} has 9"),
    "state": ({"state": [HAND]}, 'state: {a} has null, {b} has [{{"name": "hand"'),
    "action": ({"action": [HAND | {"kind": "displacement"}]}, "action: {a} has null, {b} has [{{"),
    "limits": ({"action_limits": [[-1.0] * 4, [1.0] * 4]}, "action_limits: {a} has null, {b} has [["),
}


@pytest.mark.parametrize("other", OTHERS)
def test_datasets_that_contradict_each_other_are_refused(
    other: str, data: tuple[Path, ...], tmp_path: Path, capsys: Capture
) -> None:
    changes, said = OTHERS[other]
    b = marked(tmp_path / "b", 1, [20], first=50, provenance=make_provenance(**changes))
    _refused(capsys, data[0], b, tmp_path, said.format(a=data[0], b=b))


def _refused(capsys: Capture, a: Path, b: Path, tmp_path: Path, said: str) -> None:
    command = ["train", a, b, "--policy", "dp3", "--out", tmp_path / "run", *SMALL]
    for weights in ([], ["--weights", "0.7,0.3"]):
        code, _, err = call_cli(capsys, *command, *weights)
        assert (code, (tmp_path / "run").exists()) == (3, False)
        assert f"{b}: " in err
        assert said in err
        assert err.count("\n") == 1


def test_datasets_whose_rows_do_not_fit_each_other_are_refused(
    data: tuple[Path, ...], tmp_path: Path, capsys: Capture
) -> None:
    a, plain = data[0], make_episode(50, steps=20)
    narrow = {
        "rate": (_sped_up(plain), f"time: a step takes 0.004167 s in {{b}}, and 0.0125 s in {a}"),
        "action": (replace(plain, action=plain.action[:, :3]), "its action has 3 numbers a step"),
        "state": (replace(plain, state=plain.state[:, :8]), "its state has 8 numbers a step"),
        "pose": (replace(plain, object_pose=None), f"'object_pose' is (0,) wide, in those before, of {a}, (9,)"),
    }
    for name, (episode, said) in narrow.items():
        make_dataset(tmp_path / name, [[episode]])
        _refused(capsys, a, tmp_path / name, tmp_path, said.format(b=tmp_path / name))


def test_merging_is_no_way_around_other_rates_nor_are_three_datasets(
    data: tuple[Path, ...], tmp_path: Path, capsys: Capture
) -> None:
    for k, seconds in enumerate((0.0125 * 1.04, 0.0125 / 1.04, 0.0125 / 3)):  # two near to a, and not to each other
        made = replace(make_episode(50 + k, steps=20), time_s=np.arange(20) * seconds)
        make_dataset(tmp_path / f"{k}", [[made]])
    near, other, quick = (tmp_path / f"{k}" for k in range(3))
    with pytest.raises(DataError, match=f"{other}: cannot be trained on together with {near}: time: a step takes"):
        open_training_source(data[0], near, other)
    code, _, err = call_cli(capsys, "merge", data[0], quick, "--out", tmp_path / "merged")
    assert (code, (tmp_path / "merged").exists()) == (3, False)
    assert f"{quick}: cannot be merged with {data[0]}: time: a step takes 0.004167 s in" in err


def test_that_nothing_says_what_numbers_mean_is_said(
    data: tuple[Path, ...], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    said = "does not say what the numbers of its {} mean, nor does {}; they are taken to mean the same"
    chosen, compute = small_settings("dp3"), ComputeSettings(device="cpu")
    prepare_run(data[:2], tmp_path / "run", chosen, compute)
    assert f"{data[0]}: {said.format('state and action', data[1])}" in caplog.text
    about = make_provenance(state=[HAND])
    told = [marked(tmp_path / n, 0, [20, 20], first=9 * k, provenance=about) for k, n in enumerate("ab")]
    caplog.clear()
    flowlab.merge(told, tmp_path / "merged")
    assert f"{told[0]}: {said.format('action', told[1])}" in caplog.text


def test_rates_as_near_as_those_of_two_clocks_and_other_trackers_are_fine(
    data: tuple[Path, ...], tmp_path: Path
) -> None:
    near = replace(make_episode(50, steps=20), time_s=np.arange(20) / 80.3)
    make_dataset(
        tmp_path / "near", [[near]], provenance=make_provenance(license="mit", tracks="estimated", tracker="x")
    )
    assert open_training_source(data[0], tmp_path / "near").frames == 140


def test_what_is_given_twice_is_refused_under_another_name_too(
    data: tuple[Path, ...], tmp_path: Path, capsys: Capture
) -> None:
    a = data[0]
    shutil.copytree(a, tmp_path / "copy")
    _refused(capsys, a, a, tmp_path, "is given twice; leave one out")
    (tmp_path / "link").symlink_to(a)
    _refused(capsys, a, tmp_path / "link", tmp_path, "is given twice")
    _refused(capsys, a, tmp_path / "copy", tmp_path, f"6 of its 6 episodes are in {a}, too, and would count twice")
    flowlab.subset(a, tmp_path / "some", episodes="2:4")
    _refused(capsys, a, tmp_path / "some", tmp_path, f"2 of its 2 episodes are in {a}, too")
    merged = flowlab.merge([a, tmp_path / "some"], tmp_path / "merged")
    assert len(merged) == 6


def test_a_run_of_an_earlier_version_on_datasets_that_share_episodes_goes_on(
    data: tuple[Path, ...], tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(data[0], tmp_path / "copy")
    with monkeypatch.context() as earlier:
        earlier.setattr(source, "check_trained_together", source.check_alike)
        run = make_run(data[0], tmp_path / "copy", "--policy", "dp3", "--out", tmp_path / "run", *SMALL)
    for command in (["validate", run], ["train", run, "--resume"], ["eval", run, "--offline"]):
        code, _, err = call_cli(capsys, *command)
        assert code == 0, err


def test_dp3_stores_are_trained_on_alone(data: tuple[Path, ...], tmp_path: Path, capsys: Capture) -> None:
    assert call_cli(capsys, "export", data[0], "--to", "dp3", "--out", tmp_path / "s.zarr")[0] == 0
    _refused(capsys, data[1], tmp_path / "s.zarr", tmp_path, "a store in DP3's layout does not tell its frame")


# What is held out.


@pytest.mark.parametrize("kind", ["simulated", "recorded"])
def test_a_scene_that_is_held_out_is_not_trained_on_from_another_dataset(
    kind: str, tmp_path: Path, capsys: Capture, caplog: pytest.LogCaptureFixture
) -> None:
    for name in ("a", "b"):
        shown = list(range(5))
        if kind == "recorded" and name == "b":  # a recording may have another number in each dataset
            shown.reverse()
        known = [
            Recorded(task="roll", name=f"r{k}", seed=k, source=f"r{k}", content=f"content {x}")
            for k, x in enumerate(shown)
        ]
        about: dict[str, Any] = {"recordings": tuple(known)} if kind == "recorded" else {}
        marks = np.float32(MARK * (name == "b"))
        made = [replace(make_episode(x, steps=20), seed=k) for k, x in enumerate(shown)]
        units = [[replace(e, state=e.state + marks)] for e in made]
        make_dataset(tmp_path / name, units, provenance=make_provenance(kind=kind), **about)
    command = ["train", tmp_path / "a", tmp_path / "b", "--policy", "dp3", "--out", tmp_path / "run", *SMALL]
    code, _, err = call_cli(capsys, *command, "--weights", "1,1")
    assert code == 0, err
    assert f"{tmp_path / 'b'}: 5 of its scenes are in {tmp_path / 'a'}, too, as other episodes" in caplog.text
    plan = read_run_config(tmp_path / "run")
    buffer = load_buffer(open_training_source(tmp_path / "a", tmp_path / "b"), tmp_path)
    ways = [buffer.object_pose[e.start : e.stop, 1].mean() for e in buffer.episodes]  # where the ball rolls
    held = {ways[k] for k in plan.held_out}
    assert len(plan.held_out) == 1
    assert not held & {ways[k] for k in plan.train}
    assert len(plan.train) == 8


def test_a_single_scene_of_several_datasets_leaves_nothing_to_train_on(tmp_path: Path, capsys: Capture) -> None:
    places = [
        marked(tmp_path / name, k, [20], provenance=make_provenance(kind="simulated")) for k, name in enumerate("abc")
    ]
    command = ["train", *places, "--policy", "dp3", "--out", tmp_path / "run", *SMALL]
    code, _, err = call_cli(capsys, *command)
    assert (code, "nothing is left to train on beside what is held out; add --set data.held_out=0" in err) == (3, True)
    assert call_cli(capsys, *command, "--set", "data.held_out=0")[0] == 0


def test_demonstrations_with_one_number_in_two_datasets_keep_their_own_cameras(tmp_path: Path) -> None:
    places, focal = [], {}
    for k, name in enumerate("ab"):
        made = [make_episode(s, steps=20) for s in range(3)]
        K = made[0].camera.K.copy()
        K[0, 0] += k
        camera = replace(made[0].camera, K=K)
        focal[k] = K[0, 0]
        shifted = [replace(e, camera=camera, state=e.state + np.float32(MARK * k)) for e in made]
        make_dataset(tmp_path / name, [[e] for e in shifted], provenance=make_provenance(camera={}))
        places.append(tmp_path / name)
    run = make_run(*places, "--policy", "dp3", "--out", tmp_path / "run", *SMALL, *options("data.held_out=2"))
    held = open_held_out(load_policy(run))
    assert held.cameras is not None
    for demo, camera in zip(held.buffer.episodes, held.cameras, strict=True):
        origin = round(float(held.buffer.state[demo.start].mean()) / MARK)
        assert camera is not None
        assert camera.K[0, 0] == focal[origin]
