"""Situations of real users in which what pictures show was misread; beside each one that must pass untroubled."""

import re
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from filmed_scenes import SCENE, Box, film, looking
from test_situations_geometry import ARM, put, verdicts

Capture = pytest.CaptureFixture[str]
Frames = list[tuple[np.ndarray, np.ndarray]]
SIZE = (96, 72)
K = np.array([[90.0, 0, 47.5], [0, 90.0, 35.5], [0, 0, 1]])
GIVEN = {"fx": 90.0, "fy": 90.0, "cx": 47.5, "cy": 35.5}
POSE = looking((0.3, -0.9, 0.7))
SMALL = Box((-0.3, -0.15, 0.1), (0.1, 0.1, 0.15), (220, 210, 60))


def rolled(angle: float) -> np.ndarray:
    T = np.eye(4)
    T[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    return POSE @ T


def shifted(up: float) -> np.ndarray:
    T = POSE.copy()
    T[2, 3] += up
    return T


def filmed(pose: Callable[[int], np.ndarray], thing: Box = SMALL, speed: float = 0.006, count: int = 10) -> Frames:
    """With a sensor's noise."""
    return [film((*SCENE, thing.moved((speed * t, 0, 0))), K, SIZE, pose(t), seed=t) for t in range(count)]


@pytest.fixture(scope="module")
def still() -> Frames:
    """A camera that stands still, and a small thing that moves."""
    return filmed(lambda t: POSE)


def said(capsys: Capture, folder: Path, about: str, frames: Frames, **keys: object) -> tuple[str, str]:
    """What came of looking at one thing."""
    _, found, _ = verdicts(capsys, put(folder, frames, **{"intrinsics": GIVEN, "T_world_cam": None, **keys}))
    return found[about]


# --- the camera moves -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "pose",
    [
        lambda t: looking((0.3 - 0.01 * t, -0.9, 0.7)),
        lambda t: looking((0.3 - 0.004 * t, -0.9 + 0.012 * t, 0.7 - 0.008 * t)),
        lambda t: rolled(0.02 * t),
        lambda t: looking((0.3 - 0.05 * (t > 5), -0.9, 0.7)),
        lambda t: shifted(0.03 * np.sin(t)),
    ],
    ids=["sideways", "forward", "roll", "bump", "up-and-down"],
)
def test_a_moving_camera_is_noticed_in_small_noisy_pictures(
    tmp_path: Path, capsys: Capture, pose: Callable[[int], np.ndarray]
) -> None:
    verdict, says = said(capsys, tmp_path / "r", "camera", filmed(pose))
    assert verdict == "doubtful", says


def test_a_standing_camera_is_known_to_stand(still: Frames, tmp_path: Path, capsys: Capture) -> None:
    assert said(capsys, tmp_path / "r", "camera", still)[0] == "ok"
    assert said(capsys, tmp_path / "arm", "camera", filmed(lambda t: POSE, ARM, 0.03))[0] == "ok"
    light = [((rgb * (1 - 0.03 * t)).astype(np.uint8), depth) for t, (rgb, depth) in enumerate(still)]
    assert said(capsys, tmp_path / "light", "camera", light)[0] == "ok"


def test_what_passes_before_a_camera_is_no_motion_of_it(tmp_path: Path, capsys: Capture) -> None:
    """It fills the picture for some frames, and then the scene is where it was."""
    large = Box((-1.6, -0.35, 0.4), (0.7, 0.05, 0.7), (150, 90, 60), contrast=90.0)
    frames = filmed(lambda t: POSE, large, 0.12, 30)
    verdict, says = said(capsys, tmp_path / "r", "camera", frames)
    assert verdict in ("assumed", "ok"), says


def test_what_pictures_do_not_show_is_assumed(still: Frames, tmp_path: Path, capsys: Capture) -> None:
    rng = np.random.default_rng(0)
    dark = [(rng.normal(rgb * 0.04 + 4, 2).clip(0, 255).astype(np.uint8), depth) for rgb, depth in still]
    assert said(capsys, tmp_path / "dark", "camera", dark)[0] == "assumed"
    blurred = [
        (cv2.blur(rgb, (15, 15)), depth) for rgb, depth in filmed(lambda t: looking((0.3 - 0.01 * t, -0.9, 0.7)))
    ]
    assert said(capsys, tmp_path / "blurred", "camera", blurred)[0] == "assumed"


# --- readings that are none -------------------------------------------------------------------------------


def cut_off(frames: Frames, near: float, far: float) -> Frames:
    return [(rgb, depth.clip(near, far)) for rgb, depth in frames]


