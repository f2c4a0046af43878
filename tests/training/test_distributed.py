"""Several processes under torchrun train what one does."""

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from synthetic import files_below
from trained_runs import (
    SMALL,
    leftovers,
    lines_of,
    make_rolls,
    make_run,
    options,
    policy_of,
    weights_of,
    without_times,
)

EXACT = ("--device", "cpu", "--precision", "fp32", "--threads", "1")
CLOSE = 3e-5
"""Weights move by 2e-3 and more in 20 steps; what is summed in another order differs by some 5e-6 after them, since
AdamW makes even the smallest gradient a step of full size."""


def torchrun(*arguments: str | Path, count: int = 2) -> subprocess.CompletedProcess[str]:
    """``flowlab train`` in processes that share every batch."""
    launch = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(count)]
    command = [*launch, "-m", "flowlab", "train", *map(str, arguments)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    return subprocess.run(command, capture_output=True, text=True, timeout=300, check=False, env=environment)


@pytest.fixture(scope="module")
def rolls(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_rolls(tmp_path_factory.mktemp("data") / "rolls")


def check_close(mine: Path, theirs: Path, steps: Sequence[int], before: Path) -> None:
    """Weights are within rounding of each other, and far from those that a run began with."""
    for step in steps:
        a, b, begun = weights_of(mine, step), weights_of(theirs, step), weights_of(before, 1)
        assert a.keys() == b.keys()
        assert max(abs(a[name] - b[name]).max() for name in a) < CLOSE
        assert max(abs(a[name] - begun[name]).max() for name in a) > 10 * CLOSE


@pytest.mark.parametrize("policy", ["fdp", pytest.param("dp3", marks=pytest.mark.slow)])
def test_two_processes_train_what_one_does(policy: str, rolls: Path, tmp_path: Path) -> None:
    """With everything that is drawn at random: noise, shifts, and points and queries left out."""
    queries = ["motion.subset=4"] if policy == "fdp" else []
    drawn = options("encoder.subset=32", *queries, "batch.shift_m=0.1")
    command = (rolls, "--policy", policy, *SMALL, *drawn, *EXACT)
    one = make_run(*command, "--out", tmp_path / "one")
    still = options("run.steps=1", "run.checkpoints=1", "optimizer.learning_rate=1e-12")
    begun = make_run(*command, *still, "--out", tmp_path / "begun")
    result = torchrun(*command, "--out", tmp_path / "two")
    assert result.returncode == 0, result.stderr
    assert "2 processes on cpu, fp32" in result.stderr
    assert "Warning" not in result.stderr
    assert result.stdout.count("trained for 20 steps") == 1, "only the first process says so"
    check_close(tmp_path / "two", one, (4, 20), begun)
    assert policy_of(tmp_path / "two") == policy_of(one)
    assert sorted(files_below(tmp_path / "two")) == sorted(files_below(one))
    assert leftovers(tmp_path) == []
    for mine, theirs in zip(without_times(lines_of(tmp_path / "two")), without_times(lines_of(one)), strict=True):
        assert mine.keys() == theirs.keys()
        for name in mine.keys() - {"kind"}:
            np.testing.assert_allclose(mine[name], theirs[name], rtol=1e-3, atol=1e-4)


@pytest.mark.slow
def test_a_batch_that_cannot_be_shared_is_refused(rolls: Path, tmp_path: Path) -> None:
    before = files_below(tmp_path)
    odd = options("batch.windows=15", "batch.segment=5")
    result = torchrun(rolls, "--policy", "dp3", "--out", tmp_path / "run", *SMALL, *odd, *EXACT)
    assert result.returncode != 0
    assert "flowlab: batch.windows is 15, which 2 processes cannot share evenly\n" in result.stderr
    assert 'File "' + str(Path(__file__).parents[2] / "flowlab") not in result.stderr, "no traceback of ours"
    assert files_below(tmp_path) == before
