"""Runs that flowlab of commit 79a7dbb made open, act and go on as they did."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.torch import load_file
from synthetic import call_cli

from flowlab.deployment.robot_policy import Policy
from flowlab.errors import DataError
from flowlab.geometry.camera import Camera
from flowlab.policies.checkpoint import load_policy
from flowlab.policies.migrations import migrate_tensor
from flowlab.policies.trained import read_trained
from flowlab.records import Frame
from flowlab.training.metrics import last_metrics

OLD = Path(__file__).parents[1] / "fixtures/old"
RUNS = ("fdp", "dp3", "mba", "fdp-channels")
LOOKING_DOWN = np.array([[1.0, 0, 0, 0.0], [0, -1, 0, 0.6], [0, 0, -1, 1.0], [0, 0, 0, 1]])


def frame_of(t: int) -> Frame:
    """A tilted table, and a block on it that goes right; as what ``golden.npz`` was made with."""
    camera = Camera(64, 48, np.array([[60.0, 0, 31.5], [0, 60.0, 23.5], [0, 0, 1]]), LOOKING_DOWN)
    v, u = np.mgrid[:48, :64]
    depth = 0.95 - 0.0007 * u - 0.0011 * v
    block = (v >= 18) & (v < 30) & (u >= 16 + 2 * t) & (u < 30 + 2 * t)
    return Frame(np.where(block, depth - 0.12, depth).astype(np.float32), camera)


def state_of(t: int) -> np.ndarray:
    gripper = np.array([-0.1 + 0.02 * t, 0.6, 0.3 - 0.01 * t])
    side = np.array([0.04, 0.0, -0.03])
    return np.concatenate([gripper, gripper - side, gripper + side * [1, 1, -1]]).astype(np.float32)


def check_same(found: Any, wanted: Any, name: str = "") -> None:
    """Bit for bit on a CPU of the kind that made the fixtures (AMD EPYC, torch 2.13); others round differently."""
    np.testing.assert_allclose(found, wanted, rtol=1e-4, atol=1e-6, err_msg=name)


def check_learned(found: np.ndarray, wanted: np.ndarray, name: str) -> None:
    """All but a few, or one of few: gradients are summed in another order than then, on an Intel Xeon with AMX in still
    another, and AdamW makes steps of their signs where they are next to nothing. They are nothing before a norm of
    groups of one channel each, which takes biases away again."""
    off = np.abs(found - wanted)
    assert off.max() < 0.005, name
    many = (off > 1e-5 + 1e-4 * np.abs(wanted)).sum() > max(1, 0.02 * off.size)
    assert name.endswith("conv.linear.bias") or not many, name


@pytest.mark.parametrize("name", RUNS)
def test_an_old_run_acts_as_it_did(name: str) -> None:
    """Over two plans."""
    pytest.importorskip(
        "open3d", reason="their clouds were cleared of stray points, which needs Open3D", exc_type=OSError
    )
    golden = np.load(OLD / "golden.npz")
    policy = Policy.load(OLD / "runs" / name)
    actions = np.stack([policy.act(frame_of(t), state_of(t)) for t in range(10)])
    check_same(actions, golden[f"{name}/actions"])
    assert policy.planned_at == golden[f"{name}/planned_at"]
    if f"{name}/flow" in golden:
        assert policy.flow is not None
        assert policy.queries is not None
        check_same(policy.flow, golden[f"{name}/flow"])
        check_same(policy.queries.xyz_world, golden[f"{name}/queries"])


@pytest.mark.parametrize("name", RUNS)
def test_what_an_old_run_says_of_itself_is_read(name: str) -> None:
    trained = read_trained(OLD / "runs" / name)
    assert trained.scene_seeds == {"reach": (76, 77, 79)}
    assert trained.scene is not None
    assert trained.policy.settings.policy == name.partition("-")[0]
    assert (trained.policy.settings.n_obs_steps, trained.policy.settings.n_action_steps) == (2, 4)
    assert trained.policy.observer is not None
    assert trained.policy.observer["remove_outliers"] == {"neighbors": 15, "std_ratio": 2.5}
    assert "action_l1" in last_metrics(OLD / "runs" / name / "metrics.jsonl", "validation")
    assert load_policy(OLD / "runs" / name).step == 4


def copy_run(name: str, folder: Path) -> Path:
    """An old run and its dataset, which it finds."""
    shutil.copytree(OLD / "dataset-sim", folder / "data")
    run = Path(shutil.copytree(OLD / "runs" / name, folder / "run"))
    config = json.loads((run / "run.json").read_text())
    (run / "run.json").write_text(json.dumps(config | {"dataset": str(folder / "data")}))
    return run


def test_an_old_run_that_was_interrupted_goes_on_as_it_would_have(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """After two of four steps; the weights are those of the run that was not."""
    run = copy_run("fdp-interrupted", tmp_path)
    code, _, err = call_cli(capsys, "train", run, "--resume", "--json")
    assert code == 0, err
    whole = load_file(OLD / "runs/fdp/checkpoints/step-00000004.safetensors")
    found = load_file(run / "checkpoints/step-00000004.safetensors")
    assert found.keys() == {migrate_tensor(name) for name in whole}
    for name, values in whole.items():
        check_same(found[migrate_tensor(name)], values, name)
    assert read_trained(run) == read_trained(OLD / "runs/fdp")


SMALL = {
    "fdp": ("motion.points=12", "motion.subset=6"),
    "mba": (),
    "dp3": (),
    "fdp-channels": ("motion.points=12", "motion.subset=null", "motion.flow_representation=channels",
                     "motion.denoiser.kind=unet", "action.kind=unet"),
}  # fmt: skip
SAME = (
    "run.steps=4", "run.minutes=null", "run.validations=2", "run.checkpoints=1", "horizon=8", "n_action_steps=4",
    "encoder.points=32", "encoder.subset=16", "encoder.widths=[4]", "encoder.features=4", "encoder.state_widths=[4]",
    "action.widths=[8]", "action.step_embedding=4", "batch.windows=8", "batch.segment=4", "batch.draws=2",
)  # fmt: skip
MOTION = ("motion.features=4", "motion.denoiser.widths=[8]", "motion.denoiser.step_embedding=4")


@pytest.mark.parametrize("name", RUNS)
def test_the_same_training_ends_with_the_same_weights(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As it did before policies were a family: order of construction, of noise and of windows are what they were."""
    shutil.copytree(OLD / "dataset-sim", tmp_path / "data")
    policy = name.partition("-")[0]
    changes = [*SAME, *(() if policy == "dp3" else MOTION), *SMALL[name]]
    given = [word for change in changes for word in ("--set", change)]
    command = ("train", tmp_path / "data", "--policy", policy, "--out", tmp_path / "run", "--device", "cpu")
    code, _, err = call_cli(capsys, *command, "--precision", "fp32", "--json", *given)
    assert code == 0, err
    old = load_file(OLD / "runs" / name / "checkpoints/step-00000004.safetensors")
    found = load_file(tmp_path / "run/checkpoints/step-00000004.safetensors")
    for key, values in old.items():
        check_learned(found[migrate_tensor(key)].numpy(), values.numpy(), key)
    new, was = (json.loads(read_trained(r).model_dump_json()) for r in (tmp_path / "run", OLD / "runs" / name))
    for about in (new, was):
        del about["dataset"], about["versions"]
    if policy != "fdp":  # the query points' settings were kept of policies that have none
        del was["policy"]["queries"], new["policy"]["queries"]
    assert new == was


