"""Recordings opened as demonstrations: rows, bad frames, clocks, calibration, sizes."""

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
    said,
    write_folder,
    write_png,
    write_yaml,
)
from thoroughness import examples

from flowlab.errors import DataError, UsageError
from flowlab.geometry.camera import Camera
from flowlab.recordings.frame_processing import shrink_intrinsics
from flowlab.recordings.recording import RecordingSettings, describe, find_recordings


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_folder(tmp_path / "rec")


def test_a_recording_is_a_demonstration(folder: Path) -> None:
    recording = opened(folder)
    assert_frames(recording, list(range(STEPS)))
    assert (recording.task, recording.seed) == ("pour", 3)
    np.testing.assert_allclose(recording.time_s, np.arange(STEPS) / 10)
    np.testing.assert_array_equal(recording.camera.K, K)
    np.testing.assert_array_equal(recording.camera.T_world_cam, np.eye(4))
    assert recording.state.shape == recording.action.shape == (STEPS, 0)
    np.testing.assert_array_equal(recording.success, [False] * (STEPS - 1) + [True])
    assert recording.extras["world"] == "the camera's own frame"


# --- bad frames -------------------------------------------------------------------------------------------


def truncate(file: Path) -> None:
    file.write_bytes(file.read_bytes()[:-30])


def blank(file: Path) -> None:
    write_png(file, np.zeros((HEIGHT, WIDTH), np.uint16))


def other_size(file: Path) -> None:
    write_png(file, counts(size=(16, 12))[0])


def eight_bits(file: Path) -> None:
    write_png(file, np.full((HEIGHT, WIDTH), 100, np.uint8))


@pytest.mark.parametrize(
    ("file", "spoil", "reason"),
    [
        ("color/0002.png", truncate, "truncated"),
        ("depth/0002.png", truncate, "truncated"),
        ("depth/0002.png", blank, "no depth reading"),
        ("depth/0002.png", other_size, "16x12, the others are 32x24"),
        ("depth/0002.png", eight_bits, "uint8"),
        ("depth/0002.png", Path.unlink, "no depth within 20 ms: the nearest is 100 ms away"),
    ],
)
def test_a_bad_frame_is_named_and_left_out(folder: Path, file: str, spoil: Any, reason: str) -> None:
    spoil(folder / file)
    recording = opened(folder, max_bad_share=0.2)
    assert_frames(recording, [0, 1, 3, 4, 5])
    ((name, found),) = recording.extras["bad_frames"]
    assert name == (file if spoil is not Path.unlink else "color/0002.png")
    assert reason in found
    np.testing.assert_allclose(recording.time_s, [0, 0.1, 0.3, 0.4, 0.5])
    ((start, length),) = recording.extras["gaps_s"]
    assert (start, length) == pytest.approx((0.1, 0.2))


@pytest.mark.parametrize("rule", [{"bad_frames": "reject", "max_bad_share": 1}, {"max_bad_share": 0.1}])
def test_a_recording_with_too_many_bad_frames_is_rejected(folder: Path, rule: dict[str, Any]) -> None:
    truncate(folder / "color/0002.png")
    with pytest.raises(DataError, match=r"1 of 6 frames are bad \(color/0002\.png is truncated"):
        opened(folder, **rule)


def test_a_color_picture_that_is_missing_is_a_gap(folder: Path) -> None:
    (folder / "color/0003.png").unlink()
    recording = opened(folder)
    assert_frames(recording, [0, 1, 2, 4, 5])
    assert recording.extras["bad_frames"] == []
    assert len(recording.extras["gaps_s"]) == 1


def test_a_missing_first_picture_shifts_nothing(folder: Path) -> None:
    for name in ("0000", "0001"):
        (folder / f"depth/{name}.png").unlink()
    assert_frames(opened(folder, max_bad_share=0.4), [2, 3, 4, 5])


def test_nothing_usable_is_an_error_with_the_reason(folder: Path) -> None:
    for file in (folder / "depth").iterdir():
        blank(file)
    with pytest.raises(DataError, match=r"none of 6 frames can be used; depth/0000\.png has no depth reading"):
        opened(folder)


def test_a_frame_that_went_bad_after_opening_is_an_error(folder: Path) -> None:
    recording = opened(folder)
    truncate(folder / "depth/0004.png")
    recording.frame(3)
    with pytest.raises(DataError, match="row 4 could be read when it was opened, and now it is truncated"):
        recording.frame(4)


