"""Depth that was taken later or earlier than color, in recordings whose times do not say so."""

import re
import tracemalloc
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from dry_runs import DryRun, dry_run
from filmed_scenes import FLOOR, TABLE, THINGS, WALL, Box, film, looking
from hypothesis import given, settings
from hypothesis import strategies as st
from real_recordings import write_png, write_yaml

from flowlab.recordings.depth_lag import _lagged_correlations, find_depth_lag
from flowlab.recordings.motion import Motion, Offset, find_offset
from flowlab.recordings.picture_changes import find_changes

Capture = pytest.CaptureFixture[str]
SIZE, FPS, FRAMES = (160, 120), 10, 36
K = np.array([[150.0, 0, 79.5], [0, 150.0, 59.5], [0, 0, 1]])
GIVEN = {"fx": 150.0, "fy": 150.0, "cx": 79.5, "cy": 59.5}
BLOCK = Box((-0.25, -0.2, 0.1), (0.12, 0.12, 0.2), (220, 210, 60))


@pytest.fixture(scope="module")
def frames() -> list[tuple[np.ndarray, np.ndarray]]:
    """A block that is moved at an even speed there and back: how much changes at a time tells no lag."""
    there = 0.014 * np.abs((np.arange(FRAMES) + 12) % 32 - 16)
    scene, eye = (TABLE, WALL, FLOOR, *THINGS), looking((0.0, -0.9, 0.7))
    return [film((*scene, BLOCK.moved((x, 0.3 * x, 0))), K, SIZE, eye, seed=k) for k, x in enumerate(there)]


def seen(
    capsys: Capture, path: Path, frames: list[tuple[np.ndarray, np.ndarray]], late: int, aside: int = 0, **keys: float
) -> DryRun:
    """A recording whose depth is so many frames late, and lies so many pixels aside."""
    for k in range(4, FRAMES - 4):
        write_png(path / "color" / f"{k:04d}.png", frames[k][0])
        depth = np.roll(frames[k - late][1], aside, axis=1)
        write_png(path / "depth" / f"{k:04d}.png", np.rint(depth * 5000).astype(np.uint16))
    write_yaml(path / "recording.yaml", fps=FPS, depth_unit_m=0.0002, intrinsics=GIVEN, **keys)
    return dry_run(capsys, path)


@pytest.mark.parametrize(
    ("late", "aside", "verdict", "says"),
    [
        (0, 0, "ok", "goes with that of color"),
        (0, 12, None, "0.00 s|tells no offset|goes with|too little"),
        (1, 0, "doubtful", "0.10 s after that of color .* write 'depth_offset_s: -0.1'"),
        (3, 0, "refused", "0.30 s after that of color .* write 'depth_offset_s: -0.3', else 'depth_offset_s: 0'"),
        (-2, 0, "refused", "0.20 s before that of color .* write 'depth_offset_s: 0.2'"),
    ],
)
def test_depth_of_another_time_is_found_where_it_changes(
    capsys: Capture, tmp_path: Path, frames: list[tuple[np.ndarray, np.ndarray]], late: int, aside: int,
    verdict: str | None, says: str,
) -> None:  # fmt: skip
    run = seen(capsys, tmp_path / "r", frames, late, aside)
    found, words = run.checks["motion of depth"]
    assert found in ((verdict,) if verdict else ("ok", "assumed")), words
    assert aside or run.code == (3 if verdict == "refused" else 0), run.problem
    assert re.search(says, words), words


def test_an_offset_that_is_written_is_applied(
    capsys: Capture, tmp_path: Path, frames: list[tuple[np.ndarray, np.ndarray]]
) -> None:
    run = seen(capsys, tmp_path / "r", frames, 2, depth_offset_s=-0.2)
    assert run.checks["motion of depth"][0] == "ok", run.checks["motion of depth"]
    run = seen(capsys, tmp_path / "s", frames, 2, depth_offset_s=0.0)
    assert run.code == 0
    assert run.checks["motion of depth"][0] == "assumed"
    assert "'depth_offset_s: -0.2' would make them go together" in run.checks["motion of depth"][1]


def offset_of(color: np.ndarray, depth: np.ndarray, color_s: np.ndarray, depth_s: np.ndarray) -> Offset | None:
    streams = SimpleNamespace(color=SimpleNamespace(time_s=color_s), depth=SimpleNamespace(time_s=depth_s))
    kept = [{k: SimpleNamespace(small=x) for k, x in enumerate(pictures)} for pictures in (color, depth)]
    changes = find_changes(streams, *kept)  # type: ignore[arg-type]
    return None if changes is None else find_depth_lag(changes)


