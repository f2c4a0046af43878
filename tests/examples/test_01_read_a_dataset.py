"""Example 1 reads a dataset, and says what is in it."""

import re
from pathlib import Path

from run_example import run_example


def test_every_episode_is_told(small_dataset: Path) -> None:
    output = run_example("01_read_a_dataset.py", small_dataset)
    assert len(re.findall(r"(?m)^(drawer-open|push-back) seed \d+: \d+ steps, 100 query points", output)) == 6
    paths = [float(m) for m in re.findall(r"on the object travel (\d\.\d\d) m", output)]
    assert min(paths[:3]) > 0.1, "drawers are opened by more than 10 cm"
    nearest = re.search(r"is (\d+) mm from the hand", output)
    assert nearest, output
    assert int(nearest[1]) < 60, "the cloud and the state have one frame"
