"""Situations of real users in which cameras, depth or poses were misread; beside each one that must pass untroubled."""

import re
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from dry_runs import dry_run
from filmed_scenes import FLOOR, SCENE, TABLE, WALL, Box, film, looking
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError
from real_recordings import write_png, write_yaml
from test_ros_reader import Messages, Say, instant, write_bag

from flowlab.recordings.camera_check import check_camera
from flowlab.recordings.intrinsics import Intrinsics
from flowlab.recordings.lens import Lens, lens_of, undistorted_rays, undistortion_maps

Capture = pytest.CaptureFixture[str]
SIZE = (160, 120)
K = np.array([[150.0, 0, 79.5], [0, 150.0, 59.5], [0, 0, 1]])
GIVEN: dict[str, Any] = {"fx": 150.0, "fy": 150.0, "cx": 79.5, "cy": 59.5}
POSE = looking((0.3, -0.9, 0.7))
BODY = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
ARM = Box((-0.3, 0.0, 0.25), (0.25, 0.2, 0.5), (220, 210, 60))


@pytest.fixture(scope="module")
def still() -> list[tuple[np.ndarray, np.ndarray]]:
    """A camera that stands still, and a large arm that moves."""
    return [film((*SCENE, ARM.moved((0.05 * t, 0, 0))), K, SIZE, POSE, seed=t) for t in range(5)]


def put(folder: Path, frames: Any, unit_m: float = 0.001, **keys: Any) -> Path:
    for t, (rgb, depth) in enumerate(frames):
        write_png(folder / "color" / f"{t:04d}.png", rgb)
        write_png(folder / "depth" / f"{t:04d}.png", np.rint(depth / unit_m).astype(np.uint16))
    about = {"fps": 10, "depth_unit_m": unit_m, "intrinsics": GIVEN, "T_world_cam": POSE.tolist(), **keys}
    write_yaml(folder / "recording.yaml", **{k: v for k, v in about.items() if v is not None})
    return folder


def verdicts(capsys: Capture, path: Path) -> tuple[int, dict[str, tuple[str, str]], str]:
    """Exit code, what came of each thing that was looked at, and the problem."""
    run = dry_run(capsys, path)
    return run.code, run.checks, run.problem


def test_an_untroubled_recording_has_no_doubt(
    still: list[tuple[np.ndarray, np.ndarray]], tmp_path: Path, capsys: Capture
) -> None:
    code, found, problem = verdicts(capsys, put(tmp_path / "r", still))
    assert (code, problem) == (0, "None")
    assert {v for v, _ in found.values()} <= {"ok", "assumed"}, found
    for about in ("intrinsics", "depth unit", "registration", "world", "camera"):
        assert found[about][0] == "ok", found[about]


OTHER = {"width": 160, "height": 120}