def banded(frames: Frames, value: float, rows: int = 18) -> Frames:
    """As where a sensor is blinded: one value in the upper part of the pictures."""
    high = np.arange(SIZE[1])[:, None] < rows
    return [(rgb, np.where(high, value, depth)) for rgb, depth in frames]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda f: cut_off(f, 0, 1.5), "1500 counts"),
        (lambda f: cut_off(f, 0.9, 9), "900 counts"),
        (lambda f: cut_off(f, 0.9, 1.6), "900 counts .*the least, in .*1600 counts .*the greatest"),
        (lambda f: banded(f, 0.001), "1 counts"),
        (lambda f: banded(f, 0.1), "100 counts"),
        (lambda f: banded(f, 2.047), "2047 counts"),
        (lambda f: banded(f, 8.19, 1), "8190 counts"),
        (lambda f: banded(f, 10.0), "10000 counts"),
    ],
)
def test_one_reading_that_stays_while_others_vary_is_none(
    still: Frames, tmp_path: Path, capsys: Capture, change: Callable[[Frames], Frames], words: str
) -> None:
    verdict, says = said(capsys, tmp_path / "r", "saturated depth", change(still[:6]))
    assert verdict == "assumed", says
    assert re.search(words, says), says


def patched(frames: Frames, value: Callable[[np.ndarray, int], object]) -> Frames:
    """A patch of each picture filled anew."""
    hole = np.zeros(SIZE[::-1], bool)
    hole[10:40, 10:45] = True
    return [(rgb, np.where(hole, value(depth, t), depth)) for t, (rgb, depth) in enumerate(frames)]


@pytest.mark.parametrize(
    "value",
    [lambda d, t: d.max(), lambda d, t: np.quantile(d, 0.4 + 0.03 * t), lambda d, t: 0.9 + 0.01 * t],
    ids=["greatest", "middle", "another"],
)
def test_holes_that_were_filled_are_no_readings(
    still: Frames, tmp_path: Path, capsys: Capture, value: Callable[[np.ndarray, int], object]
) -> None:
    folder = put(tmp_path / "r", patched(still[:6], value), intrinsics=GIVEN, T_world_cam=None)
    _, found, _ = verdicts(capsys, folder)
    verdict, says = found["saturated depth"]
    assert (verdict, "15% of the pixels have one reading" in says) == ("doubtful", True)
    rng = np.random.default_rng(0)
    few = patched(still[:6], lambda d, t: np.where(rng.random(d.shape) < 0.1, d.max(), d))
    assert said(capsys, tmp_path / "few", "saturated depth", few)[0] == "ok"


def test_codes_at_the_end_of_16_bits_are_no_readings(still: Frames, tmp_path: Path, capsys: Capture) -> None:
    rng = np.random.default_rng(0)
    odd = patched(still[:3], lambda d, t: 65.531 + 0.001 * rng.integers(0, 5, d.shape))
    folder = put(tmp_path / "r", odd, intrinsics=GIVEN, T_world_cam=None)
    found = verdicts(capsys, folder)[1]
    assert found["saturated depth"][0] == "assumed"
    assert "100% within" in found["depth unit"][1]


def test_depth_in_wide_steps_is_doubtful(still: Frames, tmp_path: Path, capsys: Capture) -> None:
    for step, expected in ((0.1, "doubtful"), (0.04, "doubtful"), (0.005, "ok")):
        wide = [(rgb, np.rint(depth / step) * step) for rgb, depth in still[:3]]
        verdict, says = said(capsys, tmp_path / f"{step}", "depth unit", wide)
        assert (verdict, f"in steps of {1000 * step:g} mm" in says) == (expected, True)


def test_readings_beyond_what_is_sensed_are_doubtful(still: Frames, tmp_path: Path, capsys: Capture) -> None:
    rng = np.random.default_rng(0)
    for name, near, far in (("far", 65.4, 65.5), ("near", 0.09, 0.11)):
        high = np.arange(SIZE[1])[:, None] < 18
        odd = [(rgb, np.where(high, rng.uniform(near, far, depth.shape), depth)) for rgb, depth in still[:3]]
        verdict, says = said(capsys, tmp_path / name, "depth unit", odd)
        assert verdict == "doubtful", says
        assert "75% within 0.15 to 10 m" in says
    assert said(capsys, tmp_path / "unit", "depth unit", still[:3])[0] == "ok"
    put(tmp_path / "unit", (), intrinsics=GIVEN, depth_unit_m=0.0001)
    assert verdicts(capsys, tmp_path / "unit")[1]["depth unit"][0] == "doubtful"


