"""Every file that no stream uses is harmless for what it is, ignored as stated, or asked about."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from real_recordings import INTRINSICS, STEPS, K, colors, counts, opened, write_folder, write_png, write_yaml
from synthetic import call_cli
from test_rh20t_reader import write_calibration, write_camera

from flowlab.errors import DataError
from flowlab.recordings.poses import read_poses

Capture = pytest.CaptureFixture[str]
CLOCK = np.arange(STEPS) / 10
POSES = np.tile(np.eye(4), (STEPS, 1, 1))
POSES[:, 0, 3] = CLOCK
ROWS = np.random.default_rng(0).normal(size=(STEPS, 7))
TUM = np.c_[CLOCK, POSES[:, :3, 3], np.tile([0, 0, 0, 1], (STEPS, 1))]


def looked_at(capsys: Capture, folder: Path) -> tuple[int, list[dict[str, str]], str]:
    """Exit code, all checks of the dry run, and what was refused."""
    code, out, _ = call_cli(capsys, "track-real", folder, "--dry-run", "--json")
    (facts,) = json.loads(out)["recordings"]
    return code, facts["checks"], facts["problem"] or ""


def doubts(checks: list[dict[str, str]], name: str) -> list[str]:
    """What is doubtful of a file."""
    return [c["says"] for c in checks if c["verdict"] == "doubtful" and c["says"].startswith(name)]


def put(folder: Path, name: str, content: Any) -> None:
    """A file of some content."""
    file = folder / name
    file.parent.mkdir(parents=True, exist_ok=True)
    if isinstance(content, np.ndarray):
        (np.savetxt if file.suffix == ".txt" else np.save)(file, content)
    elif isinstance(content, bytes):
        file.write_bytes(content)
    elif isinstance(content, str):
        file.write_text(content)
    elif file.suffix == ".npz":
        np.savez(file, **content)
    else:
        file.write_text(json.dumps(content))


def lines(rows: np.ndarray, sep: str = ",") -> str:
    return "".join(sep.join(f"{x:.4f}" for x in row) + "\n" for row in rows)


UNKNOWN = {
    "log.csv": ("a,b\n" + lines(ROWS[:, :2]), "2 numbers for every picture .*'state: log.csv'"),
    "traj.csv": ("t,tx,ty,tz,qx,qy,qz,qw\n" + lines(TUM), "'T_world_cam_file: traj.csv'"),
    "ur5.csv": ("timestamp,q_0\n" + lines(ROWS[:4, :2]), "4 rows of timestamp, q_0; .*'state'.*'times'"),
    "frames.csv": ("filename,timestamp\n0000.png,5\n0001.png,7\n", "filename, timestamp.*'times'"),
    "sync.csv": ("color_t,depth_t\n" + lines(np.c_[CLOCK, CLOCK + 0.15]), "color_t, depth_t.*'times'"),
    "times.json": ((1.7e9 + 2 * CLOCK).tolist(), "write them, one a line, into a file named with 'times'"),
    "episode.json": ({"qpos": ROWS.tolist()}, "keys qpos; .*'state'"),
    "teleop.jsonl": ('{"q": [1, 2]}\n{"q": [1, 3]}\n', "keys q; "),
    "metadata.json": ({"fps": 5}, "it says fps 5, and 10 is used"),
    "info.json": ({"a": {"frame_rate": 10, "depth_scale": 0.00025}}, "depth_scale 0.00025, and 0.001 is used"),
    "fps.npy": (np.array(5.0), "it says fps 5, and 10 is used"),
    "robot.npz": ({"q": ROWS}, "'state: ...'"),
    "robot.mat": (b"\0\1", "write its numbers as .npy or .csv"),
    "slam.tum": (lines(TUM, " "), "'T_world_cam_file: slam.tum'"),
    "images.txt": ("# colmap\n1 1 0 0 0 0 0 0 1 0000.png\n\n", "text: '# colmap"),
    "R.npy": (POSES[:, :3, :3] * 2, r"float64 \(6, 3, 3\)"),
    "lens.npy": (np.array([0.3, -0.1, 0, 0, 0]), "'distortion'"),
    "camera_info.yaml": (f"camera_matrix: {{data: {K.ravel().tolist()}}}\nD: [1]\n", "'intrinsics'"),
    "calib.txt": ("fx=120\nfy=120\nk1=.3\n", "'intrinsics'"),
    "setup.cfg": ("fx: 120\n", "'intrinsics'"),
    "odom.npy": (TUM, "'state: odom.npy'.*'T_world_cam_file: odom.npy'"),
    "T_base_cam.txt": (POSES[2], "'T_world_cam'"),
    "poses.json": (POSES.tolist(), r"6 rigid transforms .*write them as .npy of \(N, 4, 4\)"),
    "trajectory.log": ("0 0 1\n" + lines(POSES[0], " "), r"write them as .npy of \(N, 4, 4\)"),
    "state.pkl": (b"x", "'state: ...'"),
    "blob.bin": (b"\0\0", "bytes of an unknown format"),
    "old.h5": (b"x", "it is called as HDF5 is, but its content is none"),
    "color/0003.png.part": (b"x", "ignore: "),
    "count.json": ({"num_frames": 7}, "it says num_frames 7, and 6 is used"),
    "numbers.txt": ("take 1 2 3 4 5\n", "text: "),
    "setup.txt": ("the camera was moved, fx: 120 px in this take of the day\n", "'intrinsics'"),
    "IMG 7.png": (b"x", r"ignore: \['IMG 7.png'\]"),
}
"""Files beside a plain recording: none may pass as ok."""


def test_what_is_not_known_is_asked_about(tmp_path: Path, capsys: Capture) -> None:
    folder = write_folder(tmp_path / "r")
    for name, (content, _) in UNKNOWN.items():
        put(folder, name, content)
    for t in range(STEPS):
        put(folder, f"intrinsics/{t}.txt", K * (1 + t / 10) * [[1], [1], [1 / (1 + t / 10)]])
        write_png(folder / f"rgb/{t}.png", colors()[t])
        write_png(folder / f"color/sub/{t}.png", colors()[t])
    (folder / "qpos.npy").symlink_to(folder / "nowhere.npy")
    code, checks, _ = looked_at(capsys, folder)
    assert code == 0
    assert not [
        c for c in checks if c["says"] == "every file is used" or (c["about"], c["verdict"]) == ("left out", "ok")
    ]
    for name, (_, words) in UNKNOWN.items():
        (says,) = doubts(checks, name)
        assert re.search(words, says), says
        assert "write 'ignore: [" in says
    for folder_name, words in ("intrinsics/", "camera's matrix each"), ("rgb/", "pictures"), ("color/sub/", "pictures"):
        assert words in "".join(doubts(checks, folder_name))
    assert "leads nowhere" in "".join(doubts(checks, "qpos.npy"))


def test_what_is_known_to_be_harmless_is_listed(tmp_path: Path, capsys: Capture) -> None:
    folder = write_folder(tmp_path / "r", state="./s.npy")
    (tmp_path / "far.npy").write_bytes(b"")
    np.save(folder / "real.npy", ROWS)
    (folder / "s.npy").symlink_to(folder / "real.npy")
    harmless = {
        "README": "1", "a.md": "7", "LICENSE.txt": "8", "paper.pdf": b"1", "take.mp4": b"\0", "thumbs/1.jpg": b"x",
        "preview_3.png": b"x", "run.log": "2023-11-14 12:00:01,123 INFO started\n", "task.txt": "pour the beans",
        "md5sums.txt": "0123", "state.npy~": b"x", "reward.npy": CLOCK,
        "about.json": {"operator": "x", "fps": 10.0, "image_width": 32, "camera": {"K": K.tolist()}},
        "K.npy": K, "frame_times.txt": CLOCK + 77, "notes.txt": "Take 3 of 5, 2023-11-14, cup 2 cm left\nlooks good",
        "meta.json": {"task": "pour", "episode": 12, "success": True, "num_frames": STEPS, "serial_number": "0433"},
        "language.json": ["pour the beans", "put them back"], "instruction.npy": np.array("pour"),
        "record.py": "fx = 3", "environment.yml": "dependencies: [numpy=1.26]", "requirements.txt": "numpy==1.26",
    }  # fmt: skip
    for name, content in harmless.items():
        put(folder, name, content)
    code, checks, _ = looked_at(capsys, folder)
    assert (code, [c for c in checks if c["verdict"] in ("doubtful", "refused")]) == (0, [])
    (says,) = [c["says"] for c in checks if c["about"] == "left out"]
    assert all(word in says for word in ("documentation", "checksums", "to look at", "says what is used"))


def test_what_the_simulator_notes_of_its_film_is_known_and_no_other_file_of_that_name(
    tmp_path: Path, capsys: Capture
) -> None:
    folder = write_folder(tmp_path / "r")
    put(
        folder,
        "simulated.json",
        {"made_with": {"task": "push", "seed": 0, "settings": {"fx": 3}}, "unusable_queries": 2},
    )
    _, checks, _ = looked_at(capsys, folder)
    assert [(c["verdict"], "flowlab's simulator" in c["says"]) for c in checks if c["about"] == "left out"] == [
        ("ok", True)
    ]
    put(folder, "simulated.json", {"made_with": "Blender", "fx": 251.5})
    _, checks, _ = looked_at(capsys, folder)
    assert doubts(checks, "simulated.json")


def test_many_files_of_one_kind_are_one_question(tmp_path: Path, capsys: Capture) -> None:
    folder = write_folder(tmp_path / "r")
    for t in range(9):
        put(folder, f"left_{t}.png", b"x")
    _, checks, _ = looked_at(capsys, folder)
    assert "write 'ignore: [./*.png]'" in "".join(doubts(checks, "./ (9 files)"))
    write_folder(folder, ignore=["./*.png"])
    _, checks, _ = looked_at(capsys, folder)
    assert [c["verdict"] for c in checks if c["about"] in ("left out", "ignore")] == ["ok"]


def test_what_the_user_ignores_is_ok_and_nothing_else_is(tmp_path: Path, capsys: Capture) -> None:
    folder = write_folder(tmp_path / "r", ignore=["*.bin", "left/"])
    for name in ("x.bin", "y/z.bin", "left/0.png", "left/more/1.png"):
        put(folder, name, b"\0")
    code, checks, _ = looked_at(capsys, folder)
    (left,) = [c for c in checks if c["about"] == "left out"]
    assert (code, left["verdict"]) == (0, "ok")
    assert left["says"].endswith("(not used, as 'ignore' says)")


@pytest.mark.parametrize(
    ("patterns", "words"),
    [(["x.bin", "nope*"], "'nope*', which matches no file; those that are not used are x.bin"),
     (["x.bin", "color/*"], "'color/*', which matches 'color/0000.png', and that is used")],
)  # fmt: skip
def test_a_pattern_that_cannot_be_honored_is_refused(
    tmp_path: Path, capsys: Capture, patterns: list[str], words: str
) -> None:
    folder = write_folder(tmp_path / "r", ignore=patterns)
    put(folder, "x.bin", b"\0")
    code, _, problem = looked_at(capsys, folder)
    assert code == 3
    assert words in problem


def test_keys_that_nothing_reads_are_asked_about_until_they_are_ignored(tmp_path: Path, capsys: Capture) -> None:
    open3d = {"width": 32, "height": 24, "intrinsic_matrix": K.T.ravel().tolist(), "radial_params": [0.3]}
    folder = write_folder(tmp_path / "r", intrinsics=None)
    put(folder, "intrinsic.json", open3d)
    _, checks, _ = looked_at(capsys, folder)
    assert "ignore: ['intrinsic.json:radial_params']" in "".join(doubts(checks, "intrinsic.json"))
    write_folder(folder, intrinsics=None, ignore=["intrinsic.json:radial_params"])
    code, checks, _ = looked_at(capsys, folder)
    assert (code, doubts(checks, "intrinsic.json")) == (0, [])


def test_files_of_rh20t_and_of_tum_are_known(tmp_path: Path, capsys: Capture) -> None:
    episode = tmp_path / "task" / "take"
    write_camera(episode)
    write_calibration(tmp_path / "task")
    put(episode, "timestamp.txt", "1649\n")
    put(episode, "metadata.json", {"rating": 3, "calib_quality": 2, "odd": 1})
    put(episode, "extra.json", {"x": 1})
    _, checks, _ = looked_at(capsys, episode)
    assert "keys that are not read: odd" in "".join(doubts(checks, "metadata.json"))
    assert doubts(checks, "extra.json")
    folder = tmp_path / "desk"
    for kind in ("rgb", "depth"):
        for t in range(STEPS):
            (write_folder(tmp_path / "x") / f"{'color' if kind == 'rgb' else 'depth'}/{t:04d}.png").rename(
                _there(folder / f"{kind}/{t}.png")
            )
        put(folder, f"{kind}.txt", "".join(f"{1.7e9 + t / 10:.6f} {kind}/{t}.png\n" for t in range(STEPS)))
    put(folder, "depth/99.png", (folder / "depth/0.png").read_bytes())
    put(folder, "accelerometer.txt", lines(np.c_[CLOCK, ROWS[:, :3]], " "))
    put(folder, "recording.yaml", "depth_unit_m: 0.001\nintrinsics: {fx: 30, fy: 31, cx: 15.2, cy: 11.7}\n")
    _, checks, _ = looked_at(capsys, folder)
    assert [c for c in checks if c["verdict"] == "doubtful"] == []
    put(folder, "calibration.txt", "520 520 15 11")
    _, checks, _ = looked_at(capsys, folder)
    assert "'intrinsics'" in "".join(doubts(checks, "calibration.txt"))


def _there(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


# --- columns that say which picture a row belongs to, and clocks ---------------------------------------------

COUNT = 16
WALK = np.cumsum(np.random.default_rng(3).normal(0, 0.02, COUNT))
SWAY = 0.3 * np.sin(0.7 * np.arange(COUNT))
SHUFFLED = np.random.default_rng(1).permutation(COUNT)
JITTER = 0.1 * np.arange(COUNT) + np.random.default_rng(0).normal(0, 0.008, COUNT)
UNEVEN = np.cumsum(np.random.default_rng(3).uniform(0.06, 0.14, COUNT))
UNEVEN *= 0.1 * (COUNT - 1) / (UNEVEN[-1] - UNEVEN[0])


def columns(names: str, *values: Any) -> str:
    rows = zip(*values, strict=True)
    return f"{names}\n" * bool(names) + "".join(",".join(map(str, row)) + "\n" for row in rows)


@pytest.mark.parametrize(
    "text",
    [columns("filename,v", [f"{t:04d}.png" for t in SHUFFLED], SHUFFLED * 1.5),
     columns("v,image,time", SHUFFLED * 1.5, [f"color/{t:04d}.png" for t in SHUFFLED], 5 * SHUFFLED),
     columns("frame,v", SHUFFLED, SHUFFLED * 1.5),
     columns("image_number,v", range(COUNT)[::-1], 1.5 * np.arange(COUNT)[::-1])],
)  # fmt: skip
def test_rows_that_name_their_pictures_belong_to_these(tmp_path: Path, text: str) -> None:
    folder = write_folder(tmp_path / "r", steps=COUNT, state="s.csv")
    put(folder, "s.csv", text)
    np.testing.assert_allclose(opened(folder).state[:, 0], 1.5 * np.arange(COUNT))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (columns("idx,v", range(1, COUNT + 1), WALK), "column 'idx' counts the rows; .*row's picture, 'frame'"),
        (columns("k,v", SHUFFLED, WALK), "column 'k' counts by one"),
        (columns("v,counter", WALK, 5 * np.arange(COUNT)), "column 'counter' counts the rows"),
        (columns("", WALK, range(COUNT)), "column 2 counts by one"),
        (columns("img,v", [f"{t + 1:04d}.png" for t in range(COUNT)], WALK), "not all are color pictures"),
        (columns("frame,v", [*range(COUNT - 1), 3], WALK), "names one picture in the rows 4 and 16"),
        (columns("image_id,v", range(1, COUNT + 1), WALK), "state 1 to 16: .*'state_offset_s: 0'"),
        (columns("", WALK, SWAY, JITTER), "column 3 goes on by 1 a second"),
        (columns("", WALK, 1e6 * UNEVEN), "column 2 goes on by 1000000 a second"),
        (np.c_[WALK, 77 + JITTER], "column 2 goes on by 1 a second"),
        (columns("v,ms", WALK, 100 * np.arange(COUNT) % 1000), "column 'ms' is called as times are"),
        (columns("m,v", (1.7e9 + JITTER) / 60, WALK), "column 'm' goes on by 1/60 a second"),
        (columns("jd,v", [f"{2460263.5 + t / 86400:.9f}" for t in JITTER], WALK), "column 'jd' goes on by 1/86400"),
        (columns("x,y,z", WALK, SWAY, 0.1 * np.arange(COUNT)), ""),
        (columns("x,y,progress", WALK, SWAY, np.arange(COUNT) / COUNT), ""),
        (np.c_[WALK, SWAY, 0.09 * np.arange(COUNT), 0.0167 / 10 * np.arange(COUNT)], ""),
        (np.c_[WALK, 1.0 - np.cos(np.linspace(0, np.pi, COUNT))], ""),
    ],
)
def test_columns_that_count_or_go_as_clocks_are_asked_about(
    tmp_path: Path, capsys: Capture, text: str | np.ndarray, words: str
) -> None:
    file = "s.csv" if isinstance(text, str) else "s.npy"
    folder = write_folder(tmp_path / "r", steps=COUNT, state=file)
    put(folder, file, text)
    code, out, _ = call_cli(capsys, "track-real", folder, "--dry-run", "--json")
    (facts,) = json.loads(out)["recordings"]
    assert code == (3 if words else 0), facts["problem"]
    assert re.search(words, facts["problem"] or ""), facts["problem"]
    assert words or [c for c in facts["checks"] if c["verdict"] in ("doubtful", "refused")] == []


@pytest.mark.parametrize("column", [JITTER, np.arange(COUNT)[::-1]])
def test_arrays_with_a_clock_or_a_count_among_the_state_are_refused(
    tmp_path: Path, capsys: Capture, column: np.ndarray
) -> None:
    arrays = {"img": colors(COUNT), "depth": counts(COUNT), "agent_pos": np.c_[WALK, column]}
    np.savez(tmp_path / "r.npz", **arrays)
    write_yaml(tmp_path / "r.yaml", fps=10, depth_unit_m=0.001, intrinsics=INTRINSICS)
    code, checks, _ = looked_at(capsys, tmp_path / "r.npz")
    assert (code, [c["verdict"] for c in checks if c["about"] == "state numbers"]) == (3, ["refused"])


# --- tables of poses and files that are no tables -------------------------------------------------------------

EUROC = "#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []\n"


def test_columns_of_poses_are_told_by_their_names(tmp_path: Path) -> None:
    put(tmp_path, "p.csv", EUROC + lines(np.c_[1e9 * TUM[:, :1], TUM[:, 1:4], TUM[:, 7:], TUM[:, 4:7]]))
    own, T = read_poses(tmp_path / "p.csv")
    assert own is not None
    np.testing.assert_allclose(own[0], CLOCK)
    np.testing.assert_allclose(T, POSES, atol=1e-4)
    for names, odd in ("t,a,b,c,d,e,f,g", "t, a, b"), ("t,tx [mm],ty [mm],tz [mm],qx,qy,qz,qw", r"tx \[mm\]"):
        put(tmp_path, "p.csv", f"{names}\n" + lines(TUM))
        with pytest.raises(DataError, match=rf"{odd}.* not known, expected poses"):
            read_poses(tmp_path / "p.csv")


@pytest.mark.parametrize("key", ["state", "times", "T_world_cam_file"])
def test_what_is_no_table_is_refused_as_that(tmp_path: Path, capsys: Capture, key: str) -> None:
    folder = write_folder(tmp_path / "r", **{key: "x.json"}, fps=None if key == "times" else 10)
    put(folder, "x.json", POSES.tolist())
    code, out, _ = call_cli(capsys, "track-real", folder, "--dry-run", "--json")
    (facts,) = json.loads(out)["recordings"]
    assert (code, "x.json: is no table; write its numbers as .npy" in facts["problem"]) == (3, True)


@pytest.mark.parametrize(
    ("intrinsics", "words"),
    [
        ({"fx": 3.4, "fy": 3.4, "cx": 1.8, "cy": 1.35}, "fx: ..., fy: ..., cx: ..., cy: ..."),
        ({"fx": 0.94, "fy": 1.25, "cx": 0.495, "cy": 11.7}, "cx: 15.34, cy: 11.7}"),
    ],
)
def test_no_principal_point_is_offered_that_would_be_refused(
    tmp_path: Path, capsys: Capture, intrinsics: dict[str, float], words: str
) -> None:
    code, _, problem = looked_at(capsys, write_folder(tmp_path / "r", intrinsics=intrinsics))
    assert code == 3
    assert words in problem


def test_poses_that_map_the_world_to_the_camera_are_called_so(tmp_path: Path, capsys: Capture) -> None:
    arrays = {"img": colors(), "depth": counts(), "world_to_camera": POSES}
    np.savez(tmp_path / "r.npz", **arrays)
    write_yaml(tmp_path / "r.yaml", fps=10, depth_unit_m=0.001, intrinsics=INTRINSICS)
    _, out, _ = call_cli(capsys, "track-real", tmp_path / "r.npz", "--dry-run", "--json")
    assert (
        "'world_to_camera' maps the world to the camera, by its name; " in json.loads(out)["recordings"][0]["problem"]
    )