@pytest.mark.parametrize(
    ("intrinsics", "words"),
    [
        ({"fx": 300, "fy": 300, "cx": 159.5, "cy": 89.5, **OTHER}, "far from the middle"),
        ({"fx": 0.94, "fy": 1.25, "cx": 0.5, "cy": 0.5, **OTHER}, "not in pixels but shares.*fx: 150.4"),
        ({"fx": 79.5, "fy": 150, "cx": 150.0, "cy": 59.5, **OTHER}, "fx and cx look swapped.*fx: 150"),
        ({"fx": 0.94, "fy": 1.25, "cx": 79.5, "cy": 59.5}, r"shares.*fx: 150.4, fy: 150, cx: 79.5, cy: 59.5}"),
        ({"fx": 0.94, "fy": 0.94, "cx": 0.5, "cy": 0.375}, r"shares.*fx: 150.4, fy: 150.4, cx: 79.5, cy: 59.5}"),
        ({"fx": 150, "fy": 150, "cx": 0.5, "cy": 0.5}, r"shares.*fx: 150, fy: 150, cx: 79.5, cy: 59.5}"),
        ({"fx": 1.88, "fy": 2.5, "cx": 0, "cy": 0}, r"from its middle.*fx: 150.4, fy: 150, cx: 79.5, cy: 59.5}"),
        ({"fx": 150, "fy": 150, "cx": 0, "cy": 0}, r"picture's middle.*fx: 150, fy: 150, cx: 79.5, cy: 59.5}"),
        ({"fx": 3.6, "fy": 3.6, "cx": 79.5, "cy": 59.5}, r"millimeters.*fx: \.\.\., fy: \.\.\., cx: 79.5"),
        ({"fx": 150, "fy": 150, "cx": 59.5, "cy": 79.5}, "cx and cy look swapped.*cx: 79.5, cy: 59.5}"),
        ({"fx": 150, "fy": 79.5, "cx": 150, "cy": 59.5}, "fy and cx look swapped.*fy: 150.0, cx: 79.5"),
        (
            {"fx": 75, "fy": 75, "cx": 39.5, "cy": 29.5},
            "the same pictures in 80x60.*fx: 150.0, fy: 150.0, cx: 79.5, cy: 59.5}",
        ),
        (
            {"fx": 750, "fy": 750, "cx": 399.5, "cy": 299.5, **OTHER},
            "same pictures in 800x600.*fx: 150.0, .*cx: 79.5, cy: 59.5}",
        ),
        (
            {"fx": 112.5, "fy": 112.5, "cx": 59.5, "cy": 44.5},
            "same pictures in 120x90.*fx: 150.0, .*cx: 79.5, cy: 59.5}",
        ),
        ({"fx": 412.5, "fy": 412.5, "cx": 219.5, "cy": 164.5}, "the same pictures in 440x330.*fx: 150.0"),
        ({"fx": 150, "fy": 150, "cx": 20, "cy": 59.5}, r"add 'cropped: true', else write .*{fx: \.\.\."),
        ({"fx": 150, "fy": 20, "cx": 79.5, "cy": 59.5}, "differ by 650%"),
        ({"fx": 2000, "fy": 2000, "cx": 79.5, "cy": 59.5}, "field of view of 5"),
        ({**GIVEN, "width": 214, "height": 120, "cx": 106.5}, "cuts the edges off.*cx: 79.5"),
        ({"fx": 150, "fy": 150, "cx": 1.5e308, "cy": 59.5}, "as of no camera"),
        (K.T.tolist(), "is transposed; write '{fx: 150"),
        ([[150, 0, 79.5], [0, 150, 59.5]], "has the shape"),
        (
            {**GIVEN, "distortion": [0.1, 0, 0, 0, 0], "distortion_model": "ftheta"},
            "'ftheta' is not known.*equidistant",
        ),
        ({**GIVEN, "distortion": [0.1, 0, 0, 0, 0], "distortion_model": ""}, "coefficients that are not zero"),
        ({**GIVEN, "distortion": [0.1, 0, 0, 0, 9], "distortion_model": "equidistant"}, "has 5 coefficients"),
    ],
)
def test_intrinsics_that_cannot_be_are_refused(
    still: list[tuple[np.ndarray, np.ndarray]], tmp_path: Path, capsys: Capture, intrinsics: Any, words: str
) -> None:
    code, _, problem = verdicts(capsys, put(tmp_path / "r", still[:2], intrinsics=intrinsics))
    assert code == 3
    assert re.search(words, problem), problem


NUMBER = st.sampled_from([5e-324, 1e-9, 1e-3, 0.5, 1.0, 79.5, 320.0, 1e4, 1e9, 1e154, 1.7e308]) | st.floats(1e-3, 1e4)


@given(NUMBER, NUMBER, NUMBER, NUMBER, st.booleans(), st.sampled_from([(1, 1), (5, 3), (64, 48), (640, 480)]))
def test_whatever_numbers_intrinsics_are_there_is_a_verdict(
    fx: float, fy: float, cx: float, cy: float, left: bool, size: tuple[int, int]
) -> None:
    with suppress(ValidationError):
        assert check_camera("intrinsics", Intrinsics(fx=fx, fy=fy, cx=-cx if left else cx, cy=cy), size, "a.yaml")


@pytest.mark.parametrize(
    "intrinsics",
    [K.tolist(), np.pad(K, ((0, 0), (0, 1))).tolist(), {**GIVEN, "cx": 20.0, "cropped": True},
     {**GIVEN, "distortion": [0.0] * 5, "distortion_model": "whatever"}],
)  # fmt: skip
def test_intrinsics_in_other_words_are_used(
    still: list[tuple[np.ndarray, np.ndarray]], tmp_path: Path, capsys: Capture, intrinsics: Any
) -> None:
    code, found, problem = verdicts(capsys, put(tmp_path / "r", still, intrinsics=intrinsics, T_world_cam=None))
    assert (code, found["intrinsics"][0]) == (0, "ok"), problem


