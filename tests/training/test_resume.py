"""However a run ends, it goes on as if it had never stopped; the same seed gives the same weights to the last bit."""

import json
import os
import random
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save_file
from synthetic import call_cli, files_below, make_dataset, make_episode
from trained_runs import (
    SMALL,
    leftovers,
    lines_of,
    make_rolls,
    make_run,
    options,
    saved_by,
    small_settings,
    step_in,
    train,
    weights_of,
    without_times,
)

from flowlab.policies.profiles import load_settings
from flowlab.policies.trained import RESUME
from flowlab.training import run as training_run
from flowlab.training.resume import resume_run

Capture = pytest.CaptureFixture[str]
STEPS = 130
LONG = [*SMALL, *options(f"run.steps={STEPS}", "run.checkpoints=14", "run.validations=2"), "--device", "cpu"]
"""A second or more; no checkpoint but the last falls on a line of metrics."""


@pytest.fixture(scope="module")
def rolls(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_rolls(tmp_path_factory.mktemp("data") / "rolls")


@pytest.fixture(scope="module", params=[["--precision", "fp32"], []], ids=["fp32", "as it comes"])
def precision(request: pytest.FixtureRequest) -> list[str]:
    return list(request.param)


@pytest.fixture(scope="module")
def unbroken(rolls: Path, precision: list[str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that nobody disturbed."""
    out = tmp_path_factory.mktemp("unbroken") / "run"
    return make_run(rolls, "--policy", "fdp", "--out", out, *LONG, *precision)


def start(*arguments: str | Path) -> subprocess.Popen[str]:
    """``flowlab train`` in a process of its own, which heeds Ctrl-C wherever the tests run."""
    command = [sys.executable, "-c", AS_IN_A_TERMINAL, "train", *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


AS_IN_A_TERMINAL = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
from flowlab.cli import main
main(*sys.argv[1:])
"""
"""A shell starts what runs in its background with Ctrl-C ignored."""


def wait_until(condition: Callable[[], bool], running: subprocess.Popen[str], seconds: float = 120) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert running.poll() is None, running.communicate()
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.005)


def interrupt(run: Path, number: signal.Signals, command: list[str | Path], wait_s: float) -> tuple[int, str]:
    """Start a run, send it a signal some time after its first checkpoint; its exit code and output."""
    process = start(*command)
    try:
        wait_until(lambda: any(run.glob("checkpoints/step-*.safetensors")), process)
        time.sleep(wait_s)
        process.send_signal(number)
        out, _ = process.communicate(timeout=60)
    finally:
        process.kill()
        process.wait()
    return process.returncode, out


def check_same(resumed: Path, unbroken: Path) -> None:
    """All weights to the last bit, and all that was measured."""
    assert saved_by(resumed) == saved_by(unbroken)
    assert without_times(lines_of(resumed)) == without_times(lines_of(unbroken))
    assert (resumed / "policy.json").read_bytes() == (unbroken / "policy.json").read_bytes()
    assert leftovers(resumed) == []


@pytest.mark.parametrize(
    "number",
    [signal.SIGKILL, signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)],  # handled as SIGINT is
    ids=lambda n: n.name,
)
def test_a_run_goes_on_as_if_it_had_never_stopped(
    number: signal.Signals, rolls: Path, precision: list[str], unbroken: Path, tmp_path: Path, capsys: Capture
) -> None:
    if (number == signal.SIGKILL) != bool(precision):
        pytest.skip("each once is enough")
    for attempt, wait_s in enumerate((random.uniform(0, 0.3), 0.05, 0, 0)):
        run = tmp_path / f"run-{attempt}"
        code, out = interrupt(run, number, [rolls, "--policy", "fdp", "--out", run, *LONG, *precision], wait_s)
        if code:  # else it was over before the signal
            break
    assert code == (-signal.SIGKILL if number == signal.SIGKILL else 130), f"after {wait_s:.2f} s"
    step = step_in(run / "resume.safetensors")
    assert step < STEPS  # 0 where the first checkpoint is there, and what resuming needs not yet
    if number != signal.SIGKILL:
        assert out.splitlines()[-1] == f"stopped at step {step} of {STEPS}; go on with: flowlab train {run} --resume"
    said = train(capsys, run, "--resume")
    assert said.splitlines()[-1] == f"{run}: trained for {STEPS} steps; the curve is {run / 'curve.png'}"
    check_same(run, unbroken)


def stop_after(steps: int) -> Callable[[], bool]:
    """Asks to stop after so many steps."""
    calls = iter(range(1, 1000))
    return lambda: next(calls) == steps


VARIANTS = {
    "dp3": ("dp3", SMALL[1], ()),
    "mba": ("mba", SMALL[1], ()),
    "fdp as in the paper": (
        "fdp", "paper",
        ("encoder.points=64", "motion.points=8", "action.widths=[8,16]", "motion.denoiser.widths=[8,16]",
         "batch.windows=16", "encoder.widths=[16,16]"),
    ),
    "fdp, one step": ("fdp", SMALL[1], ("motion.condition=one-step", "encoder.subset=32", "motion.subset=4")),
}  # fmt: skip


@pytest.mark.parametrize(
    "variant", [pytest.param(v, marks=pytest.mark.slow) if v == "fdp as in the paper" else v for v in VARIANTS]
)  # 12 s
def test_wherever_a_run_stops_nothing_is_lost(variant: str, rolls: Path, tmp_path: Path) -> None:
    """Of each kind of policy: at the first step, and off every line and checkpoint. Resumed twice in between."""
    policy, profile, changes = VARIANTS[variant]
    settings = load_settings(profile, policy, [*changes, "run.minutes=null", "run.steps=30"])
    machine = training_run.ComputeSettings(device="cpu")
    for name in ("unbroken", "broken"):
        trainer = training_run.prepare_run(rolls, tmp_path / name, settings, machine)
        if name == "broken":
            for steps in (1, 7, 12):
                assert not training_run.run(trainer, lambda _: None, stop_after(steps))
                trainer = resume_run(tmp_path / name)
            assert trainer.step == 20
        assert training_run.run(trainer, lambda _: None)
    check_same(tmp_path / "broken", tmp_path / "unbroken")


def test_a_run_that_dies_at_once_can_be_resumed(rolls: Path, tmp_path: Path, capsys: Capture) -> None:
    """Before its first step, say while another program is asked to log."""
    settings = small_settings("dp3")
    training_run.prepare_run(rolls, tmp_path / "died", settings, training_run.ComputeSettings(device="cpu"))
    train(capsys, tmp_path / "died", "--resume")
    train(capsys, rolls, "--policy", "dp3", "--out", tmp_path / "whole", *SMALL, "--device", "cpu")
    check_same(tmp_path / "died", tmp_path / "whole")


BEGUN = ("resume.safetensors", "run.json", "policy.json")
"""The files of a run that begins, in the order in which they appear."""


@pytest.mark.parametrize("there", [(), BEGUN[:1], BEGUN[:2], BEGUN[1:], BEGUN[2:], BEGUN], ids="+".join)
def test_whatever_a_kill_leaves_of_a_beginning_goes_on_by_the_same_command(
    there: tuple[str, ...], rolls: Path, tmp_path: Path, capsys: Capture
) -> None:
    """Of earlier versions, too, which wrote the resume file last; and nothing of a dead process is left."""
    command = (rolls, "--policy", "dp3", *SMALL, "--device", "cpu", "--out")
    run = tmp_path / "killed"
    settings = small_settings("dp3", "run.seed=7")  # of another try: what is left of it is not built upon
    training_run.prepare_run(rolls, run, settings, training_run.ComputeSettings(device="cpu"))
    for name in set(BEGUN) - set(there):
        (run / name).unlink()
    leftover = run / f".tmp-{socket.gethostname()}+999999999+{RESUME}"
    leftover.write_bytes(b"half")
    if there == BEGUN:
        code, out, err = call_cli(capsys, "train", *command, run)
        assert (code, out) == (2, "")
        assert f"{run}: holds a run already, which began in another way; choose another --out" in err
        assert "settings.run.seed: the run has 7, this command has 0" in err
        command = (*command[:-1], "--set", "run.seed=7", "--out")
    else:
        code, _, err = call_cli(capsys, "train", run, "--resume")
        assert code == 3
        assert err.count("\n") == 1
    train(capsys, *command, run)
    train(capsys, *command, tmp_path / "whole")
    check_same(run, tmp_path / "whole")
    before = files_below(run)
    train(capsys, *command, run)
    after = files_below(run)
    kept = [name for name in before if name not in ("curve.png", "metrics.jsonl")]
    assert {n: after[n] for n in kept if "resume" not in n} == {n: before[n] for n in kept if "resume" not in n}


def test_the_same_command_goes_on_where_a_run_stopped(rolls: Path, tmp_path: Path, capsys: Capture) -> None:
    run = stopped(rolls, tmp_path / "run")
    command = (rolls, "--policy", "dp3", *SMALL, "--device", "cpu", "--out")
    code, _, err = call_cli(capsys, "train", *command, run)
    assert code == 0
    assert f"{run}: goes on after step 9 of 20" in err
    train(capsys, *command, tmp_path / "whole")
    check_same(run, tmp_path / "whole")
    for other, said in (("--overfit", "run.overfit"), ("--from", "run.from")):
        value = "1" if other == "--overfit" else str(tmp_path / "whole")
        code, _, err = call_cli(capsys, "train", *command, run, other, value)
        assert code == 2
        assert said in err


def test_ctrl_c_before_there_is_anything_to_draw(rolls: Path, tmp_path: Path, capsys: Capture) -> None:
    """No line of metrics, no checkpoint: it stops as cleanly as later."""

    def interrupt_soon() -> None:
        while not (tmp_path / "run/metrics.jsonl").exists():
            time.sleep(0.001)
        os.kill(os.getpid(), signal.SIGINT)

    slow = options("run.checkpoints=1", "run.validations=0", "run.steps=5000", "batch.windows=256")
    user = threading.Thread(target=interrupt_soon, daemon=True)
    user.start()
    command = ("train", rolls, "--policy", "dp3", "--out", tmp_path / "run", *SMALL, *slow, "--json")
    code, out, err = call_cli(capsys, *command)
    user.join()
    assert (code, err) == (130, "")
    report = json.loads(out)
    assert (report["finished"], report["training"], report["validation"]) == (False, {}, {})
    assert 0 < report["step"] < 50
    assert step_in(tmp_path / "run/resume.safetensors") == report["step"]


def test_a_finished_run_stays_as_it_is(rolls: Path, tmp_path: Path, capsys: Capture) -> None:
    train(capsys, rolls, "--policy", "dp3", "--out", tmp_path / "run", *SMALL)
    before, lines = saved_by(tmp_path / "run"), lines_of(tmp_path / "run")
    assert "trained for 20 steps" in train(capsys, tmp_path / "run", "--resume")
    assert (saved_by(tmp_path / "run"), lines_of(tmp_path / "run")) == (before, lines)


def test_the_same_seed_gives_the_same_weights(rolls: Path, tmp_path: Path, capsys: Capture) -> None:
    short = (rolls, "--policy", "fdp", *SMALL, *options("run.steps=8", "run.checkpoints=2"))
    for name, seed in (("a", 3), ("b", 3), ("c", 4)):
        train(capsys, *short, "--out", tmp_path / name, "--seed", str(seed))
    assert saved_by(tmp_path / "a") == saved_by(tmp_path / "b")
    assert without_times(lines_of(tmp_path / "a")) == without_times(lines_of(tmp_path / "b"))
    for name, seed in (("d", 5), ("e", 6)):  # what is drawn on the way differs too
        train(capsys, *short, "--out", tmp_path / name, "--seed", str(seed), "--from", tmp_path / "a")
    for one, other in ("ac", "de"):
        mine, theirs = weights_of(tmp_path / one, 8), weights_of(tmp_path / other, 8)
        matrices = [name for name in mine if mine[name].ndim > 1]
        assert matrices
        assert all(not np.array_equal(mine[name], theirs[name]) for name in matrices)


def stopped(rolls: Path, run: Path) -> Path:
    """A run that was stopped at step 9 of 20."""
    settings = small_settings("dp3")
    trainer = training_run.prepare_run(rolls, run, settings, training_run.ComputeSettings(device="cpu"))
    assert not training_run.run(trainer, lambda _: None, stop_after(9))
    return run


def test_other_data_are_refused(tmp_path: Path, capsys: Capture) -> None:
    rolls = make_rolls(tmp_path / "d")
    run = stopped(rolls, tmp_path / "run")
    make_dataset(rolls, [[make_episode(k, steps=20) for k in (7, 8)]])  # two more
    before = files_below(run)
    code, out, err = call_cli(capsys, "train", run, "--resume")
    assert (code, out) == (3, "")
    assert re.fullmatch(
        rf"flowlab: {run}: began with content \w{{16}} of {rolls}, now \w{{16}}; restore the dataset, or start a new "
        r"run\n",
        err,
    )
    rolls.rename(tmp_path / "moved")
    code, out, err = call_cli(capsys, "train", run, "--resume")
    assert (code, out) == (3, "")
    assert f"{run}: its dataset is no longer at {rolls}; restore it, or change 'dataset' in {run / 'run.json'}" in err
    assert files_below(run) == before


def test_where_the_dataset_is_may_be_changed(tmp_path: Path, capsys: Capture) -> None:
    """It is the only thing in a run that may; its content is checked."""
    rolls = make_rolls(tmp_path / "d")
    run = stopped(rolls, tmp_path / "run")
    rolls.rename(tmp_path / "moved")
    plan = run / "run.json"
    plan.write_text(plan.read_text().replace(str(rolls), str(tmp_path / "moved")))
    assert "trained for 20 steps" in train(capsys, run, "--resume")
    plan.write_text(plan.read_text().replace('"steps": 20', '"steps": 21'))
    code, out, err = call_cli(capsys, "train", run, "--resume")
    assert (code, out) == (3, "")
    assert err.startswith(f"flowlab: {plan}: damaged (its content does not match its checksum); ")


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-7])


