"""The sheet of a recording: what it shows is what is in the recording, whatever state that is in."""

import json
import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from synthetic import call_cli
from synthetic_clip import BOARD_M, BOTTOM, FOCAL, LEFT, RIGHT, TOP, WALL_M, record

from flowlab.recordings.parsing import RecordingSettings, parse_recording
from flowlab.recordings.preview import RecordingPreview, preview_recording

Capture = pytest.CaptureFixture[str]
FRAMES = 9
PINK = (255, 40, 200)
PATH = np.stack([np.linspace(-0.1, 0.1, FRAMES), np.full(FRAMES, 0.05), np.full(FRAMES, 0.9), np.ones(FRAMES)], -1)


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """A board that slides to the right, color frame 3 unreadable, 5 the same as 4, 7 not there."""
    folder = record(tmp_path / "slide" / "1", FRAMES, state=PATH.astype(np.float32))
    color = sorted((folder / "color").iterdir())
    color[3].write_bytes(b"no picture")
    color[5].write_bytes(color[4].read_bytes())
    color[7].unlink()
    times = (folder / "times.txt").read_text().split()
    (folder / "depth_times.txt").write_text("\n".join(times))
    (folder / "times.txt").write_text("\n".join(times[:7] + times[8:]))
    with (folder / "recording.yaml").open("a") as about:
        about.write("\ndepth_times: depth_times.txt\nstate_times: depth_times.txt\n")
    return folder


def preview(folder: Path) -> RecordingPreview:
    settings = RecordingSettings(max_bad_share=1)
    return preview_recording(folder, settings, parse_recording(folder, settings))


def border(t: int) -> np.ndarray:
    """The pixels of the board's border in frame t."""
    board = np.zeros((120, 160), np.uint8)
    board[TOP:BOTTOM, LEFT + t : RIGHT + t] = 1
    return (board - cv2.erode(board, np.ones((3, 3)))).astype(bool)


def test_edges_cloud_path_and_streams_are_those_of_the_scene(recording: Path) -> None:
    shown = preview(recording)
    for picture, t in zip(shown.pictures, (0, 4, 8), strict=True):
        assert picture.time_s == pytest.approx(t / 10)
        assert picture.edges is not None
        np.testing.assert_array_equal(picture.edges, border(t))
    assert shown.cloud is not None
    on_board = np.isclose(shown.cloud.xyz_world[:, 2], BOARD_M)
    assert np.isclose(shown.cloud.xyz_world[~on_board, 2], WALL_M).all()
    assert shown.cloud.xyz_world[on_board, 0].min() == pytest.approx((LEFT - 79.5) * BOARD_M / FOCAL)
    assert shown.cloud.gripper_world is not None
    np.testing.assert_allclose(shown.cloud.gripper_world, PATH[[0, 1, 2, 4, 5, 6, 8], :3], atol=1e-6)
    color, depth, state = shown.streams
    assert (color.name, depth.name, len(color.time_s), len(depth.time_s), len(state.time_s)) == (
        "color",
        "depth",
        8,
        9,
        9,
    )
    np.testing.assert_allclose(color.gaps, [(0.6, 0.2)])
    for marks, expected in ((color.skipped_s, [0.3]), (color.repeated_s, [0.5]), (depth.repeated_s, [])):
        assert marks is not None
        np.testing.assert_allclose(marks, expected)


def test_the_command_draws_edges_where_the_board_is(tmp_path: Path, capsys: Capture) -> None:
    folder, png = record(tmp_path / "slide" / "1", FRAMES), tmp_path / "deep" / "sheet.png"
    code, out, err = call_cli(capsys, "track-real", folder, "--dry-run", "--png", png, "--json")
    assert (code, err, json.loads(out)["recordings"][0]["sheet"]) == (0, "", str(png))
    sheet = cv2.imread(str(png))[..., ::-1]
    pink = (sheet == PINK).all(-1)
    pink[: len(sheet) // 10] = False  # the legend
    columns = np.flatnonzero(pink.sum(0) > 20)
    parts = np.split(columns, np.flatnonzero(np.diff(columns) > 400) + 1)
    assert len(parts) == 3
    left = [p[0] for p in parts]
    scale = (parts[0][-1] + 1 - left[0]) / (RIGHT - LEFT)
    rows = np.flatnonzero(pink[:, columns].any(1))
    assert (rows[-1] + 1 - rows[0]) / (BOTTOM - TOP) == pytest.approx(scale, rel=0.03)
    panel = scale * 160
    assert (left[1] - left[0] - panel) == pytest.approx(left[2] - left[1] - panel, abs=2)


def test_every_recording_has_a_sheet_of_its_own_refused_and_hostile_ones_too(tmp_path: Path, capsys: Capture) -> None:
    task = tmp_path / "slide"
    names = ("$x^{2 <b>|`*\u65e5", "no lens", "no clock")
    for name in names:
        record(task / name, 4)
    about = (task / "no lens" / "recording.yaml").read_text()
    (task / "no lens" / "recording.yaml").write_text("\n".join(x for x in about.splitlines() if "intrinsics" not in x))
    (task / "no clock" / "times.txt").write_text("0 0.3 0.1 0.2".replace(" ", "\n"))
    code, _, err = call_cli(capsys, "track-real", task, "--dry-run", "--png", tmp_path / "out" / "s.png")
    assert (code, err.count("\n")) == (3, 1)
    sheets = sorted(os.listdir(tmp_path / "out"))
    assert len(sheets) == len(names)
    assert {"s-slide-no clock.png", "s-slide-no lens.png"} <= set(sheets)
    for sheet in sheets:
        drawn = cv2.imdecode(np.fromfile(tmp_path / "out" / sheet, np.uint8), cv2.IMREAD_COLOR)
        assert drawn.shape[1] == 2250
        assert (drawn[100:900] < 200).mean() > 0.1, f"{sheet} has no pictures"


def test_what_cannot_be_written_is_told(tmp_path: Path, capsys: Capture) -> None:
    folder = record(tmp_path / "slide" / "1", 4)
    (tmp_path / "taken.png").mkdir()
    (tmp_path / "file").write_text("")
    for arguments, exit_code, words in [
        (("--dry-run", "--png", tmp_path / "sheet.jpg"), 2, "ends with .png"),
        (("--dry-run", "--png", tmp_path / "taken.png"), 3, "taken.png: cannot be written"),
        (("--dry-run", "--png", tmp_path / "file" / "s.png"), 3, "cannot be written"),
        (("--png", tmp_path / "s.png", "--out", tmp_path / "d"), 2, "add --dry-run"),
    ]:
        code, _, err = call_cli(capsys, "track-real", folder, *arguments)
        assert (code, words in err, err.count("\n")) == (exit_code, True, 1), err
    assert {p.name for p in tmp_path.iterdir()} == {"slide", "taken.png", "file"}
