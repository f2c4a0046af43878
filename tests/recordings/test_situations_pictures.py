"""Situations of real users in which what pictures show was misread; beside each one that must pass untroubled."""

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
    code, found, problem = verdicts(capsys, put(folder, frames, **{"intrinsics": GIVEN, "T_world_cam": None, **keys}))
    verdict, says = found[about]
    assert code == (3 if verdict == "refused" else 0), problem
    return verdict, says


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


def test_what_pictures_do_not_show_is_assumed(still: Frames, tmp_path: Path, capsys: Capture) -> None:
    rng = np.random.default_rng(0)
    dark = [(rng.normal(rgb * 0.04 + 4, 2).clip(0, 255).astype(np.uint8), depth) for rgb, depth in still]
    assert said(capsys, tmp_path / "dark", "camera", dark)[0] == "assumed"
    blurred = [
        (cv2.blur(rgb, (15, 15)), depth) for rgb, depth in filmed(lambda t: looking((0.3 - 0.01 * t, -0.9, 0.7)))
    ]
    assert said(capsys, tmp_path / "blurred", "camera", blurred)[0] == "assumed"
