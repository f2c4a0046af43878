"""The campaigns themselves still run; what they find in a few trials is a failure."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

_ROOT = Path(__file__).parents[2]
_FEW = {
    "kill": ("--count", "4", "--only", "export", "--only", "grade"),
    "disk": ("--count", "4", "--only", "export", "--only", "grade"),
    "flip": ("--count", "4", "--only", "shards", "--only", "manifest"),
    "attack": ("--only", "task of a dataset: name 2", "--only", "links at temporary names: export"),
    "fuzz": ("--count", "40", "--kind", "dataset-new", "--kind", "recipe"),
}


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("cc") is None, reason="the counting of file operations is built by a C compiler")
@pytest.mark.parametrize("name", _FEW)
def test_a_few_trials_run_and_find_nothing(name: str, tmp_path: Path) -> None:
    command = [sys.executable, "-m", f"tests.campaigns.{name}", *_FEW[name], "--keep", str(tmp_path)]
    done = subprocess.run(command, cwd=_ROOT, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "0 findings" in done.stdout
