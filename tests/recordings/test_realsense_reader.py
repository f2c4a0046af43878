"""``.bag`` files of the RealSense SDK: written here as the SDK does, and read by the SDK within Open3D."""

import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from real_recordings import colors, counts, opened, said, write_png
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from test_ros_reader import say_robot_and_camera, write_kind

from flowlab.errors import DataError, MissingLibraryError
from flowlab.recordings.readers import realsense
from flowlab.recordings.recording import RecordingSettings, describe, find_recordings

SIZE = (160, 120)
K = np.array([[125.0, 0, 79.5], [0, 126.0, 58.5], [0, 0, 1]])
STEPS, FPS = 6, 30
UNIT = 0.0005


def write_sdk_bag(path: Path, steps: int = STEPS) -> Path:
    """A bag as librealsense 2.5x writes it; its Image has the unit of depth as a last field, which ROS's has not."""
    store = get_typestore(Stores.ROS1_NOETIC)
    stream_info = "uint32 fps\nstring encoding\nbool is_recommended\n"
    store.register(get_types_from_msg(stream_info, "realsense_msgs/msg/StreamInfo"))
    types = store.types
    with Writer(path) as writer:
        connections: dict[str, Any] = {}

        def say(topic: str, kind: str, time_ns: int, message: Any, more: bytes = b"") -> None:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(connections[topic], time_ns, bytes(store.serialize_ros1(message, kind)) + more)

        _say_device(types, say)
        for t in range(steps):
            for sensor, (stream, pictures) in enumerate(
                (("Depth", counts(steps, SIZE)), ("Color", colors(steps, SIZE)))
            ):
                image = f"/device_0/sensor_{sensor}/{stream}_0/image"
                time_ns = 10**6 + round(t * 1e9 / FPS)
                message = _image(types, pictures[t], t, time_ns)
                say(f"{image}/data", "sensor_msgs/msg/Image", time_ns, message, np.float32(UNIT).tobytes())
                for key, value in (("system_time", "0.0"), ("timestamp_domain", "System Time")):
                    said = types["diagnostic_msgs/msg/KeyValue"](key=key, value=value)
                    say(f"{image}/metadata", "diagnostic_msgs/msg/KeyValue", time_ns, said)
    return path


def _image(types: Any, picture: np.ndarray, t: int, time_ns: int) -> Any:
    stamp = types["builtin_interfaces/msg/Time"](1_700_000_000, time_ns)
    raw = np.ascontiguousarray(picture).view(np.uint8).reshape(len(picture), -1)
    return types["sensor_msgs/msg/Image"](
        header=types["std_msgs/msg/Header"](seq=t + 1, stamp=stamp, frame_id="1"),
        height=SIZE[1], width=SIZE[0], encoding="mono16" if picture.ndim == 2 else "rgb8", is_bigendian=0,
        step=raw.shape[1], data=raw.ravel(),
    )  # fmt: skip


def _say_device(types: Any, say: Callable[..., None]) -> None:
    """What the SDK says once, at the beginning of time."""
    say("/file_version", "std_msgs/msg/UInt32", 1, types["std_msgs/msg/UInt32"](data=4))
    for topic, key, value in (
        ("/device_0/info", "Name", "Intel RealSense D435"),
        ("/device_0/info", "Serial Number", "123456"),
        ("/device_0/sensor_0/info", "Name", "Stereo Module"),
        ("/device_0/sensor_1/info", "Name", "RGB Camera"),
    ):
        said = types["diagnostic_msgs/msg/KeyValue"](key=key, value=value)
        say(topic, "diagnostic_msgs/msg/KeyValue", 1, said)
    unit = types["std_msgs/msg/Float32"](data=UNIT)
    say("/device_0/sensor_0/option/Depth_Units/value", "std_msgs/msg/Float32", 1, unit)
    said = types["std_msgs/msg/String"](data="meters per count")
    say("/device_0/sensor_0/option/Depth_Units/description", "std_msgs/msg/String", 1, said)
    nowhere = types["std_msgs/msg/Header"](seq=0, stamp=types["builtin_interfaces/msg/Time"](0, 0), frame_id="")
    info = types["sensor_msgs/msg/CameraInfo"](
        header=nowhere, height=SIZE[1], width=SIZE[0], distortion_model="Brown Conrady", D=np.zeros(5), K=K.ravel(),
        R=np.eye(3).ravel(), P=np.zeros(12), binning_x=0, binning_y=0,
        roi=types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False),
    )  # fmt: skip
    pose = types["geometry_msgs/msg/Transform"](
        translation=types["geometry_msgs/msg/Vector3"](0, 0, 0),
        rotation=types["geometry_msgs/msg/Quaternion"](0, 0, 0, 1),
    )
    for stream, encoding in (("sensor_0/Depth_0", "mono16"), ("sensor_1/Color_0", "rgb8")):
        about = types["realsense_msgs/msg/StreamInfo"](fps=FPS, encoding=encoding, is_recommended=True)
        say(f"/device_0/{stream}/info", "realsense_msgs/msg/StreamInfo", 1, about)
        say(f"/device_0/{stream}/info/camera_info", "sensor_msgs/msg/CameraInfo", 1, info)
        say(f"/device_0/{stream}/tf/1", "geometry_msgs/msg/Transform", 1, pose)


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "flowlab" / "realsense"