# --- which rows -------------------------------------------------------------------------------------------


def test_rows_may_be_thinned_and_trimmed(folder: Path) -> None:
    assert_frames(opened(folder, every=2), [0, 2, 4])
    assert_frames(opened(folder, start_s=0.15, stop_s=0.45), [2, 3, 4])
    truncate(folder / "color/0001.png")
    assert opened(folder, every=2, bad_frames="reject").extras["frames"]["looked_at"] == 3


# --- clocks -----------------------------------------------------------------------------------------------


def timed(folder: Path, color_s: Any, depth_s: Any, **keys: Any) -> Path:
    (folder / "t.txt").write_text("\n".join(map(str, color_s)))
    (folder / "d.txt").write_text("\n".join(map(str, depth_s)))
    write_yaml(
        folder / "recording.yaml",
        times="t.txt",
        depth_times="d.txt",
        depth_unit_m=0.001,
        intrinsics=INTRINSICS,
        **keys,
    )
    return folder


def test_depth_is_taken_nearest_in_time(folder: Path) -> None:
    """The depth camera runs 0.1 s ahead: the picture of color frame t is depth frame t + 1."""
    color_s = 100 + np.arange(6) / 10
    recording = opened(timed(folder, color_s, color_s - 0.103), max_bad_share=0.2)
    assert len(recording) == 5
    for t in range(5):
        np.testing.assert_array_equal(recording.frame(t).depth, counts()[t + 1] * np.float32(0.001))
    assert recording.extras["max_sync_error_s"]["depth"] == pytest.approx(0.103)
    assert recording.extras["bad_frames"] == [["color/0005.png", "no depth within 20 ms: the nearest is 103 ms away"]]
    assert recording.time_s[0] == 0


@settings(max_examples=examples(20), deadline=None, derandomize=True)
@given(st.floats(-0.08, 0.08))
def test_sync_error_decides_by_its_bound(tmp_path_factory: pytest.TempPathFactory, off: float) -> None:
    path = write_folder(tmp_path_factory.mktemp("rec") / "r", steps=3)
    timed(path, [0, 0.2, 0.4], np.array([0, 0.2, 0.4]) + off)
    if abs(off) < 0.0399:
        assert len(opened(path, max_sync_s=0.04)) == 3
    elif abs(off) > 0.0401:
        with pytest.raises(DataError, match="none of 3 frames"):
            opened(path, max_sync_s=0.04)


def test_two_frames_at_one_time_are_one_bad_frame(folder: Path) -> None:
    times = [0, 0.1, 0.1, 0.3, 0.4, 0.5]
    recording = opened(timed(folder, times, np.arange(6) / 10), max_bad_share=0.2, max_sync_s=0.001)
    assert recording.extras["bad_frames"] == [["color/0002.png", "was taken no later than the frame before it"]]
    assert (np.diff(recording.time_s) > 0).all()


# --- state and actions ------------------------------------------------------------------------------------


def test_state_is_nearest_and_action_the_last_before(folder: Path) -> None:
    color_s = np.arange(6) / 10
    timed(folder, color_s, color_s, state="s.csv", action="a.csv")
    robot_s = np.arange(-1, 16) / 25 + 0.011
    for name in ("s.csv", "a.csv"):
        (folder / name).write_text("time,value\n" + "\n".join(f"{t!r},{t!r}" for t in robot_s.tolist()))
    recording = opened(folder)
    for t, now in enumerate(color_s):
        assert abs(recording.state[t, 0] - now) == pytest.approx(np.abs(robot_s - now).min(), abs=1e-6)
        assert recording.action[t, 0] == pytest.approx(robot_s[robot_s <= now].max())
    assert recording.extras["action"] == "the last one recorded up to the row"


def test_without_actions_the_next_state_is_the_action(folder: Path) -> None:
    state = np.arange(12, dtype=np.float32).reshape(6, 2)
    np.save(folder / "s.npy", state)
    write_folder(folder, state="s.npy")
    truncate(folder / "color/0003.png")
    recording = opened(folder, max_bad_share=0.2)
    np.testing.assert_array_equal(recording.state, state[[0, 1, 2, 4, 5]])
    np.testing.assert_array_equal(recording.action, state[[1, 2, 4, 5, 5]])
    assert recording.extras["action"] == "state of the next row"


