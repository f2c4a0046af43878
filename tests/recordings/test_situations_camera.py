"""What files and messages say of a camera: it is used, compared with what is used, or asked about, never dropped."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from filmed_scenes import looking
from real_recordings import HEIGHT, INTRINSICS, STEPS, WIDTH, K, colors, counts, write_folder, write_png, write_yaml
from test_ros_reader import Messages, Say, instant, say_camera, write_bag
from test_situations_meaning import Capture, looked_at

from flowlab.recordings.depth_unit_check import likely_unit
from flowlab.recordings.readers.ros_camera_info import rectified
from flowlab.recordings.readers.ros_topics import of_two_cameras
from flowlab.recordings.readers.tum import TUMReader
from flowlab.recordings.recording_yaml import Metadata

BENT = [0.3, -0.1, 0.0, 0.0, 0.0]
POSES = np.array([looking((0.3 - 0.02 * t, -0.9, 0.7)) for t in range(STEPS)])
ZOOMED = K * np.array([[1.3], [1.3], [1.0]])
OPEN3D = {"width": WIDTH, "height": HEIGHT, "intrinsic_matrix": K.T.ravel().tolist(), "depth_scale": 1000, "fps": 10}


# --- files of calibration -----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["intrinsic.json", "camera_intrinsic.json"])
@pytest.mark.parametrize(
    ("more", "code", "about", "verdict", "words"),
    [
        ({}, 0, "intrinsics", "ok", "no distortion"),
        ({"serial_number": "7", "distortion": [0.0] * 5}, 0, "intrinsics", "ok", "no distortion"),
        ({"distortion": BENT, "distortion_model": "plumb_bob"}, 0, "intrinsics", "ok", "plumb_bob of 5"),
        ({"dist_coeffs": [BENT]}, 0, "intrinsics", "ok", "of a pinhole of 5"),
        ({"k1": 0.3, "k2": -0.1, "p1": 0.0}, 0, "intrinsics", "ok", "of a pinhole of 8"),
        ({"D": [0.1, 0.01, 0, 0], "camera_model": "OPENCV_FISHEYE"}, 0, "intrinsics", "ok", "OPENCV_FISHEYE of 4"),
        ({"distortion": {"model": "fisheye", "coeffs": [0.1, 0, 0, 0]}}, 0, "intrinsics", "ok", "fisheye of 4"),
        (
            {"dist_coeffs": [0.3, -0.1, 0, 0, 0.2], "distortion_model": "fisheye"},
            3,
            "intrinsics",
            "refused",
            "5 coefficients",
        ),
        ({"distortion": BENT, "model": "double_sphere"}, 3, "intrinsics", "refused", "'double_sphere' is not known"),
        ({"note": "of Monday"}, 0, "calibration", "doubtful", "not read: note; .*ignore: .*json:note'"),
        ({"skew": 0.5, "note": ""}, 0, "calibration", "doubtful", "not read: note, skew; what skew says"),
        ({"extrinsic": [1]}, 0, "calibration", "doubtful", "what extrinsic says"),
    ],
)
def test_a_lens_in_a_file_is_used_or_named(
    tmp_path: Path, capsys: Capture, name: str, more: dict[str, Any], code: int, about: str, verdict: str, words: str
) -> None:
    folder = write_folder(tmp_path / "r", intrinsics=None, fps=None)
    (folder / name).write_text(json.dumps({**OPEN3D, **more}))
    found, facts, checks = looked_at(capsys, folder)
    assert (found, checks[about][0]) == (code, verdict), facts["problem"]
    assert re.search(words, checks[about][1]), checks[about]


CAMERA = {
    "c2w": (POSES, f"{STEPS} rigid transforms that change"),
    "w2c": (POSES[:, :3], "rigid transforms that change"),
    "T_wc": (POSES[0], "a rigid transform; .*'T_world_cam'"),
    "whatever": (POSES, "rigid transforms that change"),
    "camera_matrix": (np.stack([K] * 3 + [ZOOMED] * 3), "camera matrices that change"),
    "cam_K": (ZOOMED, "fx 39, .*not the one that is used"),
    "camera_intrinsics": (2 * K, "called as a camera's matrix and is none"),
    "dist_coeffs": (np.array(BENT), r"'distortion: \[0.3, -0.1, 0, 0, 0\]'"),
    "depth_scale": (np.array(0.00025), "0.00025 m a count"),
    "depth_factor": (np.array(5000.0), "0.0002 m a count"),
    "same_K": (K, ""),
    "same_unit_m": (np.array(0.001), ""),
    "depth_scale_": (np.array(1000), ""),
    "eye": (np.eye(4), ""),
    "ee_pose": (POSES, ""),
    "distance": (np.arange(STEPS) + 0.5, ""),
    "weights": (np.ones((STEPS, 3, 3)), ""),
}  # fmt: skip


@pytest.mark.parametrize("kind", ["plain", "arrays", "npz"])
@pytest.mark.parametrize("name", CAMERA)
def test_numbers_of_a_camera_that_nothing_uses_are_asked_about(
    tmp_path: Path, capsys: Capture, name: str, kind: str
) -> None:
    values, says = CAMERA[name]
    path = write_folder(tmp_path / "r") if kind == "plain" else tmp_path / "r"
    given = {"fps": 10, "depth_unit_m": 0.001, "intrinsics": INTRINSICS}
    arrays = {name: values} if kind == "plain" else {"img": colors(), "depth": counts(), name: values}
    if kind == "npz":
        path = tmp_path / "r.npz"
        np.savez(path, **arrays)  # type: ignore[arg-type]
        write_yaml(tmp_path / "r.yaml", **given)
    else:
        path.mkdir(exist_ok=True)
        for key, array in arrays.items():
            np.save(path / f"{key}.npy", array)
        write_yaml(path / "recording.yaml", **given)
    code, facts, _ = looked_at(capsys, path)
    told = [c["says"] for c in facts["checks"] if c["about"] == "camera" and name in c["says"]]
    assert (code, bool(told)) == (0, bool(says)), facts
    assert all(re.search(says, one) for one in told), told


@pytest.mark.parametrize(
    ("files", "says"),
    [
        ({f"poses/{t:04d}.txt": POSES[t] for t in range(STEPS)}, "poses/ has 6 files with a rigid transform each"),
        ({f"seq/frame-{t}.pose.txt": POSES[t] for t in range(STEPS)}, "seq/ has 6 files"),
        ({"groundtruth.txt": np.tile(np.eye(8)[7], (STEPS, 1))}, "'T_world_cam_file: groundtruth.txt'"),
        ({"transforms.json": {"frames": []}}, "transforms.json is not used"),
        ({f"force/{t:04d}.txt": np.ones((4, 4)) for t in range(STEPS)}, ""),
        ({"tcp.txt": np.ones((STEPS, 16)), "notes.json": {}}, ""),
    ],
)
def test_poses_in_files_are_asked_about(tmp_path: Path, capsys: Capture, files: dict[str, Any], says: str) -> None:
    folder = write_folder(tmp_path / "r")
    for name, values in files.items():
        (folder / name).parent.mkdir(exist_ok=True)
        if name.endswith(".json"):
            (folder / name).write_text(json.dumps(values))
        else:
            np.savetxt(folder / name, values)
    _, facts, _ = looked_at(capsys, folder)
    told = [c["says"] for c in facts["checks"] if c["about"] == "camera" and c["verdict"] == "doubtful"]
    assert bool(told) == bool(says), facts["checks"]
    assert says in "".join(told)


# --- intrinsics of other pictures ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "code", "words"),
    [
        ({"fx": 0.94, "fy": 1.25}, 3, "shares of the picture; .*fx: 30.08, fy: 30, cx: 15.2"),
        ({"cx": 11.7, "cy": 15.2}, 3, "cx and cy look swapped; .*cx: 15.2, cy: 11.7"),
        (
            {"fx": 15.0, "fy": 15.5, "cx": 7.35, "cy": 5.6},
            3,
            "the same pictures in 16x12; .*fx: 30.0, fy: 31.0, cx: 15.2",
        ),
        (
            {"fx": 150.0, "fy": 155.0, "cx": 78.0, "cy": 60.5},
            3,
            "same pictures in 160x120; .*fx: 30.0, fy: 31.0, cx: 15.2",
        ),
        ({"cx": 15.2, "cy": 8.0}, 0, "cropped: true"),
        ({}, 0, ""),
    ],
)
def test_intrinsics_of_other_pictures_say_which(
    tmp_path: Path, capsys: Capture, changes: dict[str, float], code: int, words: str
) -> None:
    folder = write_folder(tmp_path / "r", intrinsics={**INTRINSICS, **changes})
    found, _, checks = looked_at(capsys, folder)
    assert found == code, checks["intrinsics"]
    assert re.search(words, checks["intrinsics"][1]), checks["intrinsics"]
    assert "cropped" in words or "cropped" not in checks["intrinsics"][1]


@pytest.mark.parametrize(
    ("counts_", "says"), [(4400, "0.0001"), (1200, "0.001"), (0.9, "1"), (12.6, "no unit"), (1e9, "no")]
)
def test_a_unit_is_advised_only_where_it_fits(counts_: float, says: str) -> None:
    assert says in likely_unit(counts_)


# --- ROS ----------------------------------------------------------------------------------------------------


def filmed(tmp_path: Path, *, zoom: float = 1.0, bend: float = 0.0, far: float = 1.0, name: str = "image_raw") -> Path:
    """A bag whose camera zooms half way."""

    def say_all(m: Messages, say: Say) -> None:
        for t in range(STEPS):
            now, by = instant(t), zoom if t >= STEPS // 2 else 1.0
            camera = {**INTRINSICS, "fx": by * INTRINSICS["fx"], "fy": by * INTRINSICS["fy"]}
            say(f"/cam/rgb/{name}", "sensor_msgs/msg/Image", now, m.image(colors()[t], "rgb8", now))
            depth = np.minimum(far * counts()[t], 65534).astype(np.uint16)
            say("/cam/depth_registered/image", "sensor_msgs/msg/Image", now, m.image(depth, "16UC1", now))
            info = f"/cam/rgb/{name}".rpartition("/")[0] + "/camera_info"
            say(info, "sensor_msgs/msg/CameraInfo", now, m.info(camera, now, D=(bend, 0, 0, 0, 0)))

    return write_bag(tmp_path / "r.bag", 1, say_all)


@pytest.mark.parametrize(
    ("how", "given", "code", "about", "verdict", "words"),
    [
        ({}, {}, 0, "intrinsics over time", "ok", "all messages of /cam/rgb/camera_info say the same"),
        ({"zoom": 1.3}, {}, 3, "intrinsics over time", "refused", "from 32x24, fx 30, .* to 32x24, fx 39, "),
        ({"zoom": 1.004}, {}, 0, "intrinsics over time", "doubtful", "to 32x24, fx 30.12"),
        ({"zoom": 1.3}, {"intrinsics": INTRINSICS}, 0, "intrinsics over time", "doubtful", "to 32x24, fx 39"),
        ({"bend": 0.1, "name": "undistorted/image"}, {}, 0, "rectified", "assumed", "by the name: seen as P says"),
        ({"bend": 0.1, "name": "undistorted/image_raw"}, {}, 3, "rectified", "refused", "both raw and rectified"),
        ({"bend": 0.1, "name": "image"}, {}, 0, "rectified", "assumed", "taken as not rectified"),
        ({"bend": 0.1, "name": "image_rect_color"}, {}, 0, "rectified", "ok", "as the name says: seen as P says"),
        ({"bend": 0.1}, {}, 0, "rectified", "ok", "not rectified, as the name says"),
        ({}, {}, 0, "depth unit", "assumed", "0.001 m a count"),
        ({"far": 5.0}, {}, 0, "depth unit", "doubtful", "far for a robot's workspace.*'depth_unit_m: 0.0001'"),
        ({"far": 5.0}, {"depth_unit_m": 0.001}, 0, "depth unit", "ok", "0.001 m a count, from r.yaml"),
    ],
)
def test_what_messages_say_of_a_camera(
    tmp_path: Path, capsys: Capture, how: dict[str, Any], given: dict[str, Any], code: int, about: str, verdict: str,
    words: str,
) -> None:  # fmt: skip
    bag = filmed(tmp_path, **how)
    write_yaml(tmp_path / "r.yaml", **given)
    found, facts, checks = looked_at(capsys, bag)
    assert (found, checks[about][0]) == (code, verdict), (facts["problem"], checks[about])
    assert re.search(words, checks[about][1]), checks[about]


@pytest.mark.parametrize(("unit", "verdict"), [(0.001, "ok"), (0.0001, "doubtful"), (0.02, "doubtful")])
def test_a_stated_unit_is_doubted_where_no_camera_measures(
    tmp_path: Path, capsys: Capture, unit: float, verdict: str
) -> None:
    code, _, checks = looked_at(capsys, write_folder(tmp_path / "r", depth_unit_m=unit))
    assert (code, checks["depth unit"][0]) == (0, verdict), checks["depth unit"]


@pytest.mark.parametrize(
    ("name", "known"),
    [("rgbd_dataset_freiburg2_desk", True), ("uni-freiburg2", False), ("freiburg1_lab", False)],
)
def test_only_the_benchmarks_own_names_tell_its_cameras(tmp_path: Path, name: str, known: bool) -> None:
    folder = tmp_path / name
    for t in range(2):
        write_png(folder / f"rgb/{t}.png", colors()[t])
        write_png(folder / f"depth/{t}.png", counts()[t])
    for kind in ("rgb", "depth"):
        (folder / f"{kind}.txt").write_text("".join(f"{1.7e9 + t / 10:.6f} {kind}/{t}.png\n" for t in range(2)))
    given = [metadata.intrinsics for _, metadata in TUMReader().read(folder, Metadata()).known]
    assert any(given) == known


@pytest.mark.parametrize(
    ("name", "values", "words"),
    [
        ("timestamps", 5.0 * np.arange(STEPS), "write 'times: timestamps.npy'"),
        ("depth_ts", 0.1 + np.arange(STEPS), "write 'depth_times: depth_ts.npy'"),
        ("ee_states", np.random.default_rng(0).normal(size=(STEPS, 7)), "write 'state: ee_states.npy'"),
        ("observations", np.random.default_rng(0).normal(size=(STEPS, 3)), "write 'state: observations.npy'"),
        ("weights", np.ones((STEPS + 9, 3)), "float64 (15, 3)"),
        ("rising", np.arange(STEPS), "int64 (6,)"),
    ],
)
def test_a_row_for_every_picture_is_asked_about(
    tmp_path: Path, capsys: Capture, name: str, values: np.ndarray, words: str
) -> None:
    folder = write_folder(tmp_path / "r")
    np.save(folder / f"{name}.npy", values)
    code, facts, _ = looked_at(capsys, folder)
    told = [c["says"] for c in facts["checks"] if c["verdict"] == "doubtful" and name in c["says"]]
    assert (code, bool(told)) == (0, bool(words)), facts["checks"]
    assert words in "".join(told)


def test_arrays_that_may_all_be_one_thing_are_refused(tmp_path: Path, capsys: Capture) -> None:
    arrays = {"img": colors(), "depth": counts(), "state": np.eye(STEPS), "qpos": np.eye(STEPS)}
    write_yaml(tmp_path / "r.yaml", fps=10, depth_unit_m=0.001, intrinsics=INTRINSICS)
    np.savez(tmp_path / "r.npz", **arrays)
    assert looked_at(capsys, tmp_path / "r.npz")[0] == 0
    np.savez(tmp_path / "r.npz", **{**arrays, "qpos": 2 * np.eye(STEPS)})
    code, facts, _ = looked_at(capsys, tmp_path / "r.npz")
    assert (code, "state, qpos may all be the state, and are not the same" in facts["problem"]) == (3, True)


def test_topics_that_are_not_read_are_listed(tmp_path: Path, capsys: Capture) -> None:
    def say_all(m: Messages, say: Say) -> None:
        say_camera(m, say)
        for t in range(STEPS):
            now = instant(t)
            say("/camera_pose", "geometry_msgs/msg/TransformStamped", now, m.transform("world", "camera", POSES[t]))

    bag = write_bag(tmp_path / "r.bag", 1, say_all)
    code, _, checks = looked_at(capsys, bag)
    assert (code, checks["unused topics"][0]) == (0, "doubtful")
    assert "'topics: {T_world_cam: /camera_pose}'" in checks["unused topics"][1]


@pytest.mark.parametrize(
    ("topic", "straight", "verdict"),
    [
        ("/camera/color/image_rect_raw", True, "ok"),
        ("/cam/undistorted_rgb", True, "assumed"),
        ("/cam/rgb/dewarped/compressed", True, "assumed"),
        ("/cam/unrectified/image", False, "ok"),
        ("/cam/distorted/image", False, "ok"),
        ("/camera/color/image_raw", False, "ok"),
        ("/cam/rgb/image_color", False, "assumed"),
        ("/direct/rectangle/image_raw", False, "ok"),
    ],
)
def test_names_say_whether_pictures_were_rectified(topic: str, straight: bool, verdict: str) -> None:
    assert rectified(topic)[:2] == (straight, verdict)


@pytest.mark.parametrize(
    ("color", "depth", "two"),
    [
        ("/cam1/rgb/image_raw", "/cam2/depth_registered/image", True),
        ("/robot1/camera/color/image_raw", "/robot2/camera/aligned_depth_to_color/image_raw", True),
        ("/left_color/image", "/right_depth/image_raw", True),
        ("/wrist/d405/color/image", "/head/d405/aligned_depth_to_color/image", True),
        ("/camera/camera/color/image_raw", "/camera/camera/aligned_depth_to_color/image_raw", False),
        ("/camera/rgb/image_rect_color", "/camera/depth_registered/sw_registered/image_rect_raw", False),
        ("/rgb/image_raw", "/depth_to_rgb/image_raw", False),
        ("/zed/zed_node/left/image_rect_color", "/zed/zed_node/depth/depth_registered", False),
        ("/device_0/sensor_1/Color_0/image/data", "/device_0/sensor_2/Depth_0/image/data", False),
        ("/oak/rgb/image_raw", "/oak/stereo/image_raw", False),
        ("/rgb_camera/image", "/depth_camera/image", False),
    ],
)
def test_names_of_topics_tell_two_cameras(color: str, depth: str, two: bool) -> None:
    assert of_two_cameras(color, depth) == two


@pytest.mark.parametrize(
    ("depth", "stated", "verdict"),
    [("cam1", False, "ok"), ("cam2", False, "doubtful"), ("cam2", True, "assumed")],
)
def test_depth_of_another_cameras_namespace_is_doubtful(
    tmp_path: Path, capsys: Capture, depth: str, stated: bool, verdict: str
) -> None:
    """Both say the same frame, and the name of depth that it is registered."""

    def say_all(m: Messages, say: Say) -> None:
        def renamed(topic: str, *rest: Any) -> None:
            say(topic.replace("/camera/", f"/{depth}/" if "aligned" in topic else "/cam1/"), *rest)

        say_camera(m, renamed)

    topics = {"color": "/cam1/color/image_raw", "depth": f"/{depth}/aligned_depth_to_color/image_raw"}
    bag = write_bag(tmp_path / "r.bag", 1, say_all)
    write_yaml(tmp_path / "r.yaml", topics=topics if stated else None)
    code, _, checks = looked_at(capsys, bag)
    assert (code, checks["camera_info"][0]) == (0, verdict), checks["camera_info"]
    assert ("of two cameras" in checks["camera_info"][1]) == (verdict != "ok")
