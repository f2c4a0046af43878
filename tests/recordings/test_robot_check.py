"""A robot whose position is recorded is a measure of what the camera sees: what moves must go where that goes."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from dry_runs import dry_run
from filmed_scenes import FLOOR, TABLE, THINGS, WALL, Box, film, looking
from real_recordings import write_png, write_yaml

from flowlab.recordings.base import SampleStream
from flowlab.recordings.parsing import RecordingSettings, parse_recording
from flowlab.recordings.robot_check import Seen, check_robot, judge
from flowlab.recordings.robot_points import MovingPoints
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
    assert ("its rotation, 'intrinsics' and 'depth_unit_m' are right" in says) == (pose is not None)


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


def test_a_pose_that_is_a_little_off_is_not_called_right(capsys: Capture, folder: Path) -> None:
    a = np.radians(7)
    roll = np.array([[np.cos(a), -np.sin(a), 0, 0], [np.sin(a), np.cos(a), 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    verdict, says = dry_run(capsys, calibrated(folder, T_world_cam=POSE @ roll)).checks["robot"]
    assert verdict == "ok", says
    assert "turned by 7 degrees against T_world_cam, which may be off by as much" in says
    assert says.endswith("'intrinsics' and 'depth_unit_m' are right to within that")


@pytest.mark.parametrize(("pose", "frames", "told"), [(POSE, 9, False), (POSE, 12, True), (None, 12, False)])
def test_a_clip_of_which_most_agrees_is_too_short_not_wrong(
    folder: Path, pose: np.ndarray | None, frames: int, told: bool
) -> None:
    settings = RecordingSettings(stop_s=(frames - 0.5) / FPS)
    (found,) = check_robot(parse_recording(calibrated(folder, T_world_cam=pose), settings))
    assert found.verdict is (Verdict.OK if told else Verdict.ASSUMED), found.says
    assert found.says.startswith("too little is seen to move") != told


def test_two_numbers_that_are_off_alike_are_not_called_right_by_what_goes_across_the_view() -> None:
    rng, alike = np.random.default_rng(0), 1.5
    time_s = np.arange(60) / FPS
    way = 0.2 * np.stack([np.sin(time_s), np.cos(1.7 * time_s), 0 * time_s], -1)
    body = rng.uniform(-0.05, 0.05, (20, 3)) + np.array([0, 0, 0.8])
    points = []
    for k in range(0, 55, 2):
        true = [body + way[j] for j in (k, k + 2)]
        start, end = (p * [1, 1, alike] for p in true)  # as (x, y) of unit / focal length * depth
        points.append(MovingPoints((time_s[k], time_s[k + 2]), start, end - start + rng.normal(0, 1e-3, start.shape)))
    T_world_cam = np.eye(4) - [[0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0.8], [0, 0, 0, 0]]
    found = judge(Seen(tuple(points), SampleStream("state", time_s, way)), T_world_cam, "recording.yaml")
    assert found.verdict is Verdict.OK, found.says
    assert found.says.endswith("are right to within that, unless focal length and unit are off alike: little goes "
                               "along the view")  # fmt: skip


def test_a_gripper_before_a_camera_at_its_wrist_is_no_evidence(tmp_path: Path) -> None:
    texture = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 255, (60, 80, 3)).astype(np.uint8), (0, 0), 1.0)
    depth = np.zeros((60, 80), np.uint16)
    depth[15:50, 20:65] = round(0.3 / UNIT_M)
    for k in range(FRAMES):
        noise = np.random.default_rng(k).integers(0, 4, texture.shape).astype(np.uint8)
        write_png(tmp_path / "color" / f"{k:04d}.png", cv2.add(texture, noise))
        write_png(tmp_path / "depth" / f"{k:04d}.png", depth + noise[..., 0] * (depth > 0))
    poses = np.tile(POSE, (FRAMES, 1, 1))
    poses[:, :3, 3] += _WAY
    np.save(tmp_path / "T.npy", poses)
    np.save(tmp_path / "state.npy", poses[:, :3, 3] + 0.3 * POSE[:3, 2])
    for focal in (75.0, 105.0):  # whatever it is, what stays in the picture goes as the poses
        about = {"fps": FPS, "depth_unit_m": UNIT_M, "state": "state.npy", "T_world_cam_file": "T.npy"}
        camera = {"fx": focal, "fy": focal, "cx": 39.5, "cy": 29.5}
        write_yaml(tmp_path / "recording.yaml", **about, intrinsics=camera)
        (found,) = check_robot(parse_recording(tmp_path, RecordingSettings()))
        assert found.verdict is Verdict.ASSUMED, found.says


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
    "a robot that stands still": lambda p: 0 * p + p[0],
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