@pytest.mark.parametrize(
    ("model", "D"),
    [
        ("plumb_bob", (0.2, -0.1, 0.001, 0.002, 0.05)),
        ("rational_polynomial", (0.2, -0.1, 0.001, 0.002, 0.05, 0.1, 0.02, 0.01)),
        ("thin_prism", (0.1, -0.1, 0.001, 0.002, 0.0, 0.0, 0.0, 0.0, 0.01, 0.0, 0.01, 0.0)),
        ("equidistant", (-0.05, 0.01, 0.002, -0.001)),
        ("Kannala Brandt4", (-0.05, 0.01, 0.002, -0.001)),
        ("Inverse Brown Conrady", (0.2, -0.1, 0.001, 0.002, 0.05)),
    ],
)
def test_every_lens_is_straightened(model: str, D: tuple[float, ...]) -> None:
    """Where the maps look for a pixel, the lens bends its ray to; checked with OpenCV's projection."""
    lens = lens_of(model, D)
    assert lens is not None
    maps = undistortion_maps(lens, K, D, SIZE)
    pixels = np.array([[20, 15], [140, 100], [80, 60]])
    bent = np.array([[m[y, x] for m in maps] for x, y in pixels], float)
    ideal = undistorted_rays(lens, K, D, bent) * 150 + [79.5, 59.5]
    np.testing.assert_allclose(ideal, pixels, atol=1e-3)
    assert np.abs(bent - pixels).max() > 0.5
    rays = ((pixels - [79.5, 59.5]) / 150)[:, None]
    if lens is Lens.FISHEYE:
        np.testing.assert_allclose(cv2.fisheye.distortPoints(rays, K, np.array(D))[:, 0], bent, atol=1e-3)
    elif lens is Lens.PINHOLE:
        at = np.concatenate([rays[:, 0], np.ones((3, 1))], 1)
        seen = cv2.projectPoints(at, np.zeros(3), np.zeros(3), K, np.array(D))[0]
        np.testing.assert_allclose(seen[:, 0], bent, atol=1e-3)


@pytest.mark.parametrize(("unit", "written", "verdict"), [(0.001, 1.0, "refused"), (0.001, 1e-5, "refused")])
def test_a_unit_that_cannot_be_is_refused(
    still: list[tuple[np.ndarray, np.ndarray]],
    tmp_path: Path,
    capsys: Capture,
    unit: float,
    written: float,
    verdict: str,
) -> None:
    put(tmp_path / "r", still[:2], unit)
    code, found, problem = verdicts(capsys, put(tmp_path / "r", (), depth_unit_m=written))
    assert (code, found["depth unit"][0]) == (3, verdict)
    assert "'depth_unit_m: 0.001' would make that" in problem


@pytest.mark.parametrize(("serial", "unit"), [("left", 0.001), ("f0172289", 0.00025), ("043322070878", 0.001)])
def test_an_l515_is_known_by_its_serial_only(
    still: list[tuple[np.ndarray, np.ndarray]], tmp_path: Path, capsys: Capture, serial: str, unit: float
) -> None:
    camera = tmp_path / "ep" / f"cam_{serial}"
    for t, (rgb, depth) in enumerate(still):
        write_png(camera / "color" / f"{1000 + 100 * t}.png", rgb)
        write_png(camera / "depth" / f"{1000 + 100 * t}.png", np.rint(depth / unit).astype(np.uint16))
    write_yaml(tmp_path / "ep/recording.yaml", intrinsics=GIVEN)
    code, found, problem = verdicts(capsys, tmp_path / "ep")
    assert (code, found["depth unit"][0]) == (0, "assumed"), problem
    assert f"{unit:g} m a count" in found["depth unit"][1]


def test_depth_that_was_never_aligned_is_refused(tmp_path: Path, capsys: Capture) -> None:
    """Of the same size, but from a camera beside the color camera that sees more."""
    beside, wide = POSE.copy(), K.copy()
    beside[:3, 3] += 0.03 * POSE[:3, 0]
    wide[[0, 1], [0, 1]] = 115.0
    frames = [(film(SCENE, K, SIZE, POSE, seed=t)[0], film(SCENE, wide, SIZE, beside, seed=t + 9)[1]) for t in range(3)]
    code, found, problem = verdicts(capsys, put(tmp_path / "r", frames))
    assert (code, found["registration"][0]) == (3, "refused"), found["registration"]
    assert "give 'depth_intrinsics' and 'T_color_depth'" in problem
    T = np.linalg.inv(POSE) @ beside
    seen = {"fx": 115.0, "fy": 115.0, "cx": 79.5, "cy": 59.5}
    put(tmp_path / "r", (), depth_intrinsics=seen, T_color_depth=T.tolist())
    code, found, problem = verdicts(capsys, tmp_path / "r")
    assert (code, found["registration"][0]) == (0, "ok"), problem


