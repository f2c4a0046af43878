"""Depth of a camera beside that of color, which is said to be aligned to it: told by where both change."""

from pathlib import Path

import numpy as np
import pytest
from dry_runs import dry_run
from hypothesis import given, settings
from hypothesis import strategies as st
from real_recordings import write_png, write_yaml

from flowlab.recordings.content import digest
from flowlab.recordings.depth_aside import DepthAside, find_depth_aside

SIZE, FRAMES = (240, 320), 30
GIVEN = {"fx": 300.0, "fy": 300.0, "cx": 159.5, "cy": 119.5}


def pictures(seed: int, frames: int = FRAMES) -> tuple[np.ndarray, np.ndarray]:
    """A ball that wanders before a wall whose texture has far more edges than depth has, in color and depth."""
    rng = np.random.default_rng(seed)
    wall = np.kron(rng.uniform(0, 255, (30, 40)), np.ones((8, 8)))
    v, u = np.mgrid[: SIZE[0], : SIZE[1]]
    way = np.add(np.cumsum(rng.normal(0, 9, (frames, 2)), axis=0), (120, 160))
    near = [(v - y) ** 2 + (u - x) ** 2 < 30**2 for y, x in 60 + np.abs(np.mod(way - 60, (240, 400)) - (120, 200))]
    color = [np.where(ball, 128, wall) + rng.normal(0, 3, SIZE) for ball in near]
    depth = [np.where(ball, 700, 730) + rng.normal(0, 1, SIZE) for ball in near]
    gray = np.stack(color).clip(0, 255).astype(np.uint8)
    return np.repeat(gray[..., None], 3, -1), np.stack(depth).astype(np.uint16)


def aside_of(color: np.ndarray, depth: np.ndarray) -> DepthAside | None:
    rows = np.repeat(np.arange(len(color))[:, None], 2, 1)
    return find_depth_aside(rows, dict(enumerate(map(digest, color))), dict(enumerate(map(digest, depth))))


@pytest.mark.parametrize(
    ("moved", "verdict", "says"),
    [
        ((0, 0), "ok", "the pictures agree: depth changes where color does"),
        ((0, 25), "doubtful", "when moved by -8 % of the width and 0 % of the height"),
        ((-20, 0), "doubtful", "when moved by 0 % of the width and 8 % of the height"),
    ],
)
def test_depth_that_lies_aside_is_found_where_it_changes(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, moved: tuple[int, int], verdict: str, says: str
) -> None:
    color, depth = pictures(1)
    for k in range(FRAMES):
        write_png(tmp_path / "r" / "color" / f"{k:04d}.png", color[k])
        write_png(tmp_path / "r" / "depth" / f"{k:04d}.png", np.roll(depth[k], moved, (0, 1)))
    write_yaml(tmp_path / "r" / "recording.yaml", fps=15, depth_unit_m=0.001, intrinsics=GIVEN)
    found, words = dry_run(capsys, tmp_path / "r").checks["registration"]
    assert (found, says in words) == (verdict, True), words


@given(seed=st.integers(0, 1000), right=st.integers(-6, 6), down=st.integers(-6, 6))
@settings(max_examples=6, deadline=None)
def test_where_depth_lies_is_told_to_within_a_cell(seed: int, right: int, down: int) -> None:
    color, depth = pictures(seed)
    found = aside_of(color, np.roll(depth, (5 * down, 5 * right), (1, 2)))
    assert found is not None
    assert found.shift == pytest.approx((-right / 64, -down / 48), abs=1.01 / 48)
    if (right, down) != (0, 0):
        assert not found.lies


def test_depth_of_a_wider_view_does_not_lie_on_color() -> None:
    color, depth = pictures(4, 60)
    rows, columns = (((np.arange(n) - n / 2) * 1.5 + n / 2).astype(int) for n in SIZE)
    inside = np.outer((rows >= 0) & (rows < SIZE[0]), (columns >= 0) & (columns < SIZE[1]))
    wide = depth[:, rows.clip(0, SIZE[0] - 1)][:, :, columns.clip(0, SIZE[1] - 1)] * inside
    found = aside_of(color, wide)
    assert found is not None
    assert not found.lies


def test_few_pictures_and_pictures_that_do_not_change_tell_nothing() -> None:
    color, depth = pictures(2)
    assert aside_of(color[:10], depth[:10]) is None
    still = aside_of(np.repeat(color[:1], FRAMES, 0), np.repeat(depth[:1], FRAMES, 0))
    assert still is not None
    assert still.lies is None
