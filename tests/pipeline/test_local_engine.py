"""Real worker processes that die, fail and are orphaned."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

import flowlab
from flowlab.engines.base import UnitResult
from flowlab.engines.local import LocalEngine
from flowlab.errors import DataError
from flowlab.pipeline.units import WorkUnit
from flowlab.storage.receipts import Receipt

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "LP_NUM_THREADS")
UNLUCKY = 1
"""The unit things happen to."""


def work(folder: Path, accident: Callable[[int], None], unit: WorkUnit) -> Receipt:
    """Leave a note with the worker's pid at each try; then have an accident, or hand in a receipt."""
    (seed,) = unit.seeds
    tries = len(list(folder.glob(f"{seed}-*")))
    (folder / f"{seed}-{tries}").write_text(str(os.getpid()))
    if seed == UNLUCKY:
        accident(tries)
    return Receipt(unit=unit.name, task=unit.task, seeds=unit.seeds, accepted=(), frames=(), digests=())


def killed_once(tries: int) -> None:
    if tries == 0:
        os.kill(os.getpid(), signal.SIGKILL)


def exits_once(tries: int) -> None:
    if tries == 0:
        os._exit(3)


def killed_always(tries: int) -> None:
    if tries < 5:  # or an engine that never gives up would never end
        os.kill(os.getpid(), signal.SIGKILL)


def wrong(tries: int) -> None:
    raise ValueError("the tide is too high")


def disk_full(tries: int) -> None:
    raise OSError(28, "No space left on device")


def wrong_data(tries: int) -> None:
    raise DataError("d/shards: not as it should be")


def run(folder: Path, accident: Callable[[int], None], units: int = 3) -> dict[int, UnitResult]:
    """Do the units with two workers; outcomes by seed."""
    with LocalEngine(partial(work, folder, accident), workers=2) as engine:
        for seed in range(units):
            engine.submit(WorkUnit(task="roll", seeds=(seed,)))
        outcomes = [engine.next_result() for _ in range(units)]
    return {o.unit.seeds[0]: o for o in outcomes}


def notes(folder: Path) -> dict[str, int]:
    return {p.name: int(p.read_text()) for p in folder.iterdir()}


@pytest.mark.parametrize("accident", [killed_once, exits_once])
def test_a_worker_that_dies_costs_one_more_try(tmp_path: Path, accident: Callable[[int], None]) -> None:
    outcomes = run(tmp_path, accident)
    assert {seed: o.receipt is not None for seed, o in outcomes.items()} == {0: True, 1: True, 2: True}
    assert [o.receipt.seeds for o in outcomes.values() if o.receipt] == [(seed,) for seed in outcomes]
    tried = notes(tmp_path)
    assert tried.keys() == {"0-0", "1-0", "1-1", "2-0"}
    assert tried["1-0"] != tried["1-1"], "tried again in the same process"


def test_a_unit_whose_workers_always_die_fails_alone(tmp_path: Path) -> None:
    outcomes = run(tmp_path, killed_always)
    assert outcomes[UNLUCKY].receipt is None
    assert "died twice" in outcomes[UNLUCKY].failure
    assert outcomes[0].receipt
    assert outcomes[2].receipt
    assert notes(tmp_path).keys() == {"0-0", "1-0", "1-1", "2-0"}


def test_an_exception_comes_back_as_a_traceback_and_is_not_tried_again(tmp_path: Path) -> None:
    outcomes = run(tmp_path, wrong)
    assert outcomes[UNLUCKY].receipt is None
    assert outcomes[UNLUCKY].failure.strip().endswith("ValueError: the tide is too high")
    assert "in wrong" in outcomes[UNLUCKY].failure, "the traceback does not reach into the worker"
    assert outcomes[0].receipt
    assert outcomes[2].receipt
    assert notes(tmp_path).keys() == {"0-0", "1-0", "2-0"}


@pytest.mark.parametrize(("accident", "error"), [(disk_full, OSError), (wrong_data, DataError)])
def test_errors_that_make_going_on_useless_are_raised(
    tmp_path: Path, accident: Callable[[int], None], error: type[Exception]
) -> None:
    with pytest.raises(error) as raised:
        run(tmp_path, accident)
    assert type(raised.value) is error
    assert getattr(raised.value, "errno", 28) == 28