@pytest.mark.parametrize(
    ("T", "words"),
    [
        (np.linalg.inv(POSE), "from above if T_world_cam were the inverse, world to camera"),
        (POSE @ np.diag([1.0, -1, -1, 1]), "from above if T_world_cam were in OpenGL's axes"),
        (POSE @ BODY.T, "from above if T_world_cam were that of a body (x forward, y left, z up)"),
        (np.linalg.inv(POSE @ BODY.T), "from above if T_world_cam were the inverse of a body's"),
        (np.block([[POSE[:3, :3], 1000 * POSE[:3, 3:]], [np.zeros((1, 3)), np.ones((1, 1))]]), "in millimeters"),
        (np.block([[POSE[:3, :3], 100 * POSE[:3, 3:]], [np.zeros((1, 3)), np.ones((1, 1))]]), "in centimeters;"),
    ],
)
def test_a_pose_in_other_terms_is_refused(
    still: list[tuple[np.ndarray, np.ndarray]], tmp_path: Path, capsys: Capture, T: np.ndarray, words: str
) -> None:
    code, found, problem = verdicts(capsys, put(tmp_path / "r", still, T_world_cam=T.tolist()))
    assert (code, found["world"][0]) == (3, "refused"), found["world"]
    assert words in problem


@pytest.mark.parametrize(
    ("turn", "verdict", "words"),
    [
        ((0, 0, np.pi), "doubtful", "level if the camera were turned by 180 degrees"),
        ((0, 0, -np.pi / 2), "doubtful", "level if the camera were turned by 90 degrees"),
        ((0.7, 0, 0), "doubtful", "neither a table nor a wall"),
        ((0.2, 0, 0), "assumed", "look whether that is so"),
        ((0.05, 0, 0), "ok", "level"),
    ],
)
def test_a_pose_that_tilts_the_scene_is_doubtful(
    still: list[tuple[np.ndarray, np.ndarray]], tmp_path: Path, capsys: Capture, turn: Any, verdict: str, words: str
) -> None:
    T = POSE.copy()
    T[:3, :3] = T[:3, :3] @ cv2.Rodrigues(np.array(turn, float))[0]
    code, found, _ = verdicts(capsys, put(tmp_path / "r", still[:2], T_world_cam=T.tolist()))
    assert (code, found["world"][0]) == (0, verdict), found["world"]
    assert words in found["world"][1]


def test_a_wall_is_no_tilted_table(tmp_path: Path, capsys: Capture) -> None:
    pose = looking((0.0, -1.5, 0.3), (0.0, 0.0, 0.3))
    frames = [film(SCENE, K, SIZE, pose, seed=t) for t in range(2)]
    code, found, _ = verdicts(capsys, put(tmp_path / "r", frames, T_world_cam=pose.tolist()))
    assert (code, found["world"][0]) == (0, "assumed"), found["world"]
    assert "may be a wall" in found["world"][1]


def test_a_moving_camera_is_noticed(tmp_path: Path, capsys: Capture) -> None:
    frames = [film((TABLE, WALL, FLOOR, ARM), K, SIZE, looking((0.3 - 0.03 * t, -0.9, 0.7)), seed=t) for t in range(6)]
    code, found, _ = verdicts(capsys, put(tmp_path / "r", frames))
    assert (code, found["camera"][0]) == (0, "doubtful"), found["camera"]
    assert "mm at the scene's distance" in found["camera"][1]


# --- ROS --------------------------------------------------------------------------------------------------


def say_rgbd(
    m: Messages, say: Say, frames: Any, *, topic: str = "/cam/rgb/image_raw", kind: str = "16UC1", unit: float = 0.001,
    info: dict[str, Any] | None = None, depth_info: dict[str, Any] | None = None, name: str = "/cam/depth/image_raw",
) -> None:  # fmt: skip
    camera = {**GIVEN, "width": SIZE[0], "height": SIZE[1]}
    for t, (rgb, depth) in enumerate(frames):
        if topic.endswith("/compressed"):
            content = cv2.imencode(".png", rgb[..., ::-1])[1].tobytes()
            say(topic, "sensor_msgs/msg/CompressedImage", instant(t), m.compressed(content, "rgb8; png", instant(t)))
        else:
            say(topic, "sensor_msgs/msg/Image", instant(t), m.image(rgb, "rgb8", instant(t)))
        counts = (depth / unit).astype(np.uint16 if kind == "16UC1" else np.float32)
        say(name, "sensor_msgs/msg/Image", instant(t), m.image(counts, kind, instant(t)))
    for at, changes in (("/cam/rgb/camera_info", info or {}), (f"{name.rpartition('/')[0]}/camera_info", depth_info)):
        if changes is not None:
            message = m.info(camera, instant(0))
            for key, value in changes.items():
                setattr(message, key, value)
            say(at, "sensor_msgs/msg/CameraInfo", instant(0), message)


