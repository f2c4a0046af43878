"""A robot whose position is recorded is a measure of what the camera sees: what moves must go where that goes."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dry_runs import dry_run
from filmed_scenes import FLOOR, TABLE, THINGS, WALL, Box, film, looking
from real_recordings import write_png, write_yaml

from flowlab.recordings.parsing import RecordingSettings, parse_recording
from flowlab.recordings.robot_check import check_robot
from flowlab.recordings.verdicts import Verdict

Capture = pytest.CaptureFixture[str]
SIZE, FPS, FRAMES, UNIT_M = (160, 120), 10, 32, 0.0002
F = 150.0
K = np.array([[F, 0, 79.5], [0, F, 59.5], [0, 0, 1]])
POSE = looking((0.3, -0.9, 0.7))
GRIPPER = Box((0.0, -0.1, 0.25), (0.14, 0.1, 0.14), (220, 190, 60))
_T = np.linspace(0, 2 * np.pi, FRAMES)
_WAY = np.stack([0.2 * np.sin(_T), 0.14 * np.sin(2 * _T + 0.5), 0.1 * np.cos(3 * _T)], -1)
PLACES = _WAY + np.array(GRIPPER.center)
"""Where the gripper is in the robot's base, which is the world [m]: not along one line, nor in one plane."""
OPENGL = np.diag([1.0, -1, -1, 1])
TURNED = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The pictures of a gripper that goes about before a table and a wall."""
    folder = tmp_path_factory.mktemp("robot")
    for k, way in enumerate(_WAY):
        rgb, depth = film((TABLE, WALL, FLOOR, *THINGS, GRIPPER.moved(way)), K, SIZE, POSE, seed=k)
        write_png(folder / "color" / f"{k:04d}.png", rgb)
        write_png(folder / "depth" / f"{k:04d}.png", np.rint(depth / UNIT_M).astype(np.uint16))
    return folder


def calibrated(
    folder: Path, *, state: np.ndarray = PLACES, focal: float = F, unit_m: float = UNIT_M,
    T_world_cam: np.ndarray | None = POSE,
) -> Path:  # fmt: skip
    """The recording with another state and calibration."""
    np.save(folder / "state.npy", np.concatenate([state, np.zeros((len(state), 1))], 1))
    camera: dict[str, Any] = {"fx": focal, "fy": focal, "cx": 79.5, "cy": 59.5}
    pose = None if T_world_cam is None else T_world_cam.tolist()
    about = {"fps": FPS, "depth_unit_m": unit_m, "intrinsics": camera, "state": "state.npy", "T_world_cam": pose}
    write_yaml(folder / "recording.yaml", **about)
    return folder


@pytest.mark.parametrize("pose", [POSE, None], ids=["pose", "no pose"])
def test_what_moves_as_the_state_says_is_evidence(capsys: Capture, folder: Path, pose: np.ndarray | None) -> None:
    verdict, says = dry_run(capsys, calibrated(folder, T_world_cam=pose)).checks["robot"]
    assert verdict == "ok", says
    across, along = (float(says.split(f" times {where}")[0].split()[-1]) for where in ("as far across", "along it"))
    assert abs(across - 1) < 0.06
    assert abs(along - 1) < 0.06
    assert ("T_world_cam" in says) == (pose is not None)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"focal": 1.4 * F}, "the focal length in 'intrinsics' is 1.4"),
        ({"unit_m": 2 * UNIT_M}, "'depth_unit_m' is"),
        ({"T_world_cam": TURNED @ POSE}, "turned by 90 degrees against T_world_cam: that is wrong"),
        ({"T_world_cam": POSE @ OPENGL}, "as it says if it were in OpenGL's axes"),
    ],
    ids=["focal length", "unit", "turned", "OpenGL"],
)
def test_what_moves_otherwise_tells_which_number_is_wrong(
    capsys: Capture, folder: Path, wrong: dict[str, Any], words: str
) -> None:
    verdict, says = dry_run(capsys, calibrated(folder, **wrong)).checks["robot"]
    assert verdict == "doubtful", says
    assert words in says
    assert "recording.yaml" in says


def test_a_wrong_focal_length_is_told_without_a_pose_too(folder: Path) -> None:
    source = parse_recording(calibrated(folder, focal=F / 1.4, T_world_cam=None), RecordingSettings())
    (found,) = check_robot(source)
    assert found.verdict is Verdict.DOUBTFUL
    assert "times too small" in found.says


def _joints(places: np.ndarray) -> np.ndarray:
    """Angles of an arm with two links of 0.5 m, whose base is 0.7 m behind."""
    x, y, z = (places + np.array([0.0, 0.7, -0.15])).T
    out, far = np.hypot(x, y), np.linalg.norm([x, y, z], axis=0)
    elbow = np.arccos(1 - far**2 / 0.5)
    return np.stack([np.arctan2(y, x), np.arctan2(z, out) + (np.pi - elbow) / 2, elbow], -1)


_OTHER_STATES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "joint angles": _joints,
    "millimeters": lambda p: 1000 * p,
    "velocities": lambda p: np.gradient(p, 1 / FPS, axis=0),
    "0.3 s late": lambda p: np.roll(p, 3, axis=0),
}


def test_a_state_that_is_no_position_of_now_is_no_evidence(folder: Path) -> None:
    said = parse_recording(calibrated(folder), RecordingSettings())
    unsaid = replace(said, metadata=said.metadata.model_copy(update={"T_world_cam": None}))
    for name, state_of in _OTHER_STATES.items():
        for source in (said, unsaid):
            (state,) = source.streams.state
            streams = replace(source.streams, state=(replace(state, values=state_of(PLACES)),))
            (found,) = check_robot(replace(source, streams=streams))
            assert found.verdict is Verdict.ASSUMED, (name, found.says)
