"""Episodes as arrays."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from real_recordings import INTRINSICS, STEPS, K, assert_frames, colors, counts, opened, write_yaml

from flowlab.errors import DataError
from flowlab.recordings.recording import find_recordings

STATE = np.random.default_rng(0).normal(size=(STEPS, 7)).astype(np.float32)
ACTION = np.random.default_rng(1).normal(size=(STEPS, 8)).astype(np.float32)


def arrays(**changes: Any) -> dict[str, Any]:
    values = {"img": colors(), "depth": counts(), "agent_pos": STATE, "action": ACTION, **changes}
    return {k: v for k, v in values.items() if v is not None}


def write_npz(path: Path, **changes: Any) -> Path:
    write_yaml(path.with_suffix(".yaml"), fps=10, depth_unit_m=0.001, intrinsics=INTRINSICS)
    np.savez_compressed(path, **arrays(**changes))
    return path


def write_npy(folder: Path, **changes: Any) -> Path:
    folder.mkdir()
    for name, values in arrays(**changes).items():
        np.save(folder / f"{name}.npy", values)
    write_yaml(folder / "recording.yaml", fps=10, depth_unit_m=0.001, intrinsics=INTRINSICS)
    return folder


def check(path: Path) -> None:
    recording = opened(path)
    assert_frames(recording, list(range(STEPS)))
    np.testing.assert_array_equal(recording.state, STATE)
    np.testing.assert_array_equal(recording.action, ACTION)
    np.testing.assert_allclose(recording.time_s, np.arange(STEPS) / 10)
    assert recording.extras["reader"] == "arrays"


def test_a_file_of_arrays(tmp_path: Path) -> None:
    check(write_npz(tmp_path / "ep.npz"))


def test_a_folder_of_arrays(tmp_path: Path) -> None:
    check(write_npy(tmp_path / "ep"))


def test_episodes_share_a_recording_yaml_beside_them(tmp_path: Path) -> None:
    files = [write_npz(tmp_path / f"ep{k}.npz") for k in (2, 10, 1)]
    for file in files:
        file.with_suffix(".yaml").rename(tmp_path / "recording.yaml")
    assert [f.name for f in find_recordings([tmp_path])] == ["ep1.npz", "ep2.npz", "ep10.npz"]
    check(files[0])


def test_channels_may_come_first(tmp_path: Path) -> None:
    check(write_npz(tmp_path / "ep.npz", img=colors().transpose(0, 3, 1, 2), depth=counts()[:, None]))
    check(write_npy(tmp_path / "ep", depth=counts()[..., None]))


def test_times_and_intrinsics_may_be_arrays_too(tmp_path: Path) -> None:
    times = 5 + np.cumsum([0, 0.1, 0.1, 0.3, 0.1, 0.1])
    path = write_npz(tmp_path / "ep.npz", timestamps=times, K=K)
    write_yaml(path.with_suffix(".yaml"), depth_unit_m=0.001)
    recording = opened(path)
    np.testing.assert_allclose(recording.time_s, times - 5)
    np.testing.assert_array_equal(recording.camera.K, K)
    assert len(recording.extras["gaps_s"]) == 1
    assert recording.extras["origin"]["intrinsics"] == "ep.npz:K"


def test_pictures_stay_on_disk(tmp_path: Path) -> None:
    recording = opened(write_npy(tmp_path / "ep"))
    again = np.load(tmp_path / "ep" / "depth.npy", mmap_mode="r+")
    again[3] = 1234
    again.flush()
    assert (recording.frame(3).depth == np.float32(1234) * np.float32(0.001)).all()


def test_a_frame_without_depth_is_bad(tmp_path: Path) -> None:
    depth = counts()
    depth[2] = 0
    recording = opened(write_npz(tmp_path / "ep.npz", depth=depth), max_bad_share=0.2)
    assert recording.extras["bad_frames"] == [["depth[2]", "has no depth reading at all"]]
    np.testing.assert_array_equal(recording.state, STATE[[0, 1, 3, 4, 5]])


CLOUD = np.zeros((STEPS, 100, 6), np.float32)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"img": None, "depth": None, "point_cloud": CLOUD}, r"holds point clouds \('point_cloud'\) but no color and"),
        ({"depth": None, "point_cloud": CLOUD}, "tracks cannot be made from clouds"),
        ({"img": colors().astype(np.float32)}, "'img' has the type float32, expected uint8"),
        ({"img": colors()[..., 0]}, r"'img' has the shape \(6, 24, 32\), expected \(steps, height, width, 3\)"),
        ({"depth": counts()[:4]}, r"'depth' has the shape \(4, 24, 32\), expected \(6, height, width\)"),
        ({"action": ACTION[:4]}, r"'action' is float32 \(4, 8\), expected numbers \(6, width\)"),
        ({"agent_pos": STATE * np.nan}, "'agent_pos' holds values that are not finite"),
        ({"episode_ends": np.array([3, 6])}, "holds 2 episodes, one after the other; write one file per episode"),
        ({"timestamp": np.arange(4)}, r"'timestamp' is int64 \(4,\), expected numbers \(6,\)"),
        ({"depth": np.zeros((6, 24, 32), np.uint8)}, "none of 6 frames can be used.*has the type uint8"),
    ],
)
def test_what_does_not_fit_is_one_sentence(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    path = write_npz(tmp_path / "ep.npz", **changes)
    assert find_recordings([tmp_path]) == [path], "recognized, so that the reason is said"
    with pytest.raises(DataError, match=message):
        opened(path)


def test_missing_times_are_said_with_the_line(tmp_path: Path) -> None:
    path = write_npz(tmp_path / "ep.npz")
    write_yaml(path.with_suffix(".yaml"), depth_unit_m=0.001, intrinsics=INTRINSICS)
    with pytest.raises(DataError, match=r"has no times; write 'fps: 10' \(steps per second\) into ep\.yaml"):
        opened(path)


def test_a_damaged_file_is_named(tmp_path: Path) -> None:
    path = write_npz(tmp_path / "ep.npz")
    content = bytearray(path.read_bytes())
    content[200:260] = bytes(60)
    path.write_bytes(bytes(content))
    with pytest.raises(DataError, match=r"ep\.npz: img\.npy: not a readable NumPy file"):
        opened(path)


def test_other_files_are_no_recordings(tmp_path: Path) -> None:
    np.savez(tmp_path / "ground_truth.npz", tracks_cam=np.zeros(3))
    (tmp_path / "broken.npz").write_bytes(b"PK")
    with pytest.raises(Exception, match="no recording at or below it"):
        find_recordings([tmp_path])