def ros(tmp_path: Path, capsys: Capture, frames: Any, **how: Any) -> tuple[int, dict[str, tuple[str, str]], str]:
    path = write_bag(tmp_path / "rec.bag", 1, lambda m, say: say_rgbd(m, say, frames, **how))
    return verdicts(capsys, path)


BENT = np.array([0.3, -0.1, 0.0, 0.0, 0.0])
FISH = np.array([-0.05, 0.01, 0.002, -0.001])
P_OTHER = np.array([140.0, 0, 78, 0, 0, 140, 60, 0, 0, 0, 1, 0])


@pytest.mark.parametrize(
    ("how", "code", "about", "verdict", "words"),
    [
        ({}, 0, "intrinsics", "ok", "fx 150, .*no distortion"),
        ({"info": {"D": FISH, "distortion_model": "equidistant"}}, 0, "intrinsics", "ok", "equidistant of 4"),
        ({"info": {"D": BENT, "distortion_model": "plumb_bob"}}, 0, "intrinsics", "ok", "plumb_bob of 5"),
        ({"info": {"D": BENT, "distortion_model": "odd"}}, 3, "intrinsics", "refused", "'odd' is not known.*plumb_bob"),
        ({"info": {"D": BENT, "distortion_model": ""}}, 3, "intrinsics", "refused", "is ''.*not zero"),
        ({"topic": "/cam/rgb/image_rect_color", "info": {"D": BENT, "P": P_OTHER}}, 0, "intrinsics", "ok", "fx 140,"),
        ({"topic": "/cam/rgb/image_rect_color/compressed", "info": {"D": BENT, "P": P_OTHER}}, 0, "intrinsics", "ok",
         "fx 140,.*no distortion"),
        ({"info": {"width": 320, "height": 240, "binning_x": 2, "binning_y": 2,
                   "K": np.array([300.0, 0, 159, 0, 300, 119, 0, 0, 1])}}, 0, "intrinsics", "ok", "fx 150,"),
        ({"unit": 0.0001}, 3, "depth unit", "refused", "custom of ROS.*not a robot's workspace"),
        ({"kind": "32FC1"}, 3, "depth unit", "refused", "which cannot be"),
        ({"kind": "32FC1", "unit": 1.0}, 0, "depth unit", "assumed", "1 m a count, from the custom of ROS"),
        ({"depth_info": {"K": np.array([115.0, 0, 79, 0, 115, 59, 0, 0, 1])}}, 3, "camera_info", "ok",
         "not taken as registered"),
        ({"depth_info": {}}, 0, "camera_info", "ok", "with the same intrinsics"),
        ({"name": "/cam/depth_registered/image", "depth_info": {"K": np.array([115.0, 0, 79, 0, 115, 59, 0, 0, 1])}}, 3,
         "camera_info", "refused", "tells of another camera"),
    ],
)  # fmt: skip
def test_what_camera_infos_say_is_used_or_refused(
    still: list[tuple[np.ndarray, np.ndarray]], tmp_path: Path, capsys: Capture,
    how: dict[str, Any], code: int, about: str, verdict: str, words: str,
) -> None:  # fmt: skip
    frames = [(rgb, depth * (4 if how.get("unit") == 0.0001 else 1)) for rgb, depth in still[:2]]
    frames = [(rgb, depth.clip(0, 6.5)) for rgb, depth in frames] if how.get("unit") == 0.0001 else frames
    found = ros(tmp_path, capsys, frames, **how)
    assert found[1][about][0] == verdict, found
    assert re.search(words, found[1][about][1]), found[1][about]
    assert found[0] == code, found


def test_intrinsics_are_written_as_they_are_read() -> None:
    given = Intrinsics(**GIVEN, distortion=(0.1, 0, 0, 0), distortion_model="equidistant", cropped=True)
    text = given.to_yaml()
    assert Intrinsics.model_validate(yaml.safe_load(text)) == given