@pytest.fixture
def sdk_bag(tmp_path: Path) -> Path:
    return write_sdk_bag(tmp_path / "desk.bag")


def needs_open3d() -> None:
    try:
        import open3d  # noqa: F401
    except (ImportError, OSError) as error:
        pytest.skip(f"Open3D cannot be loaded: {error}")


@pytest.mark.slow  # the SDK plays in real time: on a busy machine it drops pictures, and pairs what is left
def test_the_sdk_reads_its_bag_and_so_do_we(sdk_bag: Path, cache: Path) -> None:
    """It may drop a frame, and on a busy machine then pairs color with depth of another; it never alters one."""
    needs_open3d()
    assert find_recordings([sdk_bag.parent]) == [sdk_bag]
    recording = opened(sdk_bag)
    assert 2 <= len(recording) <= STEPS
    np.testing.assert_array_equal(recording.camera.K, K)
    assert recording.extras["depth_unit_m"] == UNIT
    assert said(recording, "registration").startswith("depth is registered to color, as the layout says")
    steps = np.diff(recording.time_s) * FPS
    np.testing.assert_allclose(steps, np.maximum(np.rint(steps), 1), atol=1e-6)  # more than 1 where one was dropped
    truth, seen_t = counts(STEPS, SIZE).astype(np.float32) * np.float32(UNIT), []
    for k in range(len(recording)):
        frame = recording.frame(k)
        t = int(np.argmin(np.abs(truth - frame.depth).mean((1, 2))))
        # The SDK's own registration rounds and fills: the truth is a ramp of 3 and 2 counts per pixel.
        assert np.quantile(np.abs(frame.depth - truth[t]), 0.9) <= 5 * UNIT
        off = [np.abs(np.asarray(frame.rgb, int) - color).mean() for color in colors(STEPS, SIZE).astype(int)]
        assert min(off) < 4, "JPEG, no more"
        assert len(recording) < STEPS or off[t] < 4
        seen_t.append(t)
    assert seen_t == sorted(set(seen_t))


def test_frames_that_came_twice_are_left_out(tmp_path: Path) -> None:
    for name, t in (("00000", 1), ("00001", 0), ("00002", 0), ("00003", 1), ("00004", 2)):
        write_png(tmp_path / "color" / f"{name}.jpg", colors()[t])
        write_png(tmp_path / "depth" / f"{name}.png", counts()[t])
    realsense._drop_repeats(tmp_path)
    for folder in ("color", "depth"):
        assert sorted(f.stem for f in (tmp_path / folder).iterdir()) == ["00000", "00001", "00002"]
    for t in range(3):
        color = cv2.imread(str(tmp_path / "color" / f"0000{t}.jpg"))
        assert color is not None
        assert np.abs(color[..., ::-1].astype(int) - colors()[t]).mean() < 3
        depth = cv2.imread(str(tmp_path / "depth" / f"0000{t}.png"), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(depth, counts()[t])


def test_a_bag_is_extracted_once(sdk_bag: Path, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    needs_open3d()
    first = realsense.extracted(sdk_bag)
    assert first.parent == cache
    assert [f.name for f in cache.iterdir()] == [first.name]
    monkeypatch.setitem(sys.modules, "open3d", None)
    assert realsense.extracted(sdk_bag) == first
    os.utime(sdk_bag, (1, 1))
    with pytest.raises(MissingLibraryError, match=r"apt-get install libusb-1\.0-0"):
        realsense.extracted(sdk_bag)


def test_a_damaged_bag_is_one_sentence(sdk_bag: Path, cache: Path) -> None:
    needs_open3d()
    sdk_bag.write_bytes(sdk_bag.read_bytes()[:300_000])
    with pytest.raises(DataError, match=r"desk\.bag: (Open3D cannot|holds no pair)"):
        opened(sdk_bag, reader="realsense")
    assert list(cache.iterdir()) == []


def test_bags_are_told_apart(tmp_path: Path, sdk_bag: Path) -> None:
    general = write_kind(tmp_path, "bag", say_robot_and_camera)
    assert realsense.is_sdk_bag(sdk_bag)
    assert not realsense.is_sdk_bag(general)
    (tmp_path / "other.bag").write_bytes(b"#ROSBAG V1.2\n")
    assert not realsense.is_sdk_bag(tmp_path / "other.bag")
    assert describe(general, RecordingSettings()).reader == "ros"
    with pytest.raises(
        DataError, match="is no bag of the RealSense SDK; a general ROS bag is read by the reader 'ros'"
    ):
        opened(general, reader="realsense")


def test_a_bag_that_was_never_closed_is_told_apart_too(sdk_bag: Path) -> None:
    """Without the list of topics at its end, the topics at its start tell."""
    content = bytearray(sdk_bag.read_bytes())
    at = content.find(b"index_pos=") + len(b"index_pos=")
    content[at : at + 8] = bytes(8)
    sdk_bag.write_bytes(bytes(content))
    assert realsense.is_sdk_bag(sdk_bag)
