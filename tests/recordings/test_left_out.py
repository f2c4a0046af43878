"""Of every layout, what lies in a recording and is not used is named, with the reason."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
from real_recordings import write_folder
from synthetic import call_cli
from test_arrays_reader import write_npy, write_npz
from test_rh20t_reader import GRIPPER, MS, TCP, write_calibration, write_camera, write_rows
from test_ros_reader import say_camera, write_bag

Capture = pytest.CaptureFixture[str]


def checks(capsys: Capture, path: Path) -> dict[tuple[str, str], str]:
    """What the dry run says of a recording, by what was looked at and the verdict."""
    _, out, _ = call_cli(capsys, "track-real", path, "--dry-run", "--json")
    (facts,) = json.loads(out)["recordings"]
    said: dict[tuple[str, str], str] = {}
    for c in facts["checks"]:
        key = c["about"], c["verdict"]
        said[key] = " | ".join([said[key], c["says"]] if key in said else [c["says"]])
    return said


def litter(folder: Path) -> None:
    """What people, desktops and other tools leave in a folder."""
    (folder / "notes.md").write_text("good take")
    (folder / "old.mcap.zstd").write_bytes(b"")
    (folder / "lost.png").symlink_to(folder / "nowhere.png")
    os.mkfifo(folder / "pipe")
    (folder / "thumbs").mkdir()
    for k in range(5):
        (folder / "thumbs" / f"{k}.jpg").write_bytes(b"")
    np.save(folder / "joints.npy", np.zeros((6, 7)))


def assert_litter_is_named(told: dict[tuple[str, str], str], *, state: bool) -> None:
    assert told["left out", "ok"] == "notes.md (documentation); thumbs/ (5 files) (to look at)"
    doubts = told["left out", "doubtful"]
    for words in ("unpack it with 'zstd -d old.mcap.zstd'", "lost.png is not used: it is a link that leads nowhere",
                  "pipe is not used: it is no regular file", "write 'ignore: [pipe]'"):  # fmt: skip
        assert words in doubts
    assert ("joints.npy" in doubts) == state
    assert ("joints.npy is not used" in told.get(("state", "doubtful"), "")) != state


def put_rh20t(folder: Path) -> Path:
    write_camera(folder)
    write_rows(folder / "tcp", TCP, late_ms=4)
    write_rows(folder / "gripper_command", GRIPPER)
    write_calibration(folder.parent)
    (folder / "timestamp.txt").write_text("1649\n")
    return folder


def put_ros(folder: Path) -> Path:
    return write_bag(folder.with_suffix(".mcap"), 2, lambda m, say: say_camera(m, say))


LAYOUTS = {
    "plain": (write_folder, False),
    "arrays": (write_npy, True),
    "arrays without state": (lambda folder: write_npy(folder, agent_pos=None), False),
    "rh20t": (put_rh20t, True),
    "ros": (put_ros, False),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_what_lies_in_a_folder_and_is_not_used_is_named(layout: str, tmp_path: Path, capsys: Capture) -> None:
    put, state = LAYOUTS[layout]
    (tmp_path / "task").mkdir()
    folder = put(tmp_path / "task" / "take")
    found = checks(capsys, folder)
    assert found["left out", "ok"] == "every file is used"
    assert not [about for about, verdict in found if about in ("state", "action") and verdict == "doubtful"]
    litter(folder)
    assert_litter_is_named(checks(capsys, folder), state=state)


def test_other_cameras_and_what_came_after_the_end_are_named(tmp_path: Path, capsys: Capture) -> None:
    folder = put_rh20t(tmp_path / "task" / "take")
    write_camera(folder, "f0000001")
    (folder / "recording.yaml").write_text("camera: '750612070851'\n")
    (folder / "metadata.json").write_text(json.dumps({"finish_time": int(MS[3])}))
    found = checks(capsys, folder)
    assert "cam_f0000001/color/ (6 files), cam_f0000001/depth/ (6 files)" in found["left out", "ok"]
    assert "2 color pictures after" in found["finish time", "ok"]


def test_arrays_in_a_file_that_nothing_uses_are_named(tmp_path: Path, capsys: Capture) -> None:
    found = checks(capsys, write_npz(tmp_path / "task_1.npz"))
    assert found["left out", "ok"] == "every array is used"
    found = checks(capsys, write_npz(tmp_path / "task_2.npz", reward=np.zeros(6), point_cloud=np.zeros((6, 9, 3))))
    assert found["left out", "ok"] == "reward (counts what was achieved)"
    assert "point_cloud is not used" in found["left out", "doubtful"]
    (tmp_path / "task_2.yaml").write_text((tmp_path / "task_2.yaml").read_text() + "ignore: [point_cloud]\n")
    found = checks(capsys, tmp_path / "task_2.npz")
    assert "point_cloud (not used, as 'ignore' says)" in found["left out", "ok"]
    assert ("left out", "doubtful") not in found
    found = checks(capsys, write_npz(tmp_path / "task_3.npz", agent_pos=None, joint_positions=np.zeros((6, 7))))
    assert "joint_positions is not used" in found["left out", "doubtful"]
