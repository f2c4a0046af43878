"""The plain folder: written and read back, and what others write that looks like it."""

import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from real_recordings import (
    CAMERA,
    HEIGHT,
    INTRINSICS,
    STEPS,
    WIDTH,
    K,
    assert_frames,
    colors,
    counts,
    opened,
    write_folder,
)
from thoroughness import examples

from flowlab.errors import DataError, FlowlabError
from flowlab.geometry.camera import Camera
from flowlab.recordings.readers.plain import write_rgbd_recording
from flowlab.recordings.recording import RecordingSettings, describe, find_recordings

TIMES = np.array([0, 0.033, 0.07, 0.1, 0.1 + 1 / 30, 0.2])
SAMPLE = Path(__file__).parents[3] / "shared" / "real-sample"


def meters() -> np.ndarray:
    return counts().astype(np.float32) * np.float32(0.001)


def write(folder: Path, **changes: Any) -> Path:
    values: dict[str, Any] = {"rgb": colors(), "depth": meters(), "camera": CAMERA, "time_s": TIMES}
    write_rgbd_recording(folder, **{**values, **changes})
    return folder


@settings(max_examples=examples(10), deadline=None, derandomize=True)
@given(st.integers(0, 10**6), st.booleans())
def test_what_is_written_is_read_back_exactly(
    tmp_path_factory: pytest.TempPathFactory, seed: int, success: bool
) -> None:
    rng = np.random.default_rng(seed)
    T = np.eye(4)
    T[:3, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    T[:3, :3] *= np.sign(np.linalg.det(T[:3, :3]))
    T[:3, 3] = rng.normal(size=3)
    camera = Camera(WIDTH, HEIGHT, K + np.diag([rng.random(), rng.random(), 0]), T)
    rgb = rng.integers(0, 256, (STEPS, HEIGHT, WIDTH, 3)).astype(np.uint8)
    state, action = (rng.normal(size=(STEPS, n)).astype(np.float32) for n in (7, 8))
    time_s = np.append(0, np.cumsum(rng.uniform(0.01, 0.1, STEPS - 1)))
    path = write(
        tmp_path_factory.mktemp("r") / "x", rgb=rgb, camera=camera, state=state, action=action, time_s=time_s,
        success=success, task="pour: milk",
    )  # fmt: skip
    recording = opened(path)
    assert recording.camera.to_json() == camera.to_json()
    np.testing.assert_array_equal(recording.time_s, time_s)
    np.testing.assert_array_equal(recording.state, state)
    np.testing.assert_array_equal(recording.action, action)
    assert recording.success.any() == success
    assert recording.extras["bad_frames"] == []
    for t in range(STEPS):
        frame = recording.frame(t)
        np.testing.assert_array_equal(frame.rgb, rgb[t])
        np.testing.assert_array_equal(frame.depth, meters()[t])
    assert describe(path, RecordingSettings()).task == "pour: milk"


@pytest.mark.parametrize("unit", [0.001, 0.0001])
def test_depth_is_rounded_to_its_unit(tmp_path: Path, unit: float) -> None:
    rng = np.random.default_rng(0)
    depth = rng.uniform(0.2, 3, (STEPS, HEIGHT, WIDTH)).astype(np.float32)
    depth[:, 0, :4] = 0, np.nan, np.inf, -1
    recording = opened(write(tmp_path / "r", depth=depth, depth_unit_m=unit))
    seen = np.stack([recording.frame(t).depth for t in range(STEPS)])
    assert not seen[:, 0, :4].any()
    assert np.abs(seen - depth)[:, 1:].max() <= unit / 2 + 1e-6
    assert np.abs(seen - depth)[:, 1:].max() > unit / 3


def test_true_tracks_lie_beside(tmp_path: Path) -> None:
    truth = {
        "query_px": np.ones((5, 2), np.float32),
        "tracks_cam": np.ones((STEPS, 5, 3), np.float32),
        "visible": np.ones((STEPS, 5), bool),
        "role": np.arange(5, dtype=np.int8),
    }
    with np.load(write(tmp_path / "r", **truth) / "ground_truth.npz") as stored:
        assert set(stored.files) == set(truth)
        for name, values in truth.items():
            np.testing.assert_array_equal(stored[name], values)
            assert stored[name].dtype == values.dtype
    assert not (write(tmp_path / "s") / "ground_truth.npz").exists()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"depth": meters() * 100}, "frame 0 reads .* 16 bits of 0.001 m hold 65.53 m; use a greater depth_unit_m"),
        ({"depth": meters()[:-1]}, "not as many depth as color"),
        ({"time_s": TIMES[:-1]}, "6 frames for 5 times"),
        ({"state": np.zeros((4, 2))}, r"state has the shape \(4, 2\), expected \(6, width\), a row for each of 6"),
        ({"state": np.zeros(STEPS)}, r"state has the shape \(6,\), expected \(6, width\)"),
        ({"action": np.full((STEPS, 2), np.nan)}, r"action\[0, 0\] is nan, expected a finite number"),
        ({"action": [[1], [1, 2]]}, "action has rows of different lengths"),
        ({"rgb": colors() / np.float32(255)}, r"rgb of frame 0 is float32, expected uint8 .* \(rgb \* 255\).round"),
        ({"rgb": colors().astype(np.int64)}, "rgb of frame 0 is int64, expected uint8 from 0 to 255$"),
        ({"rgb": colors()[..., 0]}, r"frame 0 is \(24, 32\) and"),
        (
            {"depth": counts()},
            r"depth of frame 0 is uint16, expected meters as float32; of millimeters give \(depth / ",
        ),
        ({"depth": [[1.0]] * STEPS}, "depth of frame 0 is list, expected a NumPy array"),
        ({"time_s": TIMES[::-1]}, "time_s goes from 0.2 to 0.13.* s at frame 1, expected times that rise"),
        ({"time_s": 0 * TIMES}, "expected times that rise"),
        ({"time_s": np.where(TIMES > 0.1, np.inf, TIMES)}, r"time_s\[4\] is inf, expected a finite number"),
        ({"time_s": "now"}, "time_s is <U3, expected numbers"),
        ({"depth_unit_m": 0}, "depth_unit_m is 0, expected meters above 0, as in 0.001"),
        ({"depth_unit_m": np.nan}, "depth_unit_m is nan, expected meters above 0"),
        ({"camera": K}, "camera is ndarray, expected a flowlab.Camera"),
        ({"rgb": colors(size=(16, 24))}, r"frame 0 is \(24, 16, 3\) and \(24, 32\), the camera's is \(24, 32\)"),
    ],
)
def test_what_cannot_be_written_leaves_nothing(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(FlowlabError, match=message):
        write(tmp_path / "r", **changes)
    assert list(tmp_path.iterdir()) == []


def test_a_path_may_be_text(tmp_path: Path) -> None:
    write_rgbd_recording(str(tmp_path / "r"), rgb=colors(), depth=meters(), camera=CAMERA, time_s=TIMES)
    assert_frames(opened(tmp_path / "r"), list(range(STEPS)))


def test_a_writer_that_dies_leaves_nothing_that_counts(tmp_path: Path) -> None:
    def dies() -> Any:
        yield meters()[0]
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write(tmp_path / "r", depth=dies())
    assert not (tmp_path / "r").exists()


def test_what_is_there_is_not_overwritten(tmp_path: Path) -> None:
    write(tmp_path / "r")
    with pytest.raises(DataError, match="exists already"):
        write(tmp_path / "r", rgb=colors()[:, ::-1])
    assert_frames(opened(tmp_path / "r"), list(range(STEPS)))


def test_folders_may_have_other_names(tmp_path: Path) -> None:
    path = write_folder(tmp_path / "r", color="left", depth="tof")
    (path / "color").rename(path / "left")
    (path / "depth").rename(path / "tof")
    assert find_recordings([tmp_path]) == [path]
    assert_frames(opened(path), list(range(STEPS)))


def test_jpeg_color_and_array_depth(tmp_path: Path) -> None:
    path = write_folder(tmp_path / "r")
    for file in (path / "color").iterdir():
        cv2.imwrite(str(file.with_suffix(".jpg")), cv2.imread(str(file)))
        file.unlink()
    for t, file in enumerate(sorted((path / "depth").iterdir())):
        np.save(file.with_suffix(".npy"), counts()[t])
        file.unlink()
    assert_frames(opened(path), list(range(STEPS)), exact_color=False)


def test_float_depth_in_meters(tmp_path: Path) -> None:
    path = write_folder(tmp_path / "r", depth_unit_m=1.0)
    for t, file in enumerate(sorted((path / "depth").iterdir())):
        holes = meters()[t]
        holes[0, :3] = np.nan, -1, np.inf
        np.save(file.with_suffix(".npy"), holes)
        file.unlink()
    frame = opened(path).frame(2)
    assert not frame.depth[0, :3].any()
    np.testing.assert_array_equal(frame.depth[1:], meters()[2][1:])


def test_what_open3d_writes_needs_only_the_depth_unit(tmp_path: Path) -> None:
    path = write_folder(tmp_path / "r")
    (path / "recording.yaml").unlink()
    intrinsic = {"width": WIDTH, "height": HEIGHT, "intrinsic_matrix": K.T.ravel().tolist(), "fps": 10}
    (path / "intrinsic.json").write_text(json.dumps(intrinsic))
    with pytest.raises(DataError, match="unit of depth is not known"):
        opened(path)
    (path / "intrinsic.json").write_text(json.dumps({**intrinsic, "depth_scale": 1000.0}))
    recording = opened(path)
    assert_frames(recording, list(range(STEPS)))
    np.testing.assert_array_equal(recording.camera.K, K)
    assert recording.extras["origin"]["intrinsics"] == "intrinsic.json"
    (path / "intrinsic.json").write_text("{}")
    with pytest.raises(DataError, match=r"intrinsic\.json: is not what Open3D writes"):
        opened(path)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"depth": "deep"}, "no folder 'deep'; name that of the depth pictures"),
        ({"times": "t.txt"}, r"t\.txt: has 5 times for 6 pictures in color/"),
        ({"times": "u.txt"}, r"u\.txt: there is no such file"),
        ({"fps": None, "state": "s.npy", "times": "six.txt"}, r"s\.npy: there is no such file"),
    ],
)
def test_what_does_not_fit_is_named(tmp_path: Path, keys: dict[str, Any], message: str) -> None:
    path = write_folder(tmp_path / "r", **keys)
    (path / "t.txt").write_text("0\n1\n2\n3\n4\n")
    (path / "six.txt").write_text("0\n1\n2\n3\n4\n5\n")
    with pytest.raises(DataError, match=message):
        opened(path, reader="plain")


