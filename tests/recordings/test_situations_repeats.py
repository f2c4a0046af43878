"""Cameras that froze or are slower than their recorder, through the command line; beside each a control."""

from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
from real_recordings import write_png, write_yaml
from test_situations_clock import Inspect, assert_fine, assert_refused, inspect

__all__ = ["inspect"]
Frame = tuple[np.ndarray, np.ndarray]
FRAMES = 40
INTRINSICS = {"width": 64, "height": 48, "fx": 60.0, "fy": 60.0, "cx": 31.5, "cy": 23.5}


def film(t: int, noise: float = 2.0, pan: float = 0.0, seed: int | None = None) -> Frame:
    """A small block slides over a textured wall, which a camera that pans passes; ``noise`` is the sensor's."""
    rng = np.random.default_rng(t if seed is None else seed)
    wall = cv2.GaussianBlur(np.random.default_rng(99).normal(0, 1, (48, 400)), (0, 0), 1.5) * 90
    shift = round(pan * t)
    gray = np.clip(120 + wall[:, shift : shift + 64], 40, 200)
    depth = np.clip(1500 + 2 * wall[:, shift : shift + 64], 900, 2100)
    gray[20:28, 5 + t : 11 + t], depth[20:28, 5 + t : 11 + t] = 225, 850
    gray, depth = (x + rng.normal(0, noise, x.shape) for x in (gray, depth))
    return np.repeat(gray[..., None], 3, axis=2).clip(0, 255).astype(np.uint8), depth.round().astype(np.uint16)


def write(folder: Path, frames: Sequence[Frame], state: bool = False) -> Path:
    for t, (rgb, depth) in enumerate(frames):
        write_png(folder / "color" / f"{t:04d}.png", rgb)
        write_png(folder / "depth" / f"{t:04d}.png", depth)
    more = {"state": "state.npy"} if state else {}
    if state:
        np.save(folder / "state.npy", np.linspace(0, 1, len(frames))[:, None])
    write_yaml(folder / "recording.yaml", depth_unit_m=0.001, intrinsics=INTRINSICS, fps=30, **more)
    return folder


def shown(order: Sequence[int], which: str = "both", **how: float) -> list[Frame]:
    """The film in an order, of color, depth or both."""
    color, depth = (order if which in (name, "both") else range(len(order)) for name in ("color", "depth"))
    return [(film(c, **how)[0], film(d, **how)[1]) for c, d in zip(color, depth, strict=True)]


def held(first: int, last: int) -> list[int]:
    """Frame ``first`` until ``last``."""
    return [first if first <= t < last else t for t in range(FRAMES)]


def encoded(frames: Sequence[Frame], quality: Sequence[int]) -> list[Frame]:
    """Color after JPEG, each in a quality of its own."""
    jpg = [
        cv2.imencode(".jpg", rgb, [cv2.IMWRITE_JPEG_QUALITY, q])[1] for (rgb, _), q in zip(frames, quality, strict=True)
    ]
    return [(cv2.imdecode(j, cv2.IMREAD_COLOR), depth) for j, (_, depth) in zip(jpg, frames, strict=True)]


def torn(rows: slice, columns: slice = slice(None), which: tuple[int, ...] = (0, 1)) -> list[Frame]:
    """The film, of which a part stays from frame 16 to 22."""
    frames = shown(range(FRAMES))
    for t in range(17, 23):
        for k in which:
            frames[t][k][rows, columns] = frames[16][k][rows, columns]
    return frames


FREEZES = [(16, 24, 7), (32, 40, 7), (0, 9, 8), (4, 40, 35)]


@pytest.mark.parametrize("which", ["color", "depth", "both"])
@pytest.mark.parametrize(("first", "last", "bad"), FREEZES)
def test_a_freeze_among_pictures_with_noise_is_named(
    tmp_path: Path, inspect: Inspect, which: str, first: int, last: int, bad: int
) -> None:
    """Row 19, without a jump that would tell: only a small thing moves."""
    path = write(tmp_path / "r", shown(held(first, last), which))
    code, facts = inspect(path, "--set", "recording.max_bad_share=0.9")
    assert (code, len(facts["bad_frames"])) == (0, bad)
    assert_refused(inspect(path), "it froze")


@pytest.mark.parametrize("noise", [0.6, 1.0, 5.0])
def test_however_strong_the_noise_is(tmp_path: Path, inspect: Inspect, noise: float) -> None:
    assert_refused(inspect(write(tmp_path / "r", shown(held(16, 24), noise=noise))), "7 of 40 frames are bad")
    assert_fine(inspect(write(tmp_path / "ok", shown(range(FRAMES), noise=noise))))


def test_a_freeze_with_a_clock_drawn_over_it_is_named(tmp_path: Path, inspect: Inspect) -> None:
    frames = shown(held(16, 24))
    for t, (rgb, _) in enumerate(frames):
        rgb[:2, :4] = 5 * t
    assert_refused(inspect(write(tmp_path / "r", frames)), "7 of 40 frames are bad", "it froze")