def test_a_frame_long_without_state_is_bad(folder: Path) -> None:
    (folder / "s.csv").write_text("time,x\n0,1\n0.1,2\n0.2,3\n0.5,4\n")
    write_folder(folder, state="s.csv")
    recording = opened(folder, max_state_s=0.05, max_bad_share=0.5)
    assert recording.extras["bad_frames"][0] == ["color/0003.png", "no state within 50 ms: the nearest is 100 ms away"]
    np.testing.assert_array_equal(recording.state[:, 0], [1, 2, 3, 4])


def test_failure_is_kept(tmp_path: Path) -> None:
    assert not opened(write_folder(tmp_path / "r", success=False)).success.any()


# --- calibration ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("missing", "message"),
    [
        (
            "intrinsics",
            r"intrinsics .* not known; write into .*recording\.yaml .*'intrinsics: \{width: 32, height: 24, fx",
        ),
        ("depth_unit_m", r"unit of depth is not known; the median reading is 7\d\d counts: .*'depth_unit_m: 0.001'"),
        ("fps", r"when the pictures were taken is not known: .* write 'fps: 30' where .* goes into .*recording\.yaml"),
    ],
)
def test_what_is_missing_is_said_with_the_line_to_write(tmp_path: Path, missing: str, message: str) -> None:
    path = write_folder(tmp_path / "rec", **{missing: None})
    with pytest.raises(DataError, match=message):
        opened(path)
    given = write_yaml(tmp_path / "cal.yaml", fps=10, depth_unit_m=0.001, intrinsics=INTRINSICS)
    recording = opened(path, calibration=given)
    assert_frames(recording, list(range(STEPS)))
    assert recording.extras["origin"][missing] == "cal.yaml"