@pytest.mark.parametrize("noise", [0.0, 0.35, 1.0])
def test_surfaces_are_no_limits(still: Frames, tmp_path: Path, capsys: Capture, noise: float) -> None:
    """A table from above, before which a thing moves; and readings in the rough steps of disparities."""
    rng, frames = np.random.default_rng(0), []
    for t, (rgb, _) in enumerate(still[:6]):
        depth = np.ones(SIZE[::-1])
        depth[20:40, 20 + t : 50 + t] = 0.85 - 0.002 * np.arange(30)
        frames.append((rgb, rng.normal(depth, noise / 1000)))
    assert said(capsys, tmp_path / "table", "saturated depth", frames)[0] == "ok"
    rough = [(rgb, 20 / np.rint(20 / depth)) for rgb, depth in still[:6]]
    assert said(capsys, tmp_path / "rough", "saturated depth", rough)[0] == "ok"


# --- depth that is not seen from the color camera -----------------------------------------------------------


@pytest.mark.parametrize(
    "change",
    [
        lambda d: d[::-1, ::-1],
        lambda d: d[:, ::-1],
        lambda d: np.where(d > 0, np.roll(d[::-1], 9, 1), 0),
        lambda d: np.roll(d, (20, 30), (0, 1)),
    ],
    ids=["upside-down", "mirrored", "flipped", "far-away"],
)
def test_depth_that_fits_nowhere_is_doubtful(
    still: Frames, tmp_path: Path, capsys: Capture, change: Callable[[np.ndarray], np.ndarray]
) -> None:
    verdict, says = said(capsys, tmp_path / "r", "registration", [(rgb, change(depth)) for rgb, depth in still[:4]])
    assert verdict in ("doubtful", "refused"), says


@pytest.mark.parametrize(
    ("turn", "how"),
    [
        ((slice(None, None, -1), slice(None)), "upside down"),
        ((slice(None), slice(None, None, -1)), "mirrored"),
        ((slice(None, None, -1), slice(None, None, -1)), "turned by half a turn"),
    ],
)
@pytest.mark.parametrize("eye", [(0.5, -0.7, 0.6), (-0.4, -0.8, 0.5)])
def test_depth_that_is_turned_is_told_how(
    tmp_path: Path, capsys: Capture, turn: tuple[slice, slice], how: str, eye: tuple[float, float, float]
) -> None:
    frames = filmed(lambda t: looking(eye), count=3)
    assert said(capsys, tmp_path / "ok", "registration", frames)[0] == "ok"
    verdict, says = said(capsys, tmp_path / "r", "registration", [(rgb, depth[turn]) for rgb, depth in frames])
    assert verdict in ("doubtful", "refused")
    assert f"as if depth were {how} (" in says


def test_pictures_without_edges_tell_nothing_of_registration(still: Frames, tmp_path: Path, capsys: Capture) -> None:
    rng = np.random.default_rng(0)
    for name, level, noise in (("white", 200, 3), ("gray", 128, 12)):
        plain = [(rng.normal(level, noise, rgb.shape).clip(0, 255).astype(np.uint8), depth) for rgb, depth in still[:4]]
        assert said(capsys, tmp_path / name, "registration", plain)[0] == "assumed"
    for name, eye, at in (("wall", (0.0, -1.5, 0.3), (0.0, 0, 0.3)), ("top", (0.0, -0.2, 1.3), (0.0, 0, 0))):
        frames = filmed(lambda t, eye=eye, at=at: looking(eye, at), count=4)  # type: ignore[misc]
        assert said(capsys, tmp_path / name, "registration", frames)[0] in ("ok", "assumed")


def test_pictures_that_are_to_be_turned_are_told(still: Frames, tmp_path: Path, capsys: Capture) -> None:
    """EXIF's orientation 3: upside down."""
    note = b"Exif\0\0II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x03\0\0\0\0\0\0\0"
    for name, turn, verdict in (("turned", True, "doubtful"), ("as-stored", False, "ok")):
        folder = put(tmp_path / name, still[:4], intrinsics=GIVEN, T_world_cam=None)
        for t, (rgb, _) in enumerate(still[:4]):
            (folder / f"color/{t:04d}.png").unlink()
            stored = np.ascontiguousarray(rgb[::-1, ::-1] if turn else rgb)[..., ::-1]
            jpeg = cv2.imencode(".jpg", stored, [cv2.IMWRITE_JPEG_QUALITY, 98])[1].tobytes()
            content = jpeg[:2] + b"\xff\xe1" + (len(note) + 2).to_bytes(2, "big") + note + jpeg[2:]
            (folder / f"color/{t:04d}.jpg").write_bytes(content)
        found = verdicts(capsys, folder)[1]["registration"]
        assert found[0] == verdict, found
        assert "EXIF orientation" in found[1]


def test_depth_of_another_size_is_said_to_be(still: Frames, tmp_path: Path, capsys: Capture) -> None:
    small = [(rgb, depth[::2, ::2]) for rgb, depth in still[:2]]
    verdict, says = said(capsys, tmp_path / "r", "registration", small)
    assert verdict == "refused"
    assert says.startswith("depth has pictures of 48x36, color of 96x72, so it is not registered")