@pytest.mark.parametrize("which", ["color", "both"])
@pytest.mark.parametrize(
    ("order", "words"),
    [
        ([t // 2 for t in range(FRAMES)], ("about 15 a second", "recording.every=2")),
        ([t // 3 for t in range(FRAMES)], ("about 10 a second", "recording.every=3")),
        ([t * 2 // 3 for t in range(FRAMES)], ("about 20 a second", "max_bad_share=0.38")),
        ([t * 4 // 5 for t in range(FRAMES)], ("every 1.2",)),
    ],
)
def test_a_camera_slower_than_its_recorder_is_named(
    tmp_path: Path, inspect: Inspect, which: str, order: list[int], words: tuple[str, ...]
) -> None:
    path = write(tmp_path / "r", shown(order, which))
    assert_refused(inspect(path), *words)
    every = words[-1].rpartition("=")[2]
    if "every=" in words[-1] and which == "both":
        assert_fine(inspect(path, "--set", f"recording.every={every}"))


SLOWS_DOWN = [int(t) for t in np.cumsum([0, *[8] * 10, 6, 4, 2, *[0] * 26])]


@pytest.mark.parametrize(
    "frames",
    [
        lambda: shown(range(FRAMES)),
        lambda: shown([8] * 8 + list(range(8, FRAMES)), noise=0.0),  # a renderer, or a video: nothing moves at first
        lambda: shown([0] * FRAMES, noise=0.0),
        lambda: shown(range(FRAMES), pan=3),
        lambda: shown(SLOWS_DOWN, noise=0.0, pan=0.5),  # a camera that stops
        lambda: [(film(max(t, 12), 0.0)[0], film(max(t, 12), 2.0, seed=t)[1]) for t in range(FRAMES)],
        lambda: shown([6 - abs(t % 12 - 6) for t in range(FRAMES)], noise=0.0),  # back and forth, in a renderer
        lambda: encoded([(film(12, seed=t)[0], film(12, seed=t)[1]) for t in range(FRAMES)], [85] * FRAMES),
    ],
)
def test_scenes_that_stand_still_froze_not(tmp_path: Path, inspect: Inspect, frames: Callable[[], list[Frame]]) -> None:
    code, facts = inspect(write(tmp_path / "r", frames()))
    assert (code, facts["bad_frames"]) == (0, [])
    assert {c["verdict"] for c in facts["checks"] if c["about"] == "repeats"} <= {"ok", "assumed"}, facts["checks"]


@pytest.mark.parametrize(("noise", "code"), [(0.0, 0), (2.0, 3)])
def test_what_is_rendered_may_come_again_where_it_has_no_noise(
    tmp_path: Path, inspect: Inspect, noise: float, code: int
) -> None:
    """Of depth pictures that stay while color changes, too; of pictures with noise that is not believed."""
    path = write(tmp_path / "r", shown(held(20, 28), "depth", noise=noise))
    assert_refused(inspect(path), "7 of 40 frames are bad", "it froze")
    with (path / "recording.yaml").open("a") as file:
        file.write("rendered: true\n")
    found, facts = inspect(path)
    assert found == code
    assert code or facts["bad_frames"] == []


@pytest.mark.parametrize("noise", [0.0, 2.0])
def test_a_robot_that_moves_while_the_picture_does_not(tmp_path: Path, inspect: Inspect, noise: float) -> None:
    path = write(tmp_path / "r", shown(held(20, 28), noise=noise), state=True)
    assert_refused(inspect(path), "7 of 40 frames are bad", "it froze")


def test_a_picture_given_twice_is_named(tmp_path: Path, inspect: Inspect) -> None:
    facts = assert_fine(inspect(write(tmp_path / "r", shown([t - (t == 6) for t in range(FRAMES)], "color"))))
    assert any("1 pictures equal the one before: color/0006.png" in c["says"] for c in facts["checks"])


@pytest.mark.parametrize("order", [[min(t, 30) for t in range(FRAMES)], [max(t, 8) for t in range(FRAMES)]])
def test_a_moving_camera_that_stops_at_once_is_doubtful(tmp_path: Path, inspect: Inspect, order: list[int]) -> None:
    """Noise is not seen under motion, and no jump follows."""
    _, facts = inspect(write(tmp_path / "r", shown(order, pan=5)))
    said = [c["says"] for c in facts["checks"] if c["about"] == "repeats" and c["verdict"] == "doubtful"]
    assert facts["bad_frames"] or "froze, or stopped at once" in said[0]


@pytest.mark.parametrize(
    ("order", "bad"),
    [
        ([*range(20), *range(16, 20), *range(24, FRAMES)], 4),  # a ring buffer is played twice
        ([t - 2 * (t % 13 == 4) for t in range(FRAMES)], 3),
        ([8 if t == 30 else t for t in range(FRAMES)], 1),
        ([30 if t == 8 else t for t in range(FRAMES)], 1),
    ],
)
def test_older_pictures_that_come_again_are_bad(tmp_path: Path, inspect: Inspect, order: list[int], bad: int) -> None:
    for which in ("color", "depth"):
        code, facts = inspect(write(tmp_path / which, shown(order, which)))
        assert (code, len(facts["bad_frames"])) == (0, bad)
        assert "an older picture came again" in str(facts["bad_frames"][0])


def test_a_sequence_played_again_is_told_by_its_jumps(tmp_path: Path, inspect: Inspect) -> None:
    order = [*range(24), *range(8, 24)]
    assert_refused(inspect(write(tmp_path / "r", shown(order, noise=0.0))), "16 of 40 frames are bad")


@pytest.mark.parametrize(
    "frames",
    [
        lambda: torn(slice(0, 24)),
        lambda: torn(slice(30, 48), which=(0,)),
        lambda: torn(slice(None), slice(40, 64), which=(1,)),
        lambda: encoded(shown(held(16, 24), "color"), [85 + t % 10 for t in range(FRAMES)]),
        lambda: encoded(shown(held(4, 12), "color", noise=4.0), [70 + t % 6 for t in range(FRAMES)]),
    ],
)
def test_what_froze_in_part_or_was_encoded_anew_is_doubtful(
    tmp_path: Path, inspect: Inspect, frames: Callable[[], list[Frame]]
) -> None:
    _, facts = inspect(write(tmp_path / "r", frames()))
    (said,) = [c for c in facts["checks"] if c["about"] == "repeats"]
    assert said["verdict"] == "doubtful"
    assert "of an earlier one bit by bit" in said["says"] or "far less than the noise" in said["says"]
