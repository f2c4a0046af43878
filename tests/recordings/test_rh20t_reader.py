"""RH20T's timestamped folders."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from real_recordings import K, assert_frames, colors, counts, opened, said, write_png, write_yaml
from scipy.spatial.transform import Rotation

from flowlab.errors import DataError
from flowlab.recordings.recording import RecordingSettings, describe, find_recordings

START = 1_650_000_000_000
"""[ms]"""
MS = START + np.array([0, 101, 200, 299, 402, 500])
SERIAL = "750612070851"


def write_camera(episode: Path, serial: str = SERIAL) -> Path:
    folder = episode / f"cam_{serial}"
    for t, ms in enumerate(MS):
        write_png(folder / "color" / f"{ms}.png", colors()[t])
        write_png(folder / "depth" / f"{ms + 3}.png", counts()[t])
    return folder


def write_rows(folder: Path, values: np.ndarray, late_ms: int = 0) -> None:
    folder.mkdir(parents=True)
    for ms, row in zip(MS + late_ms, values, strict=True):
        np.save(folder / f"{ms}.npy", row)


def write_calibration(root: Path, name: str = "1649", serial: str = SERIAL) -> np.ndarray:
    """Intrinsics and pose as RH20T and RISE keep them; gives ``T_cam_marker``."""
    folder = root / "calib" / name
    folder.mkdir(parents=True)
    T = np.eye(4)
    T[:3, :3] = Rotation.random(random_state=1).as_matrix()
    T[:3, 3] = 0.1, -0.2, 0.9
    np.save(folder / "intrinsics.npy", {serial: np.hstack([K, np.zeros((3, 1))])}, allow_pickle=True)  # type: ignore[arg-type]
    np.save(folder / "extrinsics.npy", {serial: [T]}, allow_pickle=True)  # type: ignore[arg-type]
    return T


TCP = np.random.default_rng(0).normal(size=(6, 7))
GRIPPER = np.arange(6)[:, None] * np.array([[100.0, 1.0]])


@pytest.fixture
def episode(tmp_path: Path) -> Path:
    """An episode of RISE: state in the camera's folder, calibration above ``train``."""
    folder = tmp_path / "cups" / "train" / "ep_1"
    camera = write_camera(folder)
    write_rows(camera / "tcp", TCP, late_ms=4)
    write_rows(camera / "gripper_command", GRIPPER)
    write_calibration(tmp_path / "cups")
    (folder / "timestamp.txt").write_text("1649\n")
    (folder / "metadata.json").write_text(json.dumps({"finish_time": int(MS[-1])}))
    return folder


def test_an_episode_is_read_with_its_calibration(episode: Path, tmp_path: Path) -> None:
    assert find_recordings([tmp_path]) == [episode]
    recording = opened(episode)
    assert_frames(recording, list(range(6)))
    np.testing.assert_allclose(recording.time_s, (MS - MS[0]) / 1000, atol=1e-6)
    np.testing.assert_array_equal(recording.camera.K, K)
    assert said(recording, "registration").startswith("depth is registered to color, as the layout says")
    assert recording.extras["max_sync_error_s"]["depth"] == pytest.approx(0.003, abs=1e-5)
    assert (
        recording.extras["origin"]["depth_unit_m"]
        == "the custom of RH20T for all but the L515, by the serial '750612070851'"
    )


def test_the_world_is_the_marker(episode: Path, tmp_path: Path) -> None:
    """A point of the marker's frame is where its extrinsics put it in the camera."""
    stored = np.load(tmp_path / "cups/calib/1649/extrinsics.npy", allow_pickle=True).item()
    T_cam_marker = stored[SERIAL][0]
    point = np.array([0.02, 0.03, 0.0])
    in_camera = T_cam_marker[:3, :3] @ point + T_cam_marker[:3, 3]
    uv, z = opened(episode).camera.project(point)
    assert z == pytest.approx(in_camera[2])
    np.testing.assert_allclose(uv, (K @ in_camera)[:2] / in_camera[2])


def test_state_is_pose_and_gripper_and_the_next_is_the_action(episode: Path) -> None:
    recording = opened(episode)
    state = np.concatenate([TCP, GRIPPER], 1).astype(np.float32)
    np.testing.assert_array_equal(recording.state, state)
    np.testing.assert_array_equal(recording.action, np.concatenate([state[1:], state[-1:]]))
    assert recording.extras["max_sync_error_s"]["tcp"] == pytest.approx(0.004, abs=1e-5)


