"""The programs of the reference run, one after the other, as they are shown: only smaller."""

import re
import subprocess
import sys
from pathlib import Path

from real_recordings import write_folder
from synthetic import make_dataset, make_episode
from test_docs import ROOT, blocks
from trained_runs import NETWORK

SMALLER = {
    "minutes=5": f"profile={str(NETWORK)!r}, settings=['run.minutes=null', 'run.steps=4', 'run.checkpoints=1']",
    "seeds=(0, 1, 2), episodes=20": "seeds=(0,), episodes=1, workers=1",
    "episodes=5": "episodes=3, workers=1",
    'tracker="lucas-kanade"': 'tracker="lucas-kanade", workers=1',
}
"""What makes the same program take seconds."""


def test_the_programs_of_the_reference_run(tmp_path: Path) -> None:
    write_folder(tmp_path / "recordings" / "pour" / "take-1")
    program = "\n".join(blocks(ROOT / "docs" / "reference.md", "python"))
    for shown, smaller in SMALLER.items():
        assert shown in program
        program = program.replace(shown, smaller)
    guarded = "if __name__ == '__main__':\n" + "\n".join(f"    {line}" for line in program.splitlines())
    (tmp_path / "program.py").write_text(guarded)
    done = subprocess.run(
        [sys.executable, "program.py"], cwd=tmp_path, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr
    assert re.search(r"(?m)^\d of 1 solved$", done.stdout)


def test_the_loops_on_pictures(tmp_path: Path) -> None:
    for name, first in (("push-rgb", 0), ("push-more", 50)):
        made = [make_episode(first + k, task="push", steps=40, depth=True, rgb=True) for k in range(2)]
        make_dataset(tmp_path / "data" / name, [made])
    page = (ROOT / "docs" / "training.md").read_text()
    programs = re.findall(r"<!-- tested: (\w+) -->\n```python\n(.*?)```", page, re.DOTALL)
    assert [name for name, _ in programs] == ["pictures", "mixture"]
    seen = "print(tuple(next(iter(loader))['rgb'].shape))"
    for _, program in programs:
        smaller = program.replace("num_workers=4", "num_workers=0")
        done = subprocess.run(
            [sys.executable, "-c", f"{smaller}\n{seen}"], cwd=tmp_path, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        assert done.stdout == "(64, 2, 3, 12, 16)\n"
