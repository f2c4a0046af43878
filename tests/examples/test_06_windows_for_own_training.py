"""Example 6 trains with a loop of its own."""

import re
from pathlib import Path

from run_example import run_example


def test_a_loop_of_ones_own_learns(small_dataset: Path) -> None:
    output = run_example("06_windows_for_own_training.py", small_dataset)
    losses = [float(x) for x in re.findall(r"epoch \d: loss (\d\.\d{3})", output)]
    assert len(losses) == 3
    assert losses[-1] < losses[0]
    assert re.search(r"mean absolute error of the actions of an episode that was not trained on: 0\.\d{3}", output)