def test_state_may_lie_in_the_episode(tmp_path: Path) -> None:
    folder = tmp_path / "scene"
    write_camera(folder)
    write_rows(folder / "tcp", TCP)
    given = write_yaml(tmp_path / "c.yaml", intrinsics={"fx": 30, "fy": 31, "cx": 15.2, "cy": 11.7})
    recording = opened(folder, calibration=given)
    np.testing.assert_array_equal(recording.state, TCP.astype(np.float32))
    np.testing.assert_array_equal(recording.camera.T_world_cam, np.eye(4))


def test_what_comes_after_the_end_is_left_out(episode: Path) -> None:
    (episode / "metadata.json").write_text(json.dumps({"finish_time": int(MS[3]) + 50, "rating": 1}))
    recording = opened(episode)
    assert_frames(recording, [0, 1, 2, 3])
    assert not recording.success.any(), "RH20T rates failures 0 and 1"


def test_one_of_several_cameras_must_be_chosen(episode: Path, tmp_path: Path) -> None:
    write_camera(episode, "043322070878")
    with pytest.raises(DataError, match=rf"has 2 cameras; choose one of 043322070878, {SERIAL} in .*'camera: \"0433"):
        opened(episode)
    assert_frames(opened(episode, calibration=write_yaml(tmp_path / "c.yaml", camera=SERIAL)), list(range(6)))
    assert_frames(opened(episode / f"cam_{SERIAL}"), list(range(6)))
    with pytest.raises(DataError, match="has no camera 9; choose one of"):
        opened(episode, calibration=write_yaml(tmp_path / "c.yaml", camera="9"))


def test_an_l515_counts_quarter_millimeters(tmp_path: Path) -> None:
    write_camera(tmp_path / "ep", "f0172289")
    intrinsics = {"fx": 30, "fy": 31, "cx": 15.2, "cy": 11.7}
    assert opened(tmp_path / "ep", calibration=write_yaml(tmp_path / "c.yaml", intrinsics=intrinsics)).frame(
        0
    ).depth.max() == pytest.approx(counts()[0].max() / 4000)


def test_what_is_missing_is_said(episode: Path, tmp_path: Path) -> None:
    (episode / "timestamp.txt").write_text("1700")
    about = describe(episode, RecordingSettings())
    assert ("calibration", "its calibration calib/1700 is not beside it") in [(c.about, c.says) for c in about.checks]
    assert about.problem is not None
    assert "intrinsics: {width: 32" in about.problem


class Evil:
    def __reduce__(self) -> tuple[Any, ...]:
        return (exec, ("raise SystemExit('it ran')",))


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("intrinsics.npy", b"broken", r"intrinsics\.npy: cannot be read"),
        ("extrinsics.npy", Evil(), r"extrinsics\.npy: cannot be read \(it asks for builtins\.exec\)"),
        ("intrinsics.npy", [1, 2], r"holds a list\); expected a mapping"),
    ],
)
def test_a_calibration_is_read_without_trust(
    episode: Path, tmp_path: Path, file: str, content: Any, message: str
) -> None:
    path = tmp_path / "cups/calib/1649" / file
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        stored = np.empty((), object)
        stored[()] = content
        np.save(path, stored, allow_pickle=True)
    with pytest.raises(DataError, match=message):
        opened(episode)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("first.npy", np.zeros(7), "'first.npy' is not named by its time"),
        (f"{MS[1] + 4}.npy", np.zeros(3), r"holds float64 \(3,\), expected 7 finite numbers"),
        (f"{MS[1] + 4}.npy", np.full(7, np.nan), "expected 7 finite numbers"),
    ],
)
def test_rows_that_do_not_fit_are_named(episode: Path, name: str, content: np.ndarray, message: str) -> None:
    np.save(episode / f"cam_{SERIAL}" / "tcp" / name, content)
    with pytest.raises(DataError, match=message):
        opened(episode)


def test_broken_metadata_is_named(episode: Path) -> None:
    (episode / "metadata.json").write_text("{")
    with pytest.raises(DataError, match=r"metadata\.json: not valid JSON"):
        opened(episode)
