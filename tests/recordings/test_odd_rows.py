"""Rows of a robot's numbers that are no readings are told, and what robots really do is not."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from real_recordings import write_folder
from synthetic import call_cli
from thoroughness import examples

from flowlab.recordings.odd_rows import frozen_rows, no_readings

ROWS = 40


def motion(seed: int = 0, rows: int = ROWS) -> np.ndarray:
    """Seven joints that move without a rest."""
    rng = np.random.default_rng(seed)
    phase, speed = rng.uniform(0, 6, 7), rng.uniform(0.05, 0.2, 7)
    return np.asarray(rng.uniform(0.1, 1, 7) * np.sin(phase + np.arange(rows)[:, None] * speed))


def with_rows(rows: slice | list[int], value: float | np.ndarray, column: slice | int = np.s_[:]) -> np.ndarray:
    values = motion()
    values[rows, column] = value
    return values


@pytest.mark.parametrize(
    ("values", "says"),
    [
        (with_rows([3, 9, 20, 21, 30], -999.0, 2), "column 3 is -999 in 5 of 40 rows, the first 3"),
        (with_rows([5, 6], 65535.0, 6), "column 7 is 65535 in 2 of 40 rows"),
        (with_rows(np.s_[10:18], 0.0), "rows 10 to 17 are equal in every number, and leap"),
        (with_rows(np.s_[12:28], motion()[12]), "rows 12 to 27 are equal"),
        (with_rows(np.s_[30:], motion()[2]), "rows 30 to 39 are equal"),
    ],
    ids=["sentinel", "full scale", "link lost", "froze", "froze at the end"],
)
def test_rows_that_are_no_readings_are_doubtful(
    values: np.ndarray, says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = no_readings(values, ()) + frozen_rows(values)
    assert says in found
    folder = write_folder(tmp_path / "r", steps=ROWS, state="s.npy")
    np.save(folder / "s.npy", values)
    _, out, _ = call_cli(capsys, "track-real", folder, "--dry-run", "--json")
    (facts,) = json.loads(out)["recordings"]
    assert [c["verdict"] for c in facts["checks"] if c["about"] == "state numbers"] == ["doubtful"]


@given(
    kind=st.sampled_from(["moves", "rests", "noise", "gripper", "held", "stops", "steps", "wraps"]),
    seed=st.integers(0, 2**31),
)
@settings(max_examples=examples(200), deadline=None)
def test_what_robots_do_is_no_fault(kind: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    values = motion(seed, 60)
    at = int(rng.integers(10, 45))
    if kind == "rests":  # and goes on from where it is
        values = np.concatenate([values[:at], np.repeat(values[at - 1 : at], 10, 0), values[at:]])
    if kind == "noise":
        values = np.repeat(values[:1], 60, 0) + rng.normal(0, 1e-3, values.shape)
    if kind == "gripper":
        values[:, 6] = np.where(np.arange(60) < at, 0.0, 0.08)
        values[at : at + int(rng.integers(2, 20)), 6] = 0.04
    if kind == "held":  # a robot that is asked five times less often than the camera
        values = np.repeat(values[::5], 5, 0)
    if kind == "stops":
        values[at:] = values[at]
    if kind == "steps":
        values = np.round(values, 1)
    if kind == "wraps":
        values[:, 0] = (0.2 * np.arange(60) + np.pi) % (2 * np.pi) - np.pi
    assert no_readings(values, ()) == ""
    assert frozen_rows(values) == ""