def test_a_calibration_file_wins(tmp_path: Path) -> None:
    T = [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
    path = write_folder(tmp_path / "rec", T_world_cam=np.eye(4).tolist())
    recording = opened(path, calibration=write_yaml(tmp_path / "c.yaml", T_world_cam=T))
    np.testing.assert_array_equal(recording.camera.T_world_cam, T)
    assert recording.extras["world"] == "as T_world_cam says"


def test_intrinsics_of_another_size_are_refused_with_those_that_fit(tmp_path: Path) -> None:
    twice = {"width": 64, "height": 48, "fx": 60.0, "fy": 62.0, "cx": 30.9, "cy": 23.9}
    path = write_folder(tmp_path / "rec", intrinsics=twice)
    with pytest.raises(DataError, match="pictures of 64x48, but these have 32x24") as caught:
        opened(path)
    line = str(caught.value).rpartition("'intrinsics: ")[2].rstrip("'")
    assert line == "{width: 32, height: 24, fx: 30.0, fy: 31.0, cx: 15.2, cy: 11.7}"
    path = write_folder(path, intrinsics={k: v for k, v in twice.items() if k not in ("width", "height")})
    with pytest.raises(DataError, match=r"principal point \(30\.9, 23\.9\) is far from the middle"):
        opened(path)


@pytest.mark.parametrize("unit", [1.0, 1e-6])
def test_an_impossible_depth_unit_is_refused(tmp_path: Path, unit: float) -> None:
    with pytest.raises(
        DataError, match=r"which cannot be; write 'depth_unit_m' into .*'depth_unit_m: 0\.001' would make that 0\.7"
    ):
        opened(write_folder(tmp_path / "rec", depth_unit_m=unit))


# --- depth from another camera ----------------------------------------------------------------------------

DEPTH_K = {"fx": 15.0, "fy": 15.5, "cx": 7.35, "cy": 5.6}


def write_small_depth(folder: Path, **keys: Any) -> Path:
    """A wall at 0.8 m, its depth at half the size of color."""
    write_folder(folder, **keys)
    for file in (folder / "depth").iterdir():
        write_png(file, np.full((12, 16), 800, np.uint16))
    return folder


def test_depth_of_another_size_asks_for_the_cameras(tmp_path: Path) -> None:
    path = write_small_depth(tmp_path / "rec")
    with pytest.raises(
        DataError,
        match=r"\(16x12\) has another size than color \(32x24\).*'depth_intrinsics: \{width: 16.*'T_color_depth: \[\[",
    ):
        opened(path)
    write_small_depth(path, depth_intrinsics=DEPTH_K)
    with pytest.raises(DataError, match=r"write into .* 'T_color_depth: \[\[.*\]\]' \(the pose"):
        opened(path)


def test_depth_is_registered_by_the_cameras(tmp_path: Path) -> None:
    keys = {"depth_intrinsics": DEPTH_K, "T_color_depth": np.eye(4).tolist()}
    recording = opened(write_small_depth(tmp_path / "rec", **keys))
    np.testing.assert_array_equal(recording.frame(0).depth, np.full((24, 32), np.float32(0.8)))
    assert said(recording, "registration").startswith("depth is registered to color by flowlab")


def test_a_transform_that_loses_all_depth_is_refused(tmp_path: Path) -> None:
    T = np.eye(4)
    T[0, 3] = 0.9  # behind the edge of what color sees
    keys = {"depth_intrinsics": DEPTH_K, "T_color_depth": T.tolist()}
    with pytest.raises(DataError, match=r"no depth reading lies in the color picture; it must map .* in meters"):
        opened(write_small_depth(tmp_path / "rec", **keys))


def test_distorted_pictures_are_straightened(tmp_path: Path) -> None:
    """A mark drawn where a bent lens puts it appears where a pinhole camera sees it, in color and in depth."""
    bent = (0.4, -0.1, 0.0, 0.0, 0.0)
    size = (160, 120)
    K_wide = np.array([[120.0, 0, 79.5], [0, 120.0, 59.5], [0, 0, 1]])
    mark = np.array([[0.45, 0.3, 1.0]])
    (at,), _ = cv2.projectPoints(mark, np.zeros(3), np.zeros(3), K_wide, np.array(bent))
    u, v = np.rint(at[0]).astype(int)
    rgb, depth = np.zeros((120, 160, 3), np.uint8), np.full((120, 160), 1000, np.uint16)
    rgb[v - 2 : v + 3, u - 2 : u + 3] = 255
    depth[v - 2 : v + 3, u - 2 : u + 3] = 500
    for t in range(2):
        write_png(tmp_path / "rec/color" / f"{t}.png", rgb)
        write_png(tmp_path / "rec/depth" / f"{t}.png", depth)
    camera = {"width": 160, "height": 120, "fx": 120.0, "fy": 120.0, "cx": 79.5, "cy": 59.5, "distortion": list(bent)}
    write_yaml(tmp_path / "rec/recording.yaml", fps=10, depth_unit_m=0.001, intrinsics=camera)
    frame = opened(tmp_path / "rec").frame(0)
    assert frame.rgb is not None
    assert frame.depth.shape == size[::-1]
    expected = (K_wide @ mark[0])[:2]
    assert np.linalg.norm(at[0] - expected) > 3
    for seen in (frame.rgb[..., 0] > 127, frame.depth == 0.5):
        rows, cols = np.nonzero(seen)
        np.testing.assert_allclose([cols.mean(), rows.mean()], expected, atol=1.0)
    assert set(np.unique(frame.depth)) <= {0.0, 0.5, 1.0}, "depth is never mixed"


# --- size -------------------------------------------------------------------------------------------------


@settings(max_examples=examples(60), deadline=None, derandomize=True)
@given(st.integers(1, 6), st.floats(5, 60), st.floats(5, 40))
def test_a_shrunk_camera_sees_the_middle_of_each_block(factor: int, cx: float, cy: float) -> None:
    """What lies at the center of a block of pixels lies at the center of the pixel made of it."""
    K_full = np.array([[80.0, 0, cx], [0, 90.0, cy], [0, 0, 1]])
    small = Camera(8, 6, shrink_intrinsics(K_full, factor), np.eye(4))
    full = Camera(8 * factor, 6 * factor, K_full, np.eye(4))
    pixel = np.stack(np.meshgrid(np.arange(8.0), np.arange(6.0)), -1).reshape(-1, 2)
    block = pixel * factor + (factor - 1) / 2
    z = np.ones(len(pixel))
    np.testing.assert_allclose(small.unproject(pixel, z), full.unproject(block, z), atol=1e-9)


@pytest.mark.parametrize(("max_width", "factor"), [(32, 1), (31, 2), (16, 2), (11, 3), (10, 4)])
def test_large_pictures_are_shrunk_by_a_whole_factor(folder: Path, max_width: int, factor: int) -> None:
    recording = opened(folder, max_width=max_width)
    frame = recording.frame(1)
    height, width = HEIGHT // factor, WIDTH // factor
    assert frame.rgb is not None
    assert frame.depth.shape == frame.rgb.shape[:2] == (height, width)
    assert (recording.camera.width, recording.camera.height) == (width, height)
    assert recording.extras["shrunk_by"] == factor
    blocks = colors()[1][: height * factor, : width * factor].reshape(height, factor, width, factor, 3)
    np.testing.assert_allclose(frame.rgb, blocks.mean((1, 3)), atol=0.51)
    source = counts()[1].astype(np.float32) * np.float32(0.001)
    first = (factor - 1) // 2
    np.testing.assert_array_equal(frame.depth, source[first::factor, first::factor][:height, :width])


def test_opening_keeps_no_picture(folder: Path) -> None:
    """AlignedSamples are decoded when they are asked for: what a file holds then is what comes."""
    recording = opened(folder)
    write_png(folder / "depth/0001.png", counts()[4])
    np.testing.assert_array_equal(recording.frame(1).depth, counts()[4] * np.float32(0.001))


# --- finding and describing -------------------------------------------------------------------------------


def test_recordings_are_found_in_the_order_people_count(tmp_path: Path) -> None:
    for name in ("b/ep10", "b/ep2", "a", "b/.hidden"):
        write_folder(tmp_path / name, steps=2)
    found = find_recordings([tmp_path, tmp_path / "b"])
    assert [str(p.relative_to(tmp_path)) for p in found] == ["a", "b/ep2", "b/ep10"]


def test_nothing_found_says_what_was_looked_for(tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    with pytest.raises(UsageError, match=r"no recording at or below it; looked for .*color/.*\.mcap.*rgb\.txt"):
        find_recordings([tmp_path])
    with pytest.raises(UsageError, match="no such file or folder"):
        find_recordings([tmp_path / "nowhere"])
    with pytest.raises(DataError, match="not a recording flowlab knows"):
        opened(tmp_path)


def test_an_unknown_reader_is_named(folder: Path) -> None:
    with pytest.raises(UsageError, match="no reader is called 'plan'; did you mean plain"):
        opened(folder, reader="plan")


def test_a_description_says_what_was_recognized(folder: Path) -> None:
    np.save(folder / "s.npy", np.zeros((6, 7)))
    write_folder(folder, state="s.npy", task="pour")
    (folder / "depth/0003.png").unlink()
    about = describe(folder, RecordingSettings(max_bad_share=0.2))
    assert (about.reader, about.task, about.rows, about.problem) == ("plain", "pour", 5, None)
    named = {s.name: s for s in about.streams}
    assert [(s.name, s.count) for s in about.streams] == [("color", 6), ("depth", 5), ("state", 6)]
    assert named["color"].fps == pytest.approx(10)
    assert named["color"].gaps == ()
    assert len(named["depth"].gaps) == 1
    assert about.sync_s["depth"] == pytest.approx((0, 0.1))
    assert (about.color_size, about.depth_size, about.frame_size) == ((32, 24),) * 3
    assert (about.state_width, about.action_width) == (7, 7)
    assert about.depth_unit_m == 0.001
    assert about.origin["depth_unit_m"] == "recording.yaml"
    assert [b.name for b in about.bad] == ["color/0003.png"]


def test_a_description_without_calibration_says_what_is_missing(tmp_path: Path) -> None:
    about = describe(write_folder(tmp_path / "r", intrinsics=None), RecordingSettings())
    assert about.problem is not None
    assert "intrinsics" in about.problem
    assert about.frame_size is None
    assert about.rows == STEPS


def test_the_source_is_a_name_that_means_the_same_elsewhere(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert opened(folder).extras["source"] == "rec"
    monkeypatch.chdir(folder.parent.parent)
    relative = Path(folder.parent.name) / "rec"
    assert opened(relative).extras["source"] == relative.as_posix()


def test_the_camera_of_the_tests_is_what_the_yaml_says(folder: Path) -> None:
    assert opened(folder).camera.to_json() == CAMERA.to_json()
