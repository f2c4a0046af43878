"""What a run keeps is the policy that was trained, whole whatever happens, and nothing but JSON and numbers."""

import json
import os
import re
import resource
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file
from synthetic import SETTINGS, call_cli, make_dataset, make_episode
from trained_runs import (
    SMALL,
    header_of,
    leftovers,
    make_recorded,
    make_rolls,
    make_run,
    options,
    policy_of,
    saved_by,
    small_settings,
    train,
    weights_of,
)

import flowlab
from flowlab.checksums import with_checksum
from flowlab.data.batch_builder import BatchBuilder
from flowlab.data.batches import Batch
from flowlab.data.replay_buffer import load_buffer
from flowlab.data.source import open_training_source
from flowlab.data.window_sampler import index_windows
from flowlab.errors import DataError
from flowlab.policies.base import PolicyNetwork
from flowlab.policies.checkpoint import load_policy
from flowlab.policies.trained import RESUME
from flowlab.storage.dataset import Dataset
from flowlab.training import run as training_run
from flowlab.training.trainer import Trainer

Capture = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def rolls(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_rolls(tmp_path_factory.mktemp("data") / "rolls")


@pytest.fixture(scope="module")
def run(rolls: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run. Copy it before changing it."""
    return make_run(rolls, "--policy", "fdp", "--out", tmp_path_factory.mktemp("run") / "run", *SMALL)


def prepare(data: Path, out: Path, policy: str, *changes: str) -> Trainer:
    settings = small_settings(policy, *changes)
    return training_run.prepare_run(data, out, settings, training_run.ComputeSettings(device="cpu"))


def windows_of(data: Path, policy: PolicyNetwork) -> Batch:
    """Every window of a dataset."""
    buffer = load_buffer(open_training_source(data), data)
    settings = policy.spec.settings
    every = index_windows(buffer, list(range(len(buffer.episodes))), settings.n_action_steps)
    return BatchBuilder(buffer, policy.spec.channels, settings, policy.spec.tasks).build(every)


def plan(policy: PolicyNetwork, batch: Batch) -> list[torch.Tensor]:
    """Action, flow and pose, as far as it predicts them."""
    made = policy.plan(batch, torch.Generator().manual_seed(3))
    return [t for t in (made.action, made.flow, made.object_pose) if t is not None]


@pytest.mark.parametrize("policy", ["fdp", "dp3", "mba"])
def test_a_policy_from_disk_plans_what_the_trained_one_does(policy: str, tmp_path: Path) -> None:
    """With places relative to the gripper, several tasks, and scales that are all in use."""
    units = [[make_recorded(k) for k in range(3)], [replace(make_recorded(k), task="wipe") for k in range(3)]]
    if policy == "mba":
        pose = make_episode(0, steps=24).object_pose
        units = [[replace(e, object_pose=pose) for e in unit] for unit in units]
    make_dataset(tmp_path / "d", units)
    trainer = prepare(tmp_path / "d", tmp_path / "run", policy)
    assert training_run.run(trainer, lambda _: None)
    loaded = load_policy(tmp_path / "run")
    assert (loaded.step, loaded.path.name) == (20, "step-00000020.safetensors")
    batch = windows_of(tmp_path / "d", trainer.policy)
    averaged, found = plan(trainer.average.policy, batch), plan(loaded.policy, batch)
    assert len(found) == (1 if policy == "dp3" else 2)
    assert all(torch.equal(a, b) for a, b in zip(found, averaged, strict=True))
    raw = plan(trainer.policy.eval(), batch)
    assert not torch.equal(raw[0], found[0]), "it is the average that is kept"
    assert not any(p.requires_grad for p in loaded.policy.parameters())


def test_every_checkpoint_is_a_policy(run: Path, rolls: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(run / "checkpoints")
    plans = []
    for step in (4, 12, 20):
        loaded = load_policy(Path(f"step-{step:08d}.safetensors"))
        assert loaded.step == step
        for name, values in weights_of(run, step).items():
            assert np.array_equal(loaded.policy.state_dict()[name].numpy(), values)
        plans.append(plan(loaded.policy, windows_of(rolls, loaded.policy))[0])
    assert not torch.equal(plans[0], plans[1])
    assert torch.equal(plans[2], plan(load_policy(run).policy, windows_of(rolls, loaded.policy))[0])


def test_nothing_is_pickled(run: Path, rolls: Path) -> None:
    cache = Path(os.environ["FLOWLAB_CACHE"])
    files = [f for f in [*run.rglob("*"), *cache.glob(f"datasets/{Dataset(rolls).fingerprint}*/*/*")] if f.is_file()]
    assert {f.suffix for f in files} == {".json", ".jsonl", ".png", ".safetensors", ".npy"}
    for file in files:
        match file.suffix:
            case ".json":
                json.loads(file.read_text())
            case ".jsonl":
                assert all(json.loads(line) for line in file.read_text().splitlines())
            case ".safetensors":
                numbers = {about["dtype"] for name, about in header_of(file).items() if name != "__metadata__"}
                assert numbers <= {"F32", "F64"}
            case ".npy":
                np.load(file, allow_pickle=False)


def test_policy_json_tells_what_the_policy_is(run: Path, rolls: Path) -> None:
    about = policy_of(run)
    assert about["format"] == 2
    assert (about["dataset"], about["fingerprint"]) == (str(rolls), Dataset(rolls).fingerprint)
    assert about["versions"] == {
        "flowlab": flowlab.__version__, "torch": torch.__version__, "numpy": version("numpy"),
    }  # fmt: skip
    policy = about["policy"]
    assert (policy["state_width"], policy["action_width"], policy["tasks"]) == (9, 4, ["roll"])
    assert policy["observer"] == SETTINGS["observer"]
    assert policy["queries"] == {"points": 8, "sampling": "scene", "object_share": 1 / 3}
    settings = policy["settings"]
    assert (settings["policy"], settings["encoder"]["points"], settings["run"]["steps"]) == ("fdp", 64, 20)
    demos = [Dataset(rolls).episode(k) for k in range(4)]
    for name in ("action", "state"):
        values = np.concatenate([getattr(e, name) for e in demos])
        scale = policy["normalizer"][name]
        np.testing.assert_allclose(scale["offset"], (values.min(0) + values.max(0)) / 2, atol=1e-6)
        np.testing.assert_allclose(scale["unit"], (values.max(0) - values.min(0)) / 2, atol=1e-6)


def test_a_format_of_the_future_is_refused(run: Path, tmp_path: Path, capsys: Capture) -> None:
    shutil.copytree(run, tmp_path / "run")
    about = policy_of(run) | {"format": 3}
    (tmp_path / "run/policy.json").write_text(json.dumps(about))
    sentence = f"{tmp_path / 'run/policy.json'}: format is 3, this flowlab reads 2; use the flowlab that wrote it"
    with pytest.raises(DataError, match=re.escape(sentence)):
        load_policy(tmp_path / "run")
    assert call_cli(capsys, "train", tmp_path / "run", "--resume") == (3, "", f"flowlab: {sentence}\n")


def test_weights_of_another_shape_are_refused(run: Path, tmp_path: Path, capsys: Capture) -> None:
    shutil.copytree(run, tmp_path / "run")
    about = policy_of(run)
    about["policy"]["settings"]["encoder"]["features"] = 24
    rewrite(tmp_path / "run/policy.json", about)
    newest, resume = (tmp_path / "run" / name for name in ("checkpoints/step-00000020.safetensors", RESUME))
    sentence = f"was saved beside another policy.json than {tmp_path / 'run/policy.json'}; restore both from one run"
    with pytest.raises(DataError, match=re.escape(f"{newest}: {sentence}")):
        load_policy(tmp_path / "run")
    assert call_cli(capsys, "train", tmp_path / "run", "--resume") == (3, "", f"flowlab: {resume}: {sentence}\n")
    for path in (newest, resume):  # as an earlier version wrote them, without digests
        save_file(load_file(path), path, {"step": "20"})
    with pytest.raises(DataError, match=re.escape(f"{newest}: does not fit {tmp_path / 'run/policy.json'}; restore")):
        load_policy(tmp_path / "run")
    code, out, err = call_cli(capsys, "train", tmp_path / "run", "--resume")
    assert (code, out) == (3, "")
    sentence = "its resume file does not fit its policy.json; restore both from one run"
    assert err == f"flowlab: {tmp_path / 'run'}: {sentence}\n"


def test_a_checkpoint_under_the_name_of_another_is_refused(run: Path, tmp_path: Path, capsys: Capture) -> None:
    shutil.copytree(run, tmp_path / "run")
    *_, before, last = sorted((tmp_path / "run/checkpoints").iterdir())
    shutil.copy(before, last)
    with pytest.raises(DataError, match=f"{last.name}: holds the weights after {int(before.stem[5:])} steps"):
        load_policy(tmp_path / "run")


def test_other_weights_do_not_pass_for_lost_ones_in_silence(
    run: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    shutil.copytree(run, tmp_path / "run")
    *_, before, last = sorted((tmp_path / "run/checkpoints").iterdir())
    last.unlink()
    assert load_policy(tmp_path / "run").path == before
    told = f"flowlab: {tmp_path / 'run/checkpoints'}: there were weights called {last.name}, and are no longer"
    assert caplog.messages == [told]
    (tmp_path / "run/resume.safetensors").unlink()  # whoever is done with training may delete it
    load_policy(tmp_path / "run")
    assert caplog.messages == [told]


def rewrite(path: Path, values: dict[str, Any]) -> None:
    """Write a run's JSON with the digest of its content, as somebody might who means it."""
    path.write_text(json.dumps(with_checksum({k: v for k, v in values.items() if k != "sha256"})))


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-9])


