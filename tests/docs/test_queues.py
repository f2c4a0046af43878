"""The recipes for queues do what they say: as they are shown, only smaller, and by Slurm itself where there is one."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from test_docs import ROOT, blocks

from flowlab.storage.dataset import open_dataset
from flowlab.storage.validation import validate

PAGE = ROOT / "docs" / "scale.md"
SMALLER = {
    "--array=0-15": "--array=0-1",
    "/16": "/2",
    "-task=8": "-task=1",
    "--group hard --episodes 1000": "reach --episodes 3",
}
SLURM = shutil.which("sinfo") is not None and "idle" in subprocess.run(["sinfo"], capture_output=True, text=True).stdout


def script(shown: str, out: Path) -> str:
    """A recipe's commands with less to do, into a folder of the test."""
    assert "/shared/hard" in shown
    for long, short in SMALLER.items():
        shown = shown.replace(long, short)
    return shown.replace("/shared/hard", str(out))


def environment(**more: str) -> dict[str, str]:
    """As of a shell in which flowlab is found."""
    return os.environ | {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"} | more


def check(out: Path) -> None:
    """Every part is there, and nothing else."""
    assert len(open_dataset(out)) == 3
    assert not list(validate(out))


@pytest.mark.slow
def test_the_recipe_for_slurm(tmp_path: Path) -> None:
    (recipe,) = blocks(PAGE, "shell")
    (tmp_path / "hard.sh").write_text(script(recipe, tmp_path / "data"))
    assert "#SBATCH --array=0-1\n" in (tmp_path / "hard.sh").read_text()
    for task in "01":
        given = environment(SLURM_ARRAY_TASK_ID=task, SLURM_CPUS_PER_TASK="1")
        subprocess.run(["bash", "-e", "hard.sh"], cwd=tmp_path, env=given, check=True)
    check(tmp_path / "data")


@pytest.mark.skipif(not SLURM, reason="no Slurm with an idle machine")
def test_the_recipe_for_slurm_by_slurm(tmp_path: Path) -> None:
    (recipe,) = blocks(PAGE, "shell")
    (tmp_path / "hard.sh").write_text(script(recipe, tmp_path / "data"))
    done = subprocess.run(
        ["sbatch", "--wait", "hard.sh"], cwd=tmp_path, env=environment(), capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, (done.stderr, [p.read_text() for p in tmp_path.glob("slurm-*.out")])
    check(tmp_path / "data")


@pytest.mark.slow
def test_the_recipe_for_skypilot(tmp_path: Path) -> None:
    (recipe,) = (yaml.safe_load(block) for block in blocks(PAGE, "yaml"))
    assert list(recipe["file_mounts"]) == ["/shared"]
    for rank in range(2):
        given = environment(SKYPILOT_NODE_RANK=str(rank), SKYPILOT_NUM_NODES="2")
        subprocess.run(["bash", "-ec", script(recipe["run"], tmp_path / "data")], cwd=tmp_path, env=given, check=True)
    check(tmp_path / "data")
