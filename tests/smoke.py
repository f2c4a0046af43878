"""Tries an installed flowlab in an empty folder: the main path, end to end. Run by `make wheel`."""

import subprocess
import sys
import tempfile
from pathlib import Path


def flowlab(*args: str) -> None:
    subprocess.run([sys.executable, "-m", "flowlab", *args], check=True)


with tempfile.TemporaryDirectory() as folder:
    data = f"{folder}/data"
    flowlab("extract-sim", "drawer-open", "--episodes", "1", "--out", data, "--recipe", "metaworld")
    flowlab("validate", data)
    flowlab("viz", data, "--png", f"{folder}/still.png", "--save", f"{folder}/episode.rrd")
    flowlab("train", data, "--policy", "fdp", "--out", f"{folder}/run", "--set", "run.steps=2")
    assert len(list(Path(f"{folder}/run/checkpoints").iterdir())) > 0
    flowlab("eval", f"{folder}/run", "--episodes", "1", "--seeds", "0", "--out", f"{folder}/report")
    assert "</html>" in Path(f"{folder}/report/report.html").read_text()
    assert Path(f"{folder}/still.png").stat().st_size > 10_000
    assert Path(f"{folder}/episode.rrd").stat().st_size > 10_000
print("the installed wheel works")