def lose_a_tensor(path: Path) -> None:
    tensors = load_file(path)
    tensors.pop(next(iter(tensors)))
    save_file(tensors, path, {"step": "20"})


@pytest.mark.parametrize(
    ("damage", "sentence"),
    [
        (cut, "damaged"),
        (lambda p: p.write_bytes(b"\x80\x04N."), "damaged"),
        (lambda p: save_file(load_file(p), p), "it does not tell its step"),
        (lose_a_tensor, "does not fit"),
        (lambda p: (p.unlink(), os.mkfifo(p)), "is a device or a pipe, expected a file"),
    ],
)
def test_a_damaged_checkpoint_is_said_in_one_sentence(
    damage: Callable[[Path], None], sentence: str, run: Path, rolls: Path, tmp_path: Path, capsys: Capture
) -> None:
    """And without it, the one before is used."""
    shutil.copytree(run, tmp_path / "run")
    newest = tmp_path / "run/checkpoints/step-00000020.safetensors"
    damage(newest)
    command = ("train", rolls, "--policy", "fdp", "--out", tmp_path / "more", *SMALL, "--from", tmp_path / "run")
    code, out, err = call_cli(capsys, *command)
    assert (code, out) == (3, "")
    assert err.startswith(f"flowlab: {newest}: ")
    assert sentence in err
    assert err.count("\n") == 1
    newest.unlink()
    assert load_policy(tmp_path / "run").step == 16
    with pytest.raises(DataError, match="there is no such checkpoint"):
        load_policy(newest)