@given(seed=st.integers(0, 10_000), late=st.integers(-4, 4), rate=st.sampled_from([1, 2]))
@settings(max_examples=8, deadline=None)
def test_streams_of_other_rates_are_compared_on_one_clock(seed: int, late: int, rate: int) -> None:
    rng = np.random.default_rng(seed)
    path = np.add(np.cumsum(rng.normal(0, 1.2, (90, 2)), axis=0), (12, 16))
    v, u = np.mgrid[:24, :32]
    near = [((v - y) ** 2 + (u - x) ** 2 < 16) for y, x in np.mod(path, (24, 32))]
    color = np.stack([np.where(n, 200.0, 60.0) for n in near]) + rng.normal(0, 2, (90, 24, 32))
    depth = np.stack([np.where(n, 600.0, 900.0) for n in near]) + rng.normal(0, 2, (90, 24, 32))
    clock = np.arange(90) / 30
    found = offset_of(color, depth[::rate], clock, clock[::rate] + late / 30 * rate)
    assert found is not None
    if found.told:
        assert abs(found.later_s - late * rate / 30) <= rate / 30 + 1e-6
    assert found.told or late


def test_of_what_goes_on_periodically_the_least_offset_is_told_and_that_others_fit() -> None:
    v, u = np.mgrid[:24, :32]
    near = [(v - 12) ** 2 + (u - 16 - 9 * np.sin(2 * np.pi * t / 10)) ** 2 < 16 for t in range(80)]
    color = np.stack([np.where(n, 200.0, 60.0) for n in near]) + np.random.default_rng(0).normal(0, 2, (80, 24, 32))
    depth = np.stack([np.where(n, 600.0, 900.0) for n in near])
    clock = np.arange(77) / 10
    found = offset_of(color[3:], depth[:77], clock, clock)
    assert found is not None
    assert (found.told, found.sure, found.periodic) == (True, False, True)
    assert found.later_s == pytest.approx(0.3)
    together = offset_of(color[3:], depth[3:], clock, clock)
    assert together is not None
    assert (together.told, together.later_s) == (False, 0)


def test_a_pause_of_a_day_takes_no_room() -> None:
    clock = np.r_[np.arange(30) / 10, 86_400 + np.arange(30) / 10]
    stream = SimpleNamespace(time_s=clock)
    kept = [{k: SimpleNamespace(small=np.zeros((24, 32))) for k in range(60)} for _ in "cd"]
    changes = find_changes(SimpleNamespace(color=stream, depth=stream), *kept)  # type: ignore[arg-type]
    assert changes is not None
    assert 50 < len(changes.color) < 70


def test_an_offset_is_told_across_a_pause_of_a_year_in_no_room() -> None:
    clock = np.r_[np.arange(200) / 30, 3e7 + np.arange(200) / 30]
    speed = np.abs(np.convolve(np.random.default_rng(0).normal(size=403), np.ones(5), "valid"))
    tracemalloc.start()
    found = find_offset(Motion("color", clock[1:], speed), Motion("the robot", clock[1:] + 0.1, speed))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert found is not None
    assert (found.told, found.later_s) == (True, pytest.approx(0.1, abs=1e-3))
    assert peak < 1e7, "a sample for every instant of the year would be gigabytes"


def test_depth_of_a_camera_of_its_own_is_not_late_for_lying_elsewhere(capsys: Capture, tmp_path: Path) -> None:
    """What is lifted passes each height of the upper camera's picture later."""
    scene, upper = (TABLE, WALL, FLOOR), np.eye(4)
    upper[1, 3] = -0.05
    eye = looking((0.0, -0.9, 0.7))
    for k in range(28):
        lifted = (*scene, BLOCK.moved((0.2, 0.1, 0.012 * k)))
        write_png(tmp_path / "r" / "color" / f"{k:04d}.png", film(lifted, K, SIZE, eye, seed=k)[0])
        counts = np.rint(film(lifted, K, SIZE, eye @ upper, seed=99 + k)[1] * 5000).astype(np.uint16)
        write_png(tmp_path / "r" / "depth" / f"{k:04d}.png", counts)
    keys = {"depth_intrinsics": GIVEN, "T_color_depth": upper.tolist()}
    write_yaml(tmp_path / "r" / "recording.yaml", fps=FPS, depth_unit_m=0.0002, intrinsics=GIVEN, **keys)
    verdict, says = dry_run(capsys, tmp_path / "r").checks["motion of depth"]
    assert verdict in ("ok", "assumed"), says


@given(seed=st.integers(0, 10_000), farthest=st.integers(1, 7))
@settings(max_examples=8, deadline=None)
def test_correlation_at_lags_is_that_of_the_overlap(seed: int, farthest: int) -> None:
    one, other = np.random.default_rng(seed).normal(size=(2, 23, 4, 5))
    for lag, like in zip(range(-farthest, farthest + 1), _lagged_correlations(one, other, farthest), strict=True):
        a, b = one[max(0, -lag) : 23 - max(0, lag)].ravel(), other[max(0, lag) : 23 - max(0, -lag)].ravel()
        assert like == pytest.approx(a @ b / np.sqrt((a @ a) * (b @ b)), abs=1e-9)