def test_names_without_numbers_are_never_paired_by_order(tmp_path: Path) -> None:
    path = write_folder(tmp_path / "r", steps=3)
    for folder in ("color", "depth"):
        for name, file in zip("abc", sorted((path / folder).iterdir()), strict=True):
            file.rename(file.with_name(f"{name}.png"))
    with pytest.raises(DataError, match=r"names in color/ have no number to tell time by, as 'a\.png'; write 'times: "):
        opened(path)
    (path / "t.txt").write_text("0.0\n0.1\n0.2\n")
    assert_frames(opened(write_folder(path, steps=0, times="t.txt", fps=None)), [0, 1, 2])
    (path / "depth" / "b.png").rename(path / "depth" / "d.png")
    with pytest.raises(DataError, match="the depth pictures are not named as those are"):
        opened(path)


def test_two_pictures_of_one_name_are_refused(tmp_path: Path) -> None:
    path = write_folder(tmp_path / "r", steps=3)
    first = sorted((path / "color").iterdir())[0]
    shutil.copy(first, first.with_suffix(".jpg"))
    with pytest.raises(DataError, match=r"the names in color/: '0.*' and '0.*' are two pictures of one name; keep one"):
        opened(path)


@pytest.mark.skipif(not SAMPLE.is_dir(), reason="needs the real sample recordings, which are not shipped")
def test_real_kinect_clips_are_read_as_they_are() -> None:
    clips = find_recordings([SAMPLE])
    assert [c.name for c in clips] == ["clip-a", "clip-b"]
    recording = opened(clips[0])
    assert len(recording) == 60
    assert recording.extras["bad_frames"] == []
    frame = recording.frame(7)
    stored = cv2.imread(str(clips[0] / "depth" / "000007.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(frame.depth, stored.astype(np.float32) * np.float32(0.001))
    assert recording.camera.K[0, 0] == 259.0880
    assert recording.time_s[-1] == pytest.approx(59 / 30)
    assert INTRINSICS["width"] != recording.camera.width
