"""Example 2 reads a layout of its own, from Python and by the command line."""

import importlib
import os
import sys
from pathlib import Path

import pytest
from conftest import Cli
from run_example import EXAMPLES, run_example


def test_the_recording_is_checked_and_described() -> None:
    output = run_example("02_own_reader.py")
    assert "read by 'log': 15 rows, a state of 1 number" in output
    assert "depth: 15 at 30 per second" in output


def test_the_command_line_reads_it_by_its_import_path(
    flowlab: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(EXAMPLES)
    recording = importlib.import_module("02_own_reader").write_example(tmp_path / "pour.log")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(EXAMPLES), *sys.path[:1]])}
    done = flowlab("track-real", recording, "--reader", "02_own_reader:LogReader", "--dry-run", env=environment)
    assert "read as a log recording" in done.stdout, done.stderr
    assert "15 at 30 per second, no gaps" in done.stdout
