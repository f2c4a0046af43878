"""Extraction as a user runs it: the same dataset however it comes about, and a whole one whatever happens."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from conftest import Cli

from flowlab.storage.dataset import Dataset

TASKS = ("drawer-open", "push-back")  # push-back's expert fails for about half of the seeds
EPISODES = 3


def content(folder: Path) -> dict[str, bytes]:
    """Every file of a dataset that must not depend on how it came about."""
    files = [*folder.glob("shards/**/*"), folder / "flowlab.json", folder / "stats.json", folder / "rejects.jsonl"]
    return {str(f.relative_to(folder)): f.read_bytes() for f in files if f.is_file()}


def extract(flowlab: Cli, out: Path, *more: object) -> subprocess.CompletedProcess[str]:
    return flowlab("extract-sim", *TASKS, "--episodes", EPISODES, "--out", out, *more)


def start(out: Path, workers: int = 2) -> subprocess.Popen[str]:
    """The same extraction in a process group of its own, to be interrupted."""
    command = [sys.executable, "-m", "flowlab", "extract-sim", *TASKS, "--episodes", str(EPISODES), "--out", str(out)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    # Jobs in the background of a shell inherit that Ctrl-C is ignored.
    unignored = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    return subprocess.Popen(  # type: ignore[call-overload,no-any-return]
        [*command, "--workers", str(workers)], text=True, start_new_session=True, preexec_fn=unignored, **pipes
    )


def wait_until(condition: Callable[[], bool], seconds: float = 120) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)


@pytest.mark.slow  # recordings do the same in tests/cli/test_cli_track_real.py
def test_one_worker_gives_the_same_files_as_two(flowlab: Cli, small_dataset: Path, tmp_path: Path) -> None:
    extract(flowlab, tmp_path / "one", "--workers", 1)
    assert content(tmp_path / "one") == content(small_dataset)


def test_episodes_are_the_first_successful_seeds_in_order(small_dataset: Path) -> None:
    dataset = Dataset(small_dataset)
    tried = {task: sorted(s for r in dataset.receipts if r.task == task for s in r.seeds) for task in TASKS}
    rejected = {(x.task, x.seed) for r in dataset.receipts for x in r.rejects}
    for task in TASKS:
        accepted = [ref.seed for ref in dataset.refs if ref.task == task]
        assert tried[task] == list(range(max(accepted) + 1)), "no seed beyond the last accepted one"
        assert accepted == [s for s in tried[task] if (task, s) not in rejected]
        assert len(accepted) == EPISODES
    assert any(task == "push-back" for task, _ in rejected), "the task was chosen because its expert fails"
    lines = [json.loads(line) for line in (small_dataset / "rejects.jsonl").read_text().splitlines()]
    assert {(x["task"], x["seed"]) for x in lines} == rejected
    assert all(x["reason"].startswith("solved for") for x in lines)


@pytest.mark.parametrize("moments", [(1,), pytest.param((1, 3), marks=pytest.mark.slow)], ids=str)
def test_killed_at_any_moment_it_opens_and_the_same_command_finishes_it(
    moments: tuple[int, ...], flowlab: Cli, small_dataset: Path, tmp_path: Path
) -> None:
    out = tmp_path / "killed"
    for receipts_before_kill in moments:
        run = start(out)
        wait_until(lambda n=receipts_before_kill: len(list(out.glob("receipts/*.json"))) >= n)
        os.kill(run.pid, signal.SIGKILL)
        run.wait()
        whole = Dataset(out)
        for k in range(len(whole)):
            assert np.abs(whole.episode(k).point_cloud).max(axis=(1, 2)).min() > 0, "no frame is silently zero"
        assert flowlab("validate", out).returncode == 3, "unfinished is a finding"
    wait_until(lambda: not workers_of(run.pid))
    assert extract(flowlab, out).returncode == 0
    assert content(out) == content(small_dataset)
    assert not list(out.glob("shards/.tmp*"))


def workers_of(pid: int) -> list[str]:
    """Processes still running in the group of a killed run."""
    found = subprocess.run(["ps", "-o", "pid=", "-g", str(pid)], capture_output=True, text=True, check=False)
    return found.stdout.split()


def test_ctrl_c_ends_cleanly_and_resumably(flowlab: Cli, small_dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "interrupted"
    run = start(out)
    wait_until(lambda: len(list(out.glob("receipts/*.json"))) >= 1)
    os.killpg(run.pid, signal.SIGINT)
    _, errors = run.communicate(timeout=60)
    assert run.returncode == 130
    assert "the same command does the rest" in errors
    assert "Traceback" not in errors
    wait_until(lambda: not workers_of(run.pid), seconds=10)
    assert extract(flowlab, out).returncode == 0
    assert content(out) == content(small_dataset)


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 1.5 MB."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=1500k", "tmpfs", str(disk)]
    if shutil.which("mount") is None or subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("mounting a small disk needs root")
    yield disk
    subprocess.run(["umount", str(disk)], check=False)


def test_a_full_disk_is_one_sentence_and_the_rest_is_done_later(
    flowlab: Cli, small_dataset: Path, small_disk: Path
) -> None:
    out = small_disk / "data"
    result = extract(flowlab, out, "--workers", 1)
    assert result.returncode == 1
    assert "no space is left" in result.stderr
    assert "Traceback" not in result.stderr
    assert len(Dataset(out)) < 2 * EPISODES
    subprocess.run(["mount", "-o", "remount,size=100m", str(small_disk)], check=True)
    assert extract(flowlab, out).returncode == 0
    assert content(out) == content(small_dataset)


def test_shards_of_a_job_array_fill_one_dataset_together(flowlab: Cli, small_dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "array"
    first = extract(flowlab, out, "--shard", "0/2", "--json")
    assert json.loads(first.stdout)["missing"], "half of the work is the other job's"
    second = extract(flowlab, out, "--shard", "1/2", "--json")
    assert not json.loads(second.stdout)["missing"], "the last job makes good what failed"
    assert content(out) == content(small_dataset)


def test_a_worker_stays_below_400_mb(small_dataset: Path) -> None:
    assert 100 < max(r.peak_memory_mb for r in Dataset(small_dataset).receipts) < 400
