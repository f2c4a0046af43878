"""The rehearsal of the real-robot protocol, small: what it leaves, that it goes on, and what it refuses."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import flowlab

ROOT = Path(__file__).parents[2]
SMALL = (
    "--tasks",
    "button-press",
    "--demonstrations",
    "3",
    "--trials",
    "1",
    "--steps",
    "2",
    "--set",
    "size=[160, 120]",
)


def rehearse(out: Path, *changes: str) -> tuple[int, str]:
    command = [sys.executable, ROOT / "benchmarks" / "rehearsal.py", "--out", out, *SMALL, *changes]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=out.parent)
    if "OpenGL cannot be used here" in done.stderr:
        pytest.skip("OpenGL is not installed here, and films need color")
    return done.returncode, done.stdout + done.stderr


def times(out: Path) -> dict[Path, int]:
    return {file: file.stat().st_mtime_ns for file in (out / "units").glob("*.json")}


@pytest.mark.slow
def test_a_small_rehearsal_ends_in_a_table_goes_on_and_keeps_to_its_settings(tmp_path: Path) -> None:
    out = tmp_path / "rehearsal"
    code, said = rehearse(out)
    assert code == 0, said
    rows = (out / "trials.csv").read_text().splitlines()
    assert rows[0] == "policy,task,trial,success,note"
    assert [row.split(",")[:3] for row in rows[1:]] == [
        [policy, "button-press", "01"] for policy in ("expert", "repetition", "dp3", "fdp-exact", "fdp-estimated")
    ]
    assert rows[1] == "expert,button-press,01,1,"
    assert (out / "report" / "report.html").is_file()
    assert json.loads((out / "units" / "films-button-press.json").read_text())["repeated"] == 3

    estimated, exact = (flowlab.open_dataset(out / "data" / f"button-press-{k}") for k in ("estimated", "exact"))
    assert exact.provenance.tracks == "exact"
    for mine, true in zip(estimated, exact, strict=True):
        assert mine.action.shape[1] == mine.state.shape[1] == 8
        for name in ("point_cloud", "state", "action"):
            assert np.array_equal(getattr(mine, name), getattr(true, name))
        assert np.array_equal(mine.queries.xyz_world, true.queries.xyz_world)
        assert np.array_equal(true.tracks.xyz_world[0], true.queries.xyz_world)
        assert not np.array_equal(mine.tracks.xyz_world, true.tracks.xyz_world)

    done = times(out)
    next(iter(done)).unlink()
    code, said = rehearse(out)
    assert code == 0, said
    assert len([file for file, time in times(out).items() if done[file] == time]) == len(done) - 1

    code, said = rehearse(out, "--set", "sensor=tof")
    assert code == 1
    assert "rehearsal.json: was begun with film" in said
    assert "choose another --out" in said
    code, said = rehearse(out, "--set", "senser=tof")
    assert "no setting is called 'senser'; did you mean sensor?" in said
