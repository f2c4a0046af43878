"""The program of the tutorial drives an arm by a policy that is served, as it is shown: only for fewer steps."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from test_docs import ROOT, blocks
from trained_runs import NETWORK, make_run, options

import flowlab

SMALLER = {"5_000_010": "5_000_002", "< 200": "< 12"}
"""Scenes, and steps in each."""


@pytest.mark.slow
def test_the_program_of_the_tutorial_drives_an_arm(tmp_path: Path) -> None:
    data = flowlab.extract("plate-slide", tmp_path / "data", episodes=2, workers=1).path
    short = options("run.minutes=null", "run.steps=2", "run.checkpoints=1", "run.validations=0")
    run = make_run(data, "--policy", "dp3", "--out", tmp_path / "run", "--profile", NETWORK, *short, "--device", "cpu")
    (program,) = blocks(ROOT / "docs" / "tutorial.md", "python")
    for shown, smaller in SMALLER.items():
        assert shown in program
        program = program.replace(shown, smaller)
    serve = [sys.executable, "-m", "flowlab", "serve", str(run), "--port", "0"]
    quiet = os.environ | {"PYTHONUNBUFFERED": "1"}
    with subprocess.Popen(serve, stdout=subprocess.PIPE, text=True, env=quiet) as server:
        try:
            assert server.stdout is not None
            address = re.search(r"ws://(\S+);", server.stdout.readline())
            assert address is not None
            assert "127.0.0.1:8123" in program
            (tmp_path / "drive.py").write_text(program.replace("127.0.0.1:8123", address[1]))
            done = subprocess.run(
                [sys.executable, "drive.py"], cwd=tmp_path, capture_output=True, text=True, timeout=200, check=False
            )
        finally:
            server.terminate()
    assert done.returncode == 0, done.stderr
    assert [line.partition(":")[0] for line in done.stdout.splitlines()] == ["scene 5000000", "scene 5000001"]
    assert done.stdout.count("after 12 steps") == 2, done.stdout
