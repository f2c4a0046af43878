"""ROS 1 bags and ROS 2 recordings, written by the rosbags package."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from real_recordings import INTRINSICS, STEPS, WIDTH, K, assert_frames, colors, counts, opened, said, write_yaml
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from flowlab.errors import DataError, MissingLibraryError
from flowlab.recordings.readers.ros_messages import relative_pose
from flowlab.recordings.recording import RecordingSettings, describe, find_recordings

START_NS = 1_700_000_000_000_000_000
STEP_NS = 100_000_000
COLOR, DEPTH, ALIGNED = (
    "/camera/color/image_raw",
    "/camera/depth/image_rect_raw",
    "/camera/aligned_depth_to_color/image_raw",
)


class Messages:
    """Makes messages of ROS 1 or 2."""

    def __init__(self, version: int) -> None:
        self.version = version
        self.store = get_typestore(Stores.ROS1_NOETIC if version == 1 else Stores.ROS2_HUMBLE)

    def make(self, kind: str, **fields: Any) -> Any:
        return self.store.types[kind](**fields)

    def header(self, time_ns: int, frame: str) -> Any:
        seq = {"seq": 0} if self.version == 1 else {}
        stamp = self.make("builtin_interfaces/msg/Time", sec=time_ns // 10**9, nanosec=time_ns % 10**9)
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id=frame, **seq)

    def image(self, picture: np.ndarray, encoding: str, time_ns: int, frame: str = "color", pad: int = 0) -> Any:
        raw = np.ascontiguousarray(picture).view(np.uint8).reshape(len(picture), -1)
        raw = np.pad(raw, ((0, 0), (0, pad)))
        return self.make(
            "sensor_msgs/msg/Image", header=self.header(time_ns, frame), height=len(picture), width=picture.shape[1],
            encoding=encoding, is_bigendian=0, step=raw.shape[1], data=raw.ravel(),
        )  # fmt: skip

    def compressed(self, content: bytes, kind: str, time_ns: int, frame: str = "color") -> Any:
        return self.make(
            "sensor_msgs/msg/CompressedImage", header=self.header(time_ns, frame), format=kind,
            data=np.frombuffer(content, np.uint8),
        )  # fmt: skip

    def info(
        self, camera: Mapping[str, float], time_ns: int, frame: str = "color", D: tuple[float, ...] = (0,) * 5
    ) -> Any:
        matrix = np.array([camera["fx"], 0, camera["cx"], 0, camera["fy"], camera["cy"], 0, 0, 1], float)
        P = np.insert(matrix.reshape(3, 3), 3, 0, axis=1).ravel()
        names = ("D", "K", "R", "P") if self.version == 1 else ("d", "k", "r", "p")
        values = dict(zip(names, (np.array(D, float), matrix, np.eye(3).ravel(), P), strict=True))
        roi = self.make("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        return self.make(
            "sensor_msgs/msg/CameraInfo", header=self.header(time_ns, frame), height=int(camera["height"]),
            width=int(camera["width"]), distortion_model="plumb_bob", binning_x=0, binning_y=0, roi=roi, **values,
        )  # fmt: skip

    def joints(self, position: np.ndarray, time_ns: int) -> Any:
        none = np.zeros(0)
        return self.make(
            "sensor_msgs/msg/JointState", header=self.header(time_ns, ""), name=[f"j{k}" for k in range(len(position))],
            position=np.array(position, float), velocity=none, effort=none,
        )  # fmt: skip

    def transform(self, parent: str, child: str, T: np.ndarray) -> Any:
        q = Rotation.from_matrix(T[:3, :3]).as_quat()
        rotation = self.make("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", map(float, q), strict=True)))
        translation = self.make("geometry_msgs/msg/Vector3", **dict(zip("xyz", map(float, T[:3, 3]), strict=True)))
        both = self.make("geometry_msgs/msg/Transform", translation=translation, rotation=rotation)
        kind = "geometry_msgs/msg/TransformStamped"
        return self.make(kind, header=self.header(0, parent), child_frame_id=child, transform=both)


Say = Callable[[str, str, int, Any], None]


def write_bag(path: Path, version: int, say_all: Callable[[Messages, Say], None]) -> Path:
    """A recording with what ``say_all`` says: topic, type, time [ns], message."""
    messages = Messages(version)
    plugin = StoragePlugin.MCAP if path.suffix == ".mcap" else StoragePlugin.SQLITE3
    folder = path if version == 1 else path.with_suffix("")
    with Writer1(path) if version == 1 else Writer2(folder, version=8, storage_plugin=plugin) as writer:
        connections: dict[str, Any] = {}

        def say(topic: str, kind: str, time_ns: int, message: Any) -> None:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=messages.store)  # type: ignore[arg-type]
            serialize = messages.store.serialize_ros1 if version == 1 else messages.store.serialize_cdr
            writer.write(connections[topic], time_ns, bytes(serialize(message, kind)))

        say_all(messages, say)
    return folder


def instant(t: int) -> int:
    return START_NS + t * STEP_NS


def say_camera(m: Messages, say: Say, *, aligned: bool = True, depth: bool = True, name: str = "camera") -> None:
    """A RealSense as its ROS driver publishes it; messages are recorded 5 ms after they were taken."""
    image, info = "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo"
    for t in range(STEPS):
        now, late = instant(t), instant(t) + 5_000_000
        color, topic = COLOR.replace("camera", name), (ALIGNED if aligned else DEPTH).replace("camera", name)
        say(color, image, late, m.image(colors()[t], "rgb8", now, pad=4))
        say(f"/{name}/color/camera_info", info, late, m.info(INTRINSICS, now))
        if depth:
            frame = "color" if aligned else "depth"
            say(topic, image, late + 10**6, m.image(counts()[t], "16UC1", now + 2 * 10**6, frame))
            say(topic.rpartition("/")[0] + "/camera_info", info, late, m.info(INTRINSICS, now, frame))


def say_joints(m: Messages, say: Say) -> None:
    for k in range(3 * STEPS):
        time_ns = START_NS + k * STEP_NS // 3
        say("/joint_states", "sensor_msgs/msg/JointState", time_ns, m.joints(np.arange(7) + k, time_ns))


def say_robot_and_camera(m: Messages, say: Say) -> None:
    say_camera(m, say)
    say_joints(m, say)


def write_kind(tmp_path: Path, kind: str, say_all: Callable[[Messages, Say], None]) -> Path:
    """One of the three kinds of recording, or a single file of one."""
    if kind == "bag":
        return write_bag(tmp_path / "rec.bag", 1, say_all)
    folder = write_bag(tmp_path / f"rec.{kind.removesuffix(' file')}", 2, say_all)
    return next(f for f in folder.iterdir() if f.suffix != ".yaml") if kind.endswith("file") else folder


@pytest.mark.parametrize("kind", ["bag", "mcap", "db3", "mcap file", "db3 file"])
def test_every_kind_of_recording_is_read(tmp_path: Path, kind: str) -> None:
    path = write_kind(tmp_path, kind, say_robot_and_camera)
    if not kind.endswith("file"):
        assert find_recordings([tmp_path]) == [path]
    recording = opened(path)
    assert_frames(recording, list(range(STEPS)))
    np.testing.assert_array_equal(recording.camera.K, K)
    np.testing.assert_allclose(recording.time_s, np.arange(STEPS) / 10, atol=1e-6)
    np.testing.assert_array_equal(recording.state, np.arange(7) + 3 * np.arange(STEPS)[:, None])
    assert recording.extras["reader"] == "ros"
    assert said(recording, "registration").startswith("depth is registered to color, as the layout says")
    assert recording.extras["depth_unit_m"] == 0.001
    assert recording.extras["origin"]["intrinsics"] == "/camera/color/camera_info"
    assert recording.extras["max_sync_error_s"]["depth"] == pytest.approx(0.002, abs=1e-5)


def test_compressed_pictures_of_either_kind(tmp_path: Path) -> None:
    def say_all(m: Messages, say: Say) -> None:
        for t in range(STEPS):
            bgr = np.ascontiguousarray(colors()[t][..., ::-1])
            color = cv2.imencode(".png", bgr)[1].tobytes()
            depth = bytes(12) + cv2.imencode(".png", counts()[t])[1].tobytes()
            kind, now = "sensor_msgs/msg/CompressedImage", instant(t)
            say(f"{COLOR}/compressed", kind, now, m.compressed(color, "rgb8; png compressed bgr8", now))
            say(f"{ALIGNED}/compressedDepth", kind, now, m.compressed(depth, "16UC1; compressedDepth", now))
            say("/camera/color/camera_info", "sensor_msgs/msg/CameraInfo", now, m.info(INTRINSICS, now))

    assert_frames(opened(write_kind(tmp_path, "mcap", say_all)), list(range(STEPS)))


@pytest.mark.parametrize(
    ("encoding", "convert"),
    [
        ("bgr8", lambda rgb: rgb[..., ::-1]),
        ("rgba8", lambda rgb: np.dstack([rgb, np.full(rgb.shape[:2], 9, np.uint8)])),
        ("bgra8", lambda rgb: np.dstack([rgb[..., ::-1], np.full(rgb.shape[:2], 9, np.uint8)])),
    ],
)
def test_color_of_any_order(tmp_path: Path, encoding: str, convert: Callable[[np.ndarray], np.ndarray]) -> None:
    def say_all(m: Messages, say: Say) -> None:
        for t in range(2):
            say(COLOR, "sensor_msgs/msg/Image", instant(t), m.image(convert(colors()[t]), encoding, instant(t)))
            meters = counts()[t].astype(np.float32) * np.float32(0.001)
            meters[meters == 0] = np.nan
            say(ALIGNED, "sensor_msgs/msg/Image", instant(t), m.image(meters, "32FC1", instant(t)))
            say("/camera/color/camera_info", "sensor_msgs/msg/CameraInfo", instant(t), m.info(INTRINSICS, instant(t)))

    recording = opened(write_kind(tmp_path, "bag", say_all))
    assert_frames(recording, [0, 1])
    assert recording.extras["depth_unit_m"] == 1.0, "REP 118: floats are meters"


def test_stamps_from_another_clock_are_not_taken(tmp_path: Path) -> None:
    """The camera counts from when it was switched on; the robot's messages have no stamp at all."""

    def say_all(m: Messages, say: Say) -> None:
        for t in range(STEPS):
            boot = (t * STEP_NS) + 10**9
            say(COLOR, "sensor_msgs/msg/Image", instant(t), m.image(colors()[t], "rgb8", boot))
            say(ALIGNED, "sensor_msgs/msg/Image", instant(t), m.image(counts()[t], "16UC1", boot))
            say("/camera/color/camera_info", "sensor_msgs/msg/CameraInfo", instant(t), m.info(INTRINSICS, boot))
            value = m.make("std_msgs/msg/Float64", data=float(t))
            say("/gripper", "std_msgs/msg/Float64", instant(t) + 1000, value)

    path = write_kind(tmp_path, "bag", say_all)
    write_yaml(tmp_path / "rec.yaml", topics={"state": "/gripper"})
    recording = opened(path)
    np.testing.assert_array_equal(recording.state[:, 0], np.arange(STEPS))
    assert any("another clock" in check["says"] for check in recording.extras["checks"])


