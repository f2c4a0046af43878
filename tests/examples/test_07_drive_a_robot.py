"""Example 7 lets a policy drive an arm, and plans when a plan is due."""

import re
from pathlib import Path

import pytest
from run_example import run_example
from trained_runs import SMALL, make_run


@pytest.fixture(scope="module")
def run(small_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A policy that was hardly trained, on drawers alone."""
    out = tmp_path_factory.mktemp("runs") / "drawers"
    return make_run(small_dataset, "--policy", "fdp", *SMALL, "--out", out)


def test_it_plans_every_fourth_step_and_tells_the_outcome(run: Path) -> None:
    output = run_example("07_drive_a_robot.py", run, "drawer-open")
    planned = [int(step) for step in re.findall(r"step (\d+): a new plan", output)]
    assert planned == list(range(0, 200, 4))[: len(planned)]
    assert len(planned) > 1
    assert re.search(r"drawer-open: (not )?solved after \d+ steps", output)