def sleep_beside_the_parent(folder: Path, unit: WorkUnit) -> Receipt:
    (folder / f"worker-{unit.seeds[0]}").write_text(json.dumps([os.getpid(), {n: os.environ.get(n) for n in THREADS}]))
    time.sleep(300)
    raise AssertionError


def hold_two_workers(folder: Path) -> None:
    """What the parent of the next test runs."""
    with LocalEngine(partial(sleep_beside_the_parent, folder), workers=2) as engine:
        for seed in range(2):
            engine.submit(WorkUnit(task="roll", seeds=(seed,)))
        engine.next_result()


def alive(pid: int) -> bool:
    """Whether a process runs; one that ended but that nobody has asked about does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def wait_for(condition: Callable[[], bool], seconds: float) -> bool:
    end = time.monotonic() + seconds
    while not condition() and time.monotonic() < end:
        time.sleep(0.05)
    return condition()


def test_workers_are_single_threaded_and_do_not_outlive_their_parent(tmp_path: Path) -> None:
    code = "import test_local_engine, pathlib, sys; test_local_engine.hold_two_workers(pathlib.Path(sys.argv[1]))"
    environment = {k: v for k, v in os.environ.items() if k not in THREADS}
    environment["PYTHONPATH"] = os.pathsep.join([str(Path(__file__).parent), *filter(None, sys.path)])
    parent = subprocess.Popen([sys.executable, "-c", code, tmp_path], env=environment)
    files = [tmp_path / "worker-0", tmp_path / "worker-1"]
    try:
        assert wait_for(lambda: all(f.exists() and f.read_text() for f in files), 60), "the workers never started"
        workers = [json.loads(f.read_text()) for f in files]
        assert all(alive(pid) for pid, _ in workers)
        assert [threads for _, threads in workers] == [dict.fromkeys(THREADS, "1")] * 2
    finally:
        parent.kill()
        parent.wait()
    assert wait_for(lambda: not any(alive(pid) for pid, _ in workers), 10), "orphans are left"


@pytest.mark.parametrize("from_stdin", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_script_without_a_guard_runs_once(from_stdin: bool, tmp_path: Path) -> None:
    """Workers import what they work with, and not the program that asked for it, which may have no file."""
    script = tmp_path / "script" / "main.py"
    script.parent.mkdir()
    script.write_text(
        "import sys, pathlib, flowlab\n"
        "with open(sys.argv[1], 'a') as log:\n"
        "    log.write('ran ')\n"
        "few = ['observer.points=64']\n"
        "dataset = flowlab.extract('drawer-open', sys.argv[2], episodes=1, settings=few, workers=1)\n"
        "print(len(dataset))\n"
    )
    log = tmp_path / "log"
    command = [sys.executable, "-" if from_stdin else script, log, tmp_path / "data"]
    done = subprocess.run(
        command, input=script.read_text(), capture_output=True, text=True, timeout=120, check=False, cwd=tmp_path
    )
    assert (done.returncode, done.stdout, log.read_text()) == (0, "1\n", "ran "), done.stderr[-500:]


def test_nothing_in_the_current_folder_is_run(tmp_path: Path) -> None:
    """Somebody works in a folder of downloaded files; the console script does not look there, nor do its workers."""
    for name in ("json", "yaml", "numpy", "queue"):
        (tmp_path / f"{name}.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'a').write({name!r})\n")
    script = tmp_path / "bin" / "flowlab"
    script.parent.mkdir()
    script.write_text("import sys\nfrom flowlab.cli import main\nmain()\n")
    arguments = ["extract-sim", "reach", "--episodes", "1", "--workers", "1", "--out", tmp_path / "data"]
    environment = {**os.environ, "PYTHONPATH": str(Path(flowlab.__file__).parents[1])}
    done = subprocess.run(
        [sys.executable, script, *arguments], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert not (tmp_path / "ran").exists(), (tmp_path / "ran").read_text()