SAVES = """
import resource, sys, torch
from pathlib import Path
from flowlab.policies.tensor_files import write_tensors
tensors = {str(k): torch.full((10_000_000,), float(k)) for k in range(3)}
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
write_tensors(Path(sys.argv[1]), tensors, {"step": 3})
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1000)
"""


def test_to_save_takes_no_second_copy_in_memory(tmp_path: Path) -> None:
    """The paper's networks have gigabytes of weights, and three times as much that goes on changing."""
    file = tmp_path / "resume.safetensors"
    told = subprocess.run([sys.executable, "-c", SAVES, file], capture_output=True, text=True, check=True)
    assert float(told.stdout) < 30, "of 120 MB"
    assert file.stat().st_size > 120e6
    assert file.stat().st_mode & 0o777 == 0o666 & ~umask()
    assert [p.name for p in tmp_path.iterdir()] == [file.name]


def umask() -> int:
    """Of this process."""
    os.umask(now := os.umask(0))
    return now


@contextmanager
def no_file_larger_than(size: int) -> Iterator[None]:
    """As on a disk that has so much room for every file."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("too_large", ["resume.safetensors", "checkpoints/step-00000012.safetensors", "metrics.jsonl"])
def test_a_full_disk_costs_no_more_than_the_steps_since(
    too_large: str, run: Path, rolls: Path, tmp_path: Path, capsys: Capture
) -> None:
    """Whichever file it is that has no room: one sentence, all that was kept is whole, and the run goes on later."""
    trainer = prepare(rolls, tmp_path / "run", "fdp")
    steps = iter(range(1, 100))
    assert not training_run.run(trainer, lambda _: None, lambda: next(steps) == 9)
    whole = saved_by(tmp_path / "run")
    with no_file_larger_than((run / too_large).stat().st_size - 1 if "safe" in too_large else 300):
        code, out, err = call_cli(capsys, "train", tmp_path / "run", "--resume", "--json")
    assert (code, out) == (3, "")
    assert re.fullmatch(
        rf"flowlab: {tmp_path / 'run'}: cannot be written \(.*File too large.*\); what was saved before is whole\. "
        rf"Make room, then go on with 'flowlab train {tmp_path / 'run'} --resume'\n",
        err,
    )
    assert {name: content for name, content in saved_by(tmp_path / "run").items() if name in whole} == whole
    assert leftovers(tmp_path / "run") == []
    for file in (tmp_path / "run").rglob("*.safetensors"):
        header_of(file)
    train(capsys, tmp_path / "run", "--resume")
    assert saved_by(tmp_path / "run") == saved_by(run)


@pytest.mark.parametrize("room", [0, 2000, 20_000])
def test_a_full_disk_at_the_start(room: int, tmp_path: Path, capsys: Capture) -> None:
    make_rolls(tmp_path / "d")
    with no_file_larger_than(room):
        command = ("train", tmp_path / "d", "--policy", "dp3", "--out", tmp_path / "run", *SMALL, "--json")
        code, out, err = call_cli(capsys, *command)
    assert (code, out) == (3, "")
    assert re.search(r"cannot be written \(.*File too large", err)
    assert err.count("\n") == 1
    assert leftovers(tmp_path) == []


@pytest.mark.parametrize("rate", ["1e30", "1e39"])
def test_a_loss_that_is_no_number_ends_a_run(rate: str, rolls: Path, tmp_path: Path, capsys: Capture) -> None:
    """Before the weights of such a step are kept: also if they are spoilt at a checkpoint while the loss is fine."""
    small = [*SMALL, *options("run.checkpoints=20", "optimizer.warmup_steps=0", f"optimizer.learning_rate={rate}")]
    code, out, err = call_cli(capsys, "train", rolls, "--policy", "fdp", "--out", tmp_path / "run", *small, "--json")
    assert (code, out) == (1, "")
    assert re.fullmatch(
        rf"flowlab: {tmp_path / 'run'}: (the loss is (nan|inf)|a weight is no longer finite) at step \d+; the last "
        r"checkpoint is whole\. Lower optimizer\.learning_rate and start anew, or look at the data with 'flowlab "
        r"validate'\n",
        err,
    )
    (step,) = re.findall(r"at step (\d+);", err)
    kept = sorted((tmp_path / "run").rglob("*.safetensors"))
    assert len(kept) == 1 + int(step) - (rate == "1e39")
    for file in kept:
        assert all(t.isfinite().all() for t in load_file(file).values())
