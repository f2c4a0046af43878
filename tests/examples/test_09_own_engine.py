"""Example 9 makes the dataset that the processes of this machine make."""

from pathlib import Path

from run_example import run_example

import flowlab


def test_it_makes_the_same_dataset(tmp_path: Path) -> None:
    assert "push" in run_example("09_own_engine.py", tmp_path / "serial")
    local = flowlab.extract("push", tmp_path / "local", episodes=1, workers=1)
    assert flowlab.open_dataset(tmp_path / "serial").fingerprint == local.fingerprint