def edit(run: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    values = json.loads((run / "policy.json").read_text())
    change(values)
    (run / "policy.json").write_text(json.dumps(values))


HOSTILE = {
    "os:system": "is not a subclass of flowlab.policies.base.PolicyNetwork",
    "evil:Evil": "cannot be imported (No module named 'evil')",
    "flowlab.data.batches:Batch": "is not a subclass of flowlab.policies.base.PolicyNetwork",
    "fpd": "no policy is called 'fpd'; did you mean fdp?",
}


@pytest.mark.parametrize("policy", HOSTILE)
def test_a_run_of_a_stranger_runs_nothing(policy: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither a module beside it, nor one where the user happens to be, nor anything that is no policy."""
    run = Path(shutil.copytree(OLD / "runs/dp3", tmp_path / "run"))
    for folder in (tmp_path, run):
        (folder / "evil.py").write_text("import pathlib\npathlib.Path('hacked').touch()\nclass Evil: ...\n")
    monkeypatch.chdir(tmp_path)
    edit(run, lambda values: values["policy"]["settings"].update(policy=policy))
    with pytest.raises(DataError) as caught:
        load_policy(run)
    assert HOSTILE[policy] in str(caught.value)
    assert "policy.json" in str(caught.value)
    assert not (tmp_path / "hacked").exists()


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda v: v.update(format=3), "format is 3, this flowlab reads 2; use the flowlab that wrote it"),
        (lambda v: v["policy"]["settings"].update(horizon=0), "horizon: Input should be greater than 0"),
        (lambda v: v["policy"]["settings"].pop("policy"), "policy: must be the name of a policy"),
        (lambda v: v.update(policy=[]), "policy: Input should be a valid dictionary"),
    ],
)
def test_a_damaged_old_run_is_one_sentence(change: Any, sentence: str, tmp_path: Path) -> None:
    run = Path(shutil.copytree(OLD / "runs/dp3", tmp_path / "run"))
    edit(run, change)
    with pytest.raises(DataError) as caught:
        load_policy(run)
    assert sentence in str(caught.value)
    assert "\n" not in str(caught.value)