def test_messages_recorded_out_of_order_are_sorted(tmp_path: Path) -> None:
    order = [0, 2, 1, 3, 5, 4]

    def say_all(m: Messages, say: Say) -> None:
        for k, t in enumerate(order):
            late = instant(k // 2)  # two messages share each time of recording
            say(COLOR, "sensor_msgs/msg/Image", late, m.image(colors()[t], "rgb8", instant(t)))
            say(ALIGNED, "sensor_msgs/msg/Image", late, m.image(counts()[t], "16UC1", instant(t)))
        say("/camera/color/camera_info", "sensor_msgs/msg/CameraInfo", instant(0), m.info(INTRINSICS, instant(0)))

    for kind in ("bag", "mcap", "db3"):
        folder = tmp_path / kind.replace(" ", "-")
        folder.mkdir()
        assert_frames(opened(write_kind(folder, kind, say_all)), list(range(STEPS)))


# --- which topics -----------------------------------------------------------------------------------------


def test_two_cameras_must_be_told_apart(tmp_path: Path) -> None:
    def say_all(m: Messages, say: Say) -> None:
        say_camera(m, say, name="left")
        say_camera(m, say, name="right")

    path = write_kind(tmp_path, "bag", say_all)
    with pytest.raises(
        DataError,
        match=r"2 topics may be color: /left/color/image_raw \(6 pictures\), /right/.*; choose one in rec\.yaml or the "
        r"calibration file: 'topics: \{color: /left/color/image_raw\}'",
    ):
        opened(path)
    given = write_yaml(tmp_path / "c.yaml", topics={"color": "/right/color/image_raw"})
    recording = opened(path, calibration=given)
    assert_frames(recording, list(range(STEPS)))
    notes = [check["says"] for check in recording.extras["checks"]]
    assert "/right/aligned_depth_to_color/image_raw" in notes[0], "the depth of the same camera"


def test_a_topic_that_is_not_there_is_named(tmp_path: Path) -> None:
    path = write_kind(tmp_path, "bag", say_robot_and_camera)
    given = write_yaml(tmp_path / "c.yaml", topics={"depth": "/camera/deep"})
    with pytest.raises(DataError, match=r"has no topic '/camera/deep' \(depth\); it has /camera/aligned_depth"):
        opened(path, calibration=given)


def test_a_topic_of_another_kind_is_refused(tmp_path: Path) -> None:
    path = write_kind(tmp_path, "bag", say_robot_and_camera)
    given = write_yaml(tmp_path / "c.yaml", topics={"color": "/joint_states"})
    with pytest.raises(DataError, match=r"/joint_states \(color\) holds sensor_msgs/msg/JointState, expected .*Image"):
        opened(path, calibration=given)
    given = write_yaml(tmp_path / "c.yaml", topics={"state": COLOR.replace("image_raw", "camera_info")})
    assert opened(path, calibration=given).state.shape[1] > 20, "any message with a fixed number of numbers will do"


def test_no_depth_is_said_with_what_there_is(tmp_path: Path) -> None:
    path = write_kind(tmp_path, "mcap", lambda m, say: say_camera(m, say, depth=False))
    with pytest.raises(
        DataError, match=r"no topic is known as depth; it has .*/camera/color/image_raw \(rgb8 pictures"
    ):
        opened(path)


def test_an_encoding_that_is_not_read_is_named(tmp_path: Path) -> None:
    def say_bayer(m: Messages, say: Say) -> None:
        for t in range(STEPS):
            say(COLOR, "sensor_msgs/msg/Image", instant(t), m.image(colors()[t, ..., 0], "bayer_rggb8", instant(t)))
            say(DEPTH, "sensor_msgs/msg/Image", instant(t), m.image(counts()[t], "16UC1", instant(t), "depth"))

    with pytest.raises(
        DataError, match=r"no topic is known as color; .*bayer_rggb8 is not read: convert color to rgb8"
    ):
        opened(write_kind(tmp_path, "mcap", say_bayer))


def test_aligned_depth_is_preferred(tmp_path: Path) -> None:
    def say_all(m: Messages, say: Say) -> None:
        say_camera(m, say)
        for t in range(STEPS):
            say(DEPTH, "sensor_msgs/msg/Image", instant(t), m.image(counts()[0], "16UC1", instant(t), "depth"))
            infra = m.image(colors()[t, ..., 0], "mono8", instant(t), "depth")
            say("/camera/infra1/image_rect_raw", "sensor_msgs/msg/Image", instant(t), infra)

    assert_frames(opened(write_kind(tmp_path, "bag", say_all)), list(range(STEPS)))


def test_actions_come_from_a_topic_that_is_named(tmp_path: Path) -> None:
    def say_all(m: Messages, say: Say) -> None:
        say_robot_and_camera(m, say)
        for t in range(STEPS):
            point = m.make("geometry_msgs/msg/Point", x=float(t), y=2.0, z=3.0)
            turn = m.make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
            pose = m.make("geometry_msgs/msg/Pose", position=point, orientation=turn)
            stamped = m.make("geometry_msgs/msg/PoseStamped", header=m.header(instant(t) + 10**6, "base"), pose=pose)
            say("/command", "geometry_msgs/msg/PoseStamped", instant(t) + 50, stamped)

    path = write_kind(tmp_path, "mcap", say_all)
    write_yaml(path / "recording.yaml", topics={"action": "/command"})
    recording = opened(path)
    expected = [[max(t - 1, 0), 2, 3, 0, 0, 0, 1] for t in range(STEPS)]
    np.testing.assert_array_equal(recording.action, expected)
    assert recording.state.shape == (STEPS, 7)


# --- depth that is not registered -------------------------------------------------------------------------


def test_unregistered_depth_asks_for_the_transform(tmp_path: Path) -> None:
    path = write_kind(tmp_path, "bag", lambda m, say: say_camera(m, say, aligned=False))
    with pytest.raises(DataError, match=r"is not registered to color \(32x24\); .* 'T_color_depth: \[\["):
        opened(path)
    given = write_yaml(tmp_path / "c.yaml", T_color_depth=np.eye(4).tolist())
    recording = opened(path, calibration=given)
    assert_frames(recording, list(range(STEPS)))
    assert said(recording, "registration").startswith("depth is registered to color by flowlab")
    assert recording.extras["origin"]["depth_intrinsics"] == "/camera/depth/camera_info"


def test_unregistered_depth_without_a_camera_info_is_not_taken_as_registered(tmp_path: Path) -> None:
    def say_all(m: Messages, say: Say) -> None:
        for t in range(2):
            say(COLOR, "sensor_msgs/msg/Image", instant(t), m.image(colors()[t], "rgb8", instant(t)))
            say("/camera/color/camera_info", "sensor_msgs/msg/CameraInfo", instant(t), m.info(INTRINSICS, instant(t)))
            say(DEPTH, "sensor_msgs/msg/Image", instant(t), m.image(counts()[t], "16UC1", instant(t), "depth"))

    with pytest.raises(DataError, match=r"'depth_intrinsics: \{width: 32.*' and 'T_color_depth"):
        opened(write_kind(tmp_path, "bag", say_all))


def test_static_transforms_register_depth(tmp_path: Path) -> None:
    """The two cameras hang on one body, the depth camera 50 mm to the right of color: a wall shifts by f b / z."""
    T_body_color, T_body_depth = np.eye(4), np.eye(4)
    turn = Rotation.from_euler("xyz", [0.3, -0.8, 2.0]).as_matrix()
    T_body_color[:3, :3] = T_body_depth[:3, :3] = turn
    T_body_depth[:3, 3] = turn @ [0.05, 0, 0]

    def say_all(m: Messages, say: Say) -> None:
        say_camera(m, say, aligned=False)
        transforms = [m.transform("body", "color", T_body_color), m.transform("body", "depth", T_body_depth)]
        say("/tf_static", "tf2_msgs/msg/TFMessage", instant(0), m.make("tf2_msgs/msg/TFMessage", transforms=transforms))

    path = write_kind(tmp_path, "mcap", say_all)
    source = describe(path, RecordingSettings())
    np.testing.assert_allclose(
        np.array(source.metadata.T_color_depth), [[1, 0, 0, 0.05], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], atol=1e-12
    )
    assert source.origin["T_color_depth"] == "/tf_static"
    shift = round(30 * 0.05 / 0.75)
    frame = opened(path).frame(0)
    row = counts()[0, 12].astype(np.float32) * np.float32(0.001)
    both = frame.depth[12, shift + 1 :]
    np.testing.assert_allclose(both, row[1 : len(both) + 1], atol=0.0075)


def test_frames_that_are_not_connected_have_no_pose() -> None:
    m = Messages(2)
    T = np.eye(4)
    T[:3, 3] = 1, 2, 3
    T[:3, :3] = Rotation.random(random_state=2).as_matrix()
    tree = [m.transform("/a", "b", T), m.transform("b", "c", T)]
    np.testing.assert_allclose(relative_pose(tree, "a", "c"), T @ T, atol=1e-12)
    np.testing.assert_allclose(relative_pose(tree, "c", "a"), np.linalg.inv(T @ T), atol=1e-12)
    assert relative_pose(tree, "a", "d") is None


def test_distortion_is_taken_from_the_camera_info(tmp_path: Path) -> None:
    D = (0.1, -0.2, 0.001, 0.002, 0.0)

    def say_all(m: Messages, say: Say) -> None:
        say_camera(m, say)
        say("/camera/i", "sensor_msgs/msg/CameraInfo", instant(0), m.info(INTRINSICS, 0, D=D))

    path = write_kind(tmp_path, "bag", say_all)
    write_yaml(tmp_path / "rec.yaml", topics={"color_info": "/camera/i"})
    found = describe(path, RecordingSettings()).metadata.intrinsics
    assert found is not None
    assert found.distortion == D
    assert (found.width, found.height) == (WIDTH, 24)


def test_the_sdks_own_unit_of_depth_is_taken(tmp_path: Path) -> None:
    """The ``.db3`` files of newer RealSense SDKs are recordings of ROS that say what a count is."""

    def say_all(m: Messages, say: Say) -> None:
        say_camera(m, say)
        unit = m.make("std_msgs/msg/String", data="0.000100")
        say("/camera/sensor_0/option/Depth_Units/value", "std_msgs/msg/String", 0, unit)

    recording = opened(write_kind(tmp_path, "db3 file", say_all))
    assert recording.extras["depth_unit_m"] == 0.0001
    assert recording.frame(0).depth.max() == pytest.approx(counts()[0].max() * 1e-4)


# --- damage -----------------------------------------------------------------------------------------------


def test_a_truncated_picture_is_bad(tmp_path: Path) -> None:
    def say_all(m: Messages, say: Say) -> None:
        for t in range(STEPS):
            color = m.image(colors()[t], "rgb8", instant(t))
            if t == 2:
                color.data = color.data[:-10]
            say(COLOR, "sensor_msgs/msg/Image", instant(t), color)
            depth = m.image(counts()[t] * (t != 4), "16UC1", instant(t))
            say(ALIGNED, "sensor_msgs/msg/Image", instant(t), depth)
            say("/camera/color/camera_info", "sensor_msgs/msg/CameraInfo", instant(t), m.info(INTRINSICS, instant(t)))

    recording = opened(write_kind(tmp_path, "mcap", say_all), max_bad_share=0.5)
    assert_frames(recording, [0, 1, 3, 5])
    assert [name for name, _ in recording.extras["bad_frames"]] == [f"{COLOR}[2]", f"{ALIGNED}[4]"]


@pytest.mark.parametrize("kind", ["bag", "mcap file", "db3 file"])
def test_a_damaged_recording_is_one_sentence(tmp_path: Path, kind: str) -> None:
    path = write_kind(tmp_path, kind, say_robot_and_camera)
    path.write_bytes(path.read_bytes()[:5000])
    with pytest.raises(DataError, match=path.name) as caught:
        opened(path)
    assert "\n" not in str(caught.value)
    path.write_bytes(b"")
    with pytest.raises(DataError, match=r"is no readable ROS recording|has 0|no topic"):
        opened(path)


def test_without_rosbags_it_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_kind(tmp_path, "bag", say_robot_and_camera)
    monkeypatch.setitem(__import__("sys").modules, "rosbags.highlevel", None)
    with pytest.raises(MissingLibraryError, match=r"pip install flowlab\[ros\]"):
        opened(path)