def swap_numbers(path: Path) -> None:
    save_file({"policy:some": np.zeros(3)}, path, {"step": "9"})


def forget_the_step(path: Path) -> None:
    save_file({"policy:some": np.zeros(3)}, path)


@pytest.mark.parametrize(
    ("name", "damage", "sentence"),
    [
        ("resume.safetensors", cut, "damaged"),
        ("resume.safetensors", lambda p: p.write_bytes(b""), "damaged"),
        ("resume.safetensors", swap_numbers, "does not fit its policy.json"),
        ("resume.safetensors", forget_the_step, "it does not tell its step"),
        ("resume.safetensors", os.unlink, "nothing to resume (it has no resume.safetensors); start anew, into"),
        ("run.json", lambda p: p.write_text("{"), "run.json: not valid JSON"),
        ("run.json", lambda p: p.write_text('{"steps": 3}'), "run.json: dataset: Field required"),
        ("run.json", os.unlink, "no run to resume (it has no run.json)"),
        ("policy.json", os.unlink, "not a training run (it has no policy.json)"),
        ("policy.json", cut, "policy.json: not valid JSON"),
    ],
)
def test_what_is_damaged_is_said_in_one_sentence(
    name: str, damage: Callable[[Path], None], sentence: str, rolls: Path, tmp_path: Path, capsys: Capture
) -> None:
    run = stopped(rolls, tmp_path / "run")
    damage(run / name)
    before = files_below(run)
    code, out, err = call_cli(capsys, "train", run, "--resume")
    assert (code, out) == (3, "")
    assert err.startswith(f"flowlab: {run}")
    assert sentence in err
    assert err.count("\n") == 1
    assert files_below(run) == before


@pytest.mark.parametrize("harm", ["gone", "cut"])
def test_lines_of_metrics_that_are_lost_are_told(
    harm: str, rolls: Path, tmp_path: Path, capsys: Capture, caplog: pytest.LogCaptureFixture
) -> None:
    run = stopped(rolls, tmp_path / "run")
    metrics = run / "metrics.jsonl"
    lines = metrics.read_bytes().splitlines(keepends=True)
    assert lines
    metrics.unlink() if harm == "gone" else metrics.write_bytes(b"".join(lines)[:-30])
    assert call_cli(capsys, "validate", run)[0] == 3
    assert call_cli(capsys, "train", run, "--resume")[0] == 0
    assert f"of {len(lines)} lines up to step" in caplog.text
