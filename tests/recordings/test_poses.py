"""A camera that moves, with its poses: labels are in the world, and poses that are wrong are found.

The scene is filmed by ray casting, so where everything truly is follows from the poses and nothing else.
"""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dry_runs import dry_run
from filmed_scenes import FLOOR, TABLE, THINGS, WALL, Box, film, looking
from real_recordings import write_png, write_yaml
from scipy.spatial.transform import Rotation
from synthetic import call_cli
from test_ros_reader import Messages, Say, instant, write_bag

import flowlab
from flowlab.geometry.camera import Camera
from flowlab.geometry.transforms import inverse, rigid
from flowlab.recordings.parsing import RecordingSettings, parse_recording
from flowlab.recordings.pose_scale import scaled
from flowlab.recordings.preview import preview_recording
from flowlab.recordings.readers.plain import write_rgbd_recording
from flowlab.records import Episode
from flowlab.storage.checks import episode_problems
from flowlab.storage.shard import Shard

Capture = pytest.CaptureFixture[str]
Frames = list[tuple[np.ndarray, np.ndarray]]
SIZE = (160, 120)
K = np.array([[150.0, 0, 79.5], [0, 150.0, 59.5], [0, 0, 1]])
GIVEN = {"fx": 150.0, "fy": 150.0, "cx": 79.5, "cy": 59.5}
FPS = 10
CLOCK = np.arange(14) / FPS
CARRIED = Box((-0.15, -0.2, 0.08), (0.18, 0.16, 0.16), (220, 210, 60))
STEP = np.array([0.012, 0.004, 0.0])
"""What the box moves by from frame to frame [m]."""


def pose(t: float) -> np.ndarray:
    """Where somebody's hand holds the camera."""
    a = 0.35 * np.sin(1.1 * t)
    eye = (0.85 * np.sin(a) + 0.02 * np.sin(4 * t), -0.85 * np.cos(a), 0.65 + 0.05 * np.sin(2.5 * t))
    return looking(eye, (0.03 * np.sin(3 * t), 0.0, 0.05))


POSES = np.stack([pose(t) for t in CLOCK])


@pytest.fixture(scope="module")
def frames() -> Frames:
    scene = (TABLE, WALL, FLOOR, *THINGS[1:])
    return [film((*scene, CARRIED.moved(k * STEP)), K, SIZE, T, seed=k) for k, T in enumerate(POSES)]


# --- the same recording, in every layout that has poses ----------------------------------------------------


def put(folder: Path, frames: Frames, T: Any = None, **keys: Any) -> Path:
    """A plain folder, with a file of poses."""
    for k, (rgb, depth) in enumerate(frames):
        write_png(folder / "color" / f"{k:04d}.png", rgb)
        write_png(folder / "depth" / f"{k:04d}.png", np.rint(depth * 5000).astype(np.uint16))
    if T is not None:
        np.save(folder / "T.npy", T)
        keys = {"T_world_cam_file": "T.npy", **keys}
    write_yaml(folder / "recording.yaml", **{"fps": FPS, "depth_unit_m": 0.0002, "intrinsics": GIVEN, **keys})
    return folder


def tum_lines(time_s: np.ndarray, T: np.ndarray) -> str:
    rows = np.column_stack([time_s, T[:, :3, 3], Rotation.from_matrix(T[:, :3, :3]).as_quat()])
    return "# ground truth trajectory\n# timestamp tx ty tz qx qy qz qw\n" + "".join(
        " ".join(f"{x:.6f}" for x in row) + "\n" for row in rows
    )


def put_tum(folder: Path, frames: Frames, poses: str | None = None) -> Path:
    """A sequence of the benchmark; its ground truth comes 100 times a second, from before to after the pictures."""
    start = 1305031102.175
    for name, k in (("rgb", 0), ("depth", 1)):
        for t, frame in zip(CLOCK, frames, strict=True):
            counts = frame[0] if k == 0 else np.rint(frame[1] * 5000).astype(np.uint16)
            write_png(folder / name / f"{start + t:.6f}.png", counts)
        (folder / f"{name}.txt").write_text("".join(f"{start + t:.6f} {name}/{start + t:.6f}.png\n" for t in CLOCK))
    own = np.arange(-0.1037, CLOCK[-1] + 0.1, 0.01)
    text = tum_lines(start + own, np.stack([pose(t) for t in own])) if poses is None else poses
    (folder / "groundtruth.txt").write_text(text)
    write_yaml(folder / "recording.yaml", intrinsics=GIVEN)
    return folder


def put_arrays(folder: Path, frames: Frames) -> Path:
    folder.mkdir(parents=True)
    path = folder / "episode.npz"
    rgb, depth = (np.stack(part) for part in zip(*frames, strict=True))
    np.savez(path, rgb=rgb, depth=depth.astype(np.float32), time=CLOCK, K=K, T_world_cam=POSES)
    write_yaml(path.with_suffix(".yaml"), depth_unit_m=1.0)
    return path


def say_frames(m: Messages, say: Say, frames: Frames) -> None:
    image, size = "sensor_msgs/msg/Image", {"width": SIZE[0], "height": SIZE[1]}
    for k, (rgb, depth) in enumerate(frames):
        say("/cam/rgb/image_raw", image, instant(k), m.image(rgb, "rgb8", instant(k), "optical"))
        counts = np.rint(depth * 1000).astype(np.uint16)
        say("/cam/depth_registered/image", image, instant(k), m.image(counts, "16UC1", instant(k), "optical"))
        about = m.info({**GIVEN, **size}, instant(k), "optical")
        say("/cam/rgb/camera_info", "sensor_msgs/msg/CameraInfo", instant(k), about)


def pose_message(m: Messages, T: np.ndarray, time_ns: int, kind: str, child: str) -> Any:
    q = dict(zip("xyzw", map(float, Rotation.from_matrix(T[:3, :3]).as_quat()), strict=True))
    xyz = dict(zip("xyz", map(float, T[:3, 3]), strict=True))
    turn, header = m.make("geometry_msgs/msg/Quaternion", **q), m.header(time_ns, "map")
    if kind.endswith("TransformStamped"):
        both = m.make(
            "geometry_msgs/msg/Transform", translation=m.make("geometry_msgs/msg/Vector3", **xyz), rotation=turn
        )
        return m.make(kind, header=header, child_frame_id=child, transform=both)
    at = m.make("geometry_msgs/msg/Pose", position=m.make("geometry_msgs/msg/Point", **xyz), orientation=turn)
    if kind.endswith("PoseStamped"):
        return m.make(kind, header=header, pose=at)
    still = m.make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
    twist = m.make("geometry_msgs/msg/Twist", linear=still, angular=still)
    return m.make(
        kind, header=header, child_frame_id=child,
        pose=m.make("geometry_msgs/msg/PoseWithCovariance", pose=at, covariance=np.zeros(36)),
        twist=m.make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
    )  # fmt: skip


def put_ros(
    folder: Path, frames: Frames, kind: str = "geometry_msgs/msg/PoseStamped", child: str = "", **keys: Any
) -> Path:
    """A bag with poses 30 times a second; where they are of a frame of their own, a static transform leads to the
    camera's."""
    T_child_cam = looking((0.05, -0.1, 0.03)) if child == "flange" else np.eye(4)

    def say_all(m: Messages, say: Say) -> None:
        say_frames(m, say, frames)
        for k in range(-3, 3 * len(frames) + 3):
            at, T = instant(0) + k * 33_333_333, pose(k * 0.033333333) @ inverse(T_child_cam)
            say("/tracked", kind, at, pose_message(m, T, at, kind, child))
            say("/other", kind, at, pose_message(m, np.eye(4), at, kind, child))
        if child == "flange":
            fixed = m.make("tf2_msgs/msg/TFMessage", transforms=[m.transform("flange", "optical", T_child_cam)])
            say("/tf_static", "tf2_msgs/msg/TFMessage", instant(0), fixed)

    folder.mkdir(parents=True)
    path = write_bag(folder / "rec.mcap", 2, say_all)
    write_yaml(path / "recording.yaml", **{"topics": {"T_world_cam": "/tracked"}, **keys})
    return path


ODOMETRY, TRANSFORM = "nav_msgs/msg/Odometry", "geometry_msgs/msg/TransformStamped"
LAYOUTS: dict[str, Callable[[Path, Frames], Path]] = {
    "plain, an array": lambda p, f: put(p, f, POSES),
    "tum": put_tum,
    "arrays": put_arrays,
    "ros": put_ros,
    "ros, odometry of a flange": lambda p, f: put_ros(p, f, ODOMETRY, "flange"),
}


def looked_at(capsys: Capture, path: Path) -> tuple[int, dict[str, tuple[str, str]], str, dict[str, Any]]:
    """Exit code, what came of each thing that was looked at, the problem, and all facts."""
    run = dry_run(capsys, path)
    return run.code, run.checks, run.problem, run.facts


def labeled(capsys: Capture, path: Path, out: Path, *more: str, tracker: str = "lucas-kanade") -> Episode:
    box = "observer.crop={low: [-0.5, -0.4, -0.1], high: [0.5, 0.5, 0.5]}"
    command = ("track-real", path, "--out", out, "--task", "carry", "--workers", "1", "--set", box, *more)
    code, _, errors = call_cli(capsys, *command, "--tracker", tracker)
    assert code == 0, errors
    (episode,) = flowlab.open_dataset(out).episodes()
    return episode


def errors_mm(e: Episode, every: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """How far visible points are from where they truly are, by then: of the still scene, and of the box."""
    first = e.tracks.xyz_world[0].astype(float)
    half = np.array(CARRIED.size) / 2
    inside = (np.abs(first - CARRIED.center) < half + 0.006).all(1) & (first[:, 2] > 0.02)
    near = (np.abs(first - CARRIED.center) < half + 0.03).all(1) & ~inside
    steps = every * np.arange(len(e))[:, None, None] * STEP
    off = 1e3 * np.linalg.norm(e.tracks.xyz_world - (first + steps * inside[:, None]), axis=-1)
    seen = e.tracks.visible
    assert inside.sum() >= 5
    return off[:, ~inside & ~near][seen[:, ~inside & ~near]], off[:, inside][seen[:, inside]]


@pytest.mark.parametrize("layout", LAYOUTS)
def test_labels_are_in_the_world(frames: Frames, tmp_path: Path, capsys: Capture, layout: str) -> None:
    path = LAYOUTS[layout](tmp_path / "in", frames)
    code, found, problem, _ = looked_at(capsys, path)
    assert (code, problem) == (0, "None")
    assert {v for v, _ in found.values()} <= {"ok", "assumed"}, found
    assert found["camera"][0] == "ok", found["camera"]
    e = labeled(capsys, path, tmp_path / "out")
    np.testing.assert_allclose(e.T_world_cam, POSES, atol=2e-3)
    np.testing.assert_allclose(e.camera.T_world_cam, e.T_world_cam[0])
    still, box = errors_mm(e)
    assert np.median(still) < 10
    assert np.median(box) < 10
    assert call_cli(capsys, "validate", tmp_path / "out")[0] == 0


def test_without_poses_it_is_doubtful_and_said_what_to_give(frames: Frames, tmp_path: Path, capsys: Capture) -> None:
    code, found, _, _ = looked_at(capsys, put(tmp_path / "r", frames))
    assert (code, found["camera"][0]) == (0, "doubtful")
    assert "it moves, and is taken as fixed" in found["camera"][1]
    assert "'T_world_cam_file: ...'" in found["camera"][1]


# --- poses that are wrong ----------------------------------------------------------------------------------

OPENGL = np.diag([1.0, -1, -1, 1])
BODY = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
MILLIMETERS = POSES.copy()
MILLIMETERS[:, :3, 3] *= 1000


def on_a_flange(degrees: float) -> np.ndarray:
    """From the frame of a flange to that of a camera that is mounted on it."""
    return rigid(Rotation.from_euler("z", degrees, degrees=True).as_matrix(), np.array([0.0, 0.03, -0.06]))


LATE = np.stack([pose(t - 0.3) for t in CLOCK])


@pytest.mark.parametrize(
    ("T", "verdict", "words"),
    [
        (looking((2.0, 1, 1)) @ POSES, "ok", "it moves: under its poses the scene stays within"),
        (inverse(POSES), "refused", "if each were the inverse, world to camera"),
        (POSES @ OPENGL, "refused", "in OpenGL's axes"),
        (inverse(POSES @ OPENGL), "refused", "the inverse, in OpenGL's axes"),
        (POSES @ inverse(BODY), "refused", "that of a body"),
        (MILLIMETERS, "refused", "in millimeters"),
        (LATE, "refused", "-0.3 s were added .* write 'T_world_cam_offset_s: -0.3'"),
        (np.stack([pose(t + 0.1) for t in CLOCK]), "doubtful", "0.1 s were added"),
        (scaled(POSES, 0.7), "refused", r"moved 1\.4\d times as far: poses are in another unit or of no known scale"),
        (scaled(POSES, 0.87), "doubtful", r"moved 1\.1\d times as far"),
        (POSES[::-1].copy(), "refused", "explain too little|must be those of the color camera itself"),
        (POSES @ looking((0.1, -0.2, 0.05)), "refused", "not of a flange"),
        (POSES @ on_a_flange(30), "refused", r"on which the camera is turned by (29|30|31) degrees and [67]. mm away"),
        (POSES @ on_a_flange(8), "doubtful", r"turned by [789] degrees and [67]. mm away"),
        (np.tile(POSES[:1], (len(POSES), 1, 1)), "refused", "explain too little"),
    ],
)  # fmt: skip
def test_poses_that_are_not_the_cameras_are_refused(
    frames: Frames, tmp_path: Path, capsys: Capture, T: np.ndarray, verdict: str, words: str
) -> None:
    code, found, problem, _ = looked_at(capsys, put(tmp_path / "r", frames, T))
    assert found["camera"][0] == verdict, found["camera"]
    assert re.search(words, found["camera"][1]), found["camera"]
    assert code == (3 if verdict == "refused" else 0), problem


def lost(first: int, last: int) -> np.ndarray:
    """Poses of a camera whose tracking stood still for a while."""
    T = POSES.copy()
    T[first:last] = T[first]
    return T


@pytest.mark.parametrize(("T", "verdict"), [(lost(3, 11), "refused"), (lost(4, 8), "doubtful"), (POSES, "ok")])
def test_poses_that_are_wrong_for_a_while_are_found(
    frames: Frames, tmp_path: Path, capsys: Capture, T: np.ndarray, verdict: str
) -> None:
    code, found, problem, _ = looked_at(capsys, put(tmp_path / "r", frames, T))
    assert (code, found["camera"][0]) == (3 if verdict == "refused" else 0, verdict), found["camera"]
    if verdict != "ok":
        assert re.search(r"not between \d of them, by .* mm from .*0\d\d\d.png to", found["camera"][1]), problem


def test_true_poses_are_not_refused_for_a_hand_that_fills_the_picture(tmp_path: Path, capsys: Capture) -> None:
    scene, shots = (TABLE, WALL, FLOOR, *THINGS), []
    for k, T in enumerate(POSES):
        near = T[:3, 3] + 0.3 * T[:3, 2] + (0.02 * k - 0.14) * T[:3, 0]
        hand = [Box(tuple(near), (0.5, 0.5, 0.05), (200, 150, 130))] if 6 <= k <= 8 else []
        shots.append(film((*scene, *hand), K, SIZE, T, seed=k))
    code, found, problem, _ = looked_at(capsys, put(tmp_path / "r", shots, POSES))
    assert (code, found["camera"][0]) in ((0, "ok"), (0, "doubtful")), problem


@pytest.mark.parametrize(("T", "verdict"), [(POSES, "ok"), (scaled(POSES, 0.7), "refused")])
def test_a_gripper_before_a_camera_at_the_wrist_says_nothing_of_its_poses(
    frames: Frames, tmp_path: Path, capsys: Capture, T: np.ndarray, verdict: str
) -> None:
    texture = np.kron(np.random.default_rng(0).uniform(60, 200, (9, 20)), np.ones((8, 8)))[:, :, None]
    held = [(rgb.copy(), depth.copy()) for rgb, depth in frames]
    for k, (rgb, depth) in enumerate(held):  # it fills 60 % of the picture
        noise = np.random.default_rng(k).normal(size=(2, 72, 160))
        rgb[48:], depth[48:] = texture + 3 * noise[0][..., None], 0.25 + 0.0005 * noise[1]
    code, found, problem, _ = looked_at(capsys, put(tmp_path / "r", held, T))
    assert (code, found["camera"][0]) == (3 if verdict == "refused" else 0, verdict), problem


def moved(rows: slice | list[int], by: float) -> np.ndarray:
    T = POSES.copy()
    T[rows, 0, 3] += by
    return T


@pytest.mark.parametrize(
    ("T", "verdict", "words"),
    [
        (POSES, "ok", "no pose leaps"),
        (moved([9], 0.2), "doubtful", "1 poses leap away and back, at color/"),
        (moved([6, 7], -0.15), "doubtful", "2 poses leap away and back, at color/"),
        (np.repeat(POSES[::2], 2, axis=0)[: len(POSES)], "doubtful", "equal the one before"),
    ],
)
def test_single_poses_that_cannot_be_are_doubtful(
    frames: Frames, tmp_path: Path, capsys: Capture, T: np.ndarray, verdict: str, words: str
) -> None:
    _, found, _, _ = looked_at(capsys, put(tmp_path / "r", frames, T))
    assert found["steps of poses"][0] == verdict
    assert words in found["steps of poses"][1]
    assert "added to the times" not in found["camera"][1]


@pytest.mark.parametrize(("read", "code", "verdict"), [(lambda T: T, 0, "ok"), (inverse, 3, "refused")])
def test_poses_of_a_slow_camera_are_tested_over_longer(
    tmp_path: Path, capsys: Capture, read: Callable[[np.ndarray], np.ndarray], code: int, verdict: str
) -> None:
    T = np.stack([looking((0.012 * t, -0.85, 0.65), (0.012 * t, 0.1, 0.05)) for t in range(24)])
    shots = [film((TABLE, WALL, FLOOR, *THINGS), K, SIZE, one, seed=k) for k, one in enumerate(T)]
    found = looked_at(capsys, put(tmp_path / "r", shots, read(T)))
    assert (found[0], found[1]["camera"][0]) == (code, verdict), found[1]["camera"]


def test_poses_of_another_clock_are_shifted_as_said(frames: Frames, tmp_path: Path, capsys: Capture) -> None:
    own = np.arange(-0.5, CLOCK[-1] + 0.5, 0.02)
    path = put(tmp_path / "r", frames, T_world_cam_file="T.txt", time_unit="s", times="times.txt", fps=None)
    (path / "times.txt").write_text("".join(f"{100 + t:.3f}\n" for t in CLOCK))
    (path / "T.txt").write_text(tum_lines(100.3 + own, np.stack([pose(t) for t in own])))
    code, found, problem, _ = looked_at(capsys, path)
    assert (code, found["camera"][0]) == (3, "refused")
    assert "'T_world_cam_offset_s: -0.3'" in problem
    text = (path / "recording.yaml").read_text() + "T_world_cam_offset_s: -0.3\n"
    (path / "recording.yaml").write_text(text)
    code, found, problem, _ = looked_at(capsys, path)
    assert (code, found["camera"][0]) == (0, "ok"), problem


# --- poses that are missing, or none -----------------------------------------------------------------------


def test_frames_without_a_pose_are_left_out_and_counted(frames: Frames, tmp_path: Path, capsys: Capture) -> None:
    known = np.r_[0:6, 7 : len(CLOCK)]  # 200 ms without one
    path = put(tmp_path / "r", frames, T_world_cam_file="T.txt", times="times.txt", fps=None)
    (path / "times.txt").write_text("".join(f"{100 + t:.3f}\n" for t in CLOCK))
    (path / "T.txt").write_text(tum_lines(100 + CLOCK[known], POSES[known]))
    code, found, problem, facts = looked_at(capsys, path)
    assert (code, problem, found["camera"][0]) == (0, "None", "ok")
    ((name, why),) = facts["bad_frames"]
    assert name.endswith("0006.png")
    assert "no pose" in why
    assert found["poses"][0] == "doubtful"
    assert f"in {len(known)} of {len(CLOCK)} frames" in found["poses"][1]
    with (path / "recording.yaml").open("a") as file:
        file.write("T_world_cam_gap_s: 0.25\n")
    code, found, _, facts = looked_at(capsys, path)
    assert (code, facts["bad_frames"], found["poses"][0]) == (0, [], "ok")
    (path / "T.txt").write_text(tum_lines(100 + CLOCK[:8], POSES[:8]))
    code, _, problem, _ = looked_at(capsys, path)
    assert code == 3
    assert "6 of 14 frames are bad" in problem


NOT_RIGID = POSES.copy()
NOT_RIGID[3, :3, :3] *= 1.1
HOLE = POSES.copy()
HOLE[2, 0, 3] = np.nan
QUATERNIONS = np.column_stack([POSES[:, :3, 3], Rotation.from_matrix(POSES[:, :3, :3]).as_quat()])


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (POSES[:9], "has 9 poses for 14 color pictures"),
        (NOT_RIGID, "pose 4 holds no rotation"),
        (HOLE, "pose 3 holds what is no number"),
        (POSES[:, :2], "expected poses: an array"),
        (np.zeros((14, 5)), "has 5 numbers a line, expected poses"),
        (np.array(["a"]), "expected numbers"),
        (QUATERNIONS, "has 7 numbers a line, expected poses"),
        (tum_lines(CLOCK[::-1], POSES), "must rise"),
        ("time,qw,qx,qy,qz,tx,ty,tz\n" + "".join(f"{t},1,0,0,0.5,0,0,0\n" for t in CLOCK), "no unit quaternion"),
        ("time,qw,qx,qy,qz,a,b,c\n0,1,0,0,0,0,0,0\n", "expected poses"),
        ("hello\n", "holds no row of numbers"),
        ("", "holds no row of numbers"),
    ],
)
def test_files_that_hold_no_poses_are_refused(
    frames: Frames, tmp_path: Path, capsys: Capture, content: Any, words: str
) -> None:
    name = "T.txt" if isinstance(content, str) else "T.npy"
    path = put(tmp_path / "r", frames, T_world_cam_file=name)
    if isinstance(content, str):
        (path / name).write_text(content)
    else:
        np.save(path / name, content)
    code, _, problem, _ = looked_at(capsys, path)
    assert code in (2, 3)
    assert re.search(words, problem), problem


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"T_world_cam": POSES[0].tolist()}, "T_world_cam says that the camera stands still, and T_world_cam_file"),
        ({"T_world_cam_file": None, "T_world_cam_offset_s": 0.1}, "there are no poses"),
        ({"T_world_cam_file": "nothing.npy"}, "nothing.npy"),
        ({"T_world_cam_file": "../T.npy"}, "in the recording's folder"),
    ],
)
def test_what_is_said_of_poses_must_fit(
    frames: Frames, tmp_path: Path, capsys: Capture, keys: dict[str, Any], words: str
) -> None:
    code, _, problem, _ = looked_at(capsys, put(tmp_path / "r", frames[:3], POSES[:3], **keys))
    assert code in (2, 3)
    assert re.search(words, problem), problem


@pytest.mark.parametrize(
    ("text", "words"),
    [("0 hello\n", "groundtruth.txt is not used: its first line is not"), ("1 2 3\n", "groundtruth.txt is not used")],
)
def test_a_ground_truth_that_is_none_is_told(
    frames: Frames, tmp_path: Path, capsys: Capture, text: str, words: str
) -> None:
    _, found, _, _ = looked_at(capsys, put_tum(tmp_path / "r", frames, text))
    assert (found["poses"][0], found["camera"][0]) == ("doubtful", "doubtful")
    assert words in found["poses"][1]


@pytest.mark.parametrize(
    ("topic", "words"),
    [("/nothing", "has no topic '/nothing'"), ("/cam/rgb/image_raw", "holds sensor_msgs/msg/Image, expected"),
     ("/other", "the camera|explain too little")],
)  # fmt: skip
def test_topics_that_have_no_poses_of_the_camera_are_refused(
    frames: Frames, tmp_path: Path, capsys: Capture, topic: str, words: str
) -> None:
    code, _, problem, _ = looked_at(capsys, put_ros(tmp_path / "in", frames, topics={"T_world_cam": topic}))
    assert code == 3
    assert re.search(words, problem), problem


def test_names_of_arrays_must_say_which_way_they_map(frames: Frames, tmp_path: Path, capsys: Capture) -> None:
    path = put_arrays(tmp_path / "in", frames)
    with np.load(path) as held:
        content = {k: held[k] for k in held.files if k != "T_world_cam"}
    np.savez(path, **content, extrinsics=POSES)
    code, _, problem, _ = looked_at(capsys, path)
    assert code == 3
    assert "'extrinsics' does not say whether it maps camera to world" in problem


# --- what becomes of them ----------------------------------------------------------------------------------


def test_what_flowlab_writes_is_read_back(frames: Frames, tmp_path: Path, capsys: Capture) -> None:
    rgb, depth = zip(*frames, strict=True)
    camera = Camera(*SIZE, K, np.eye(4))
    write_rgbd_recording(tmp_path / "r", rgb=rgb, depth=depth, camera=camera, time_s=CLOCK, T_world_cam=POSES)
    code, found, problem, _ = looked_at(capsys, tmp_path / "r")
    assert (code, problem, found["camera"][0]) == (0, "None", "ok")
    e = labeled(capsys, tmp_path / "r", tmp_path / "out", "--set", "recording.every=2")
    np.testing.assert_allclose(e.T_world_cam, POSES[::2], rtol=0, atol=1e-12)
    still, _ = errors_mm(e, every=2)
    assert np.median(still) < 15
    code, _, errors = call_cli(capsys, "viz", tmp_path / "out", "--save", tmp_path / "e.rrd")
    assert code == 0, errors


def test_rigid_motions_are_in_the_world(frames: Frames, tmp_path: Path, capsys: Capture) -> None:
    e = labeled(capsys, put(tmp_path / "r", frames, POSES), tmp_path / "out", tracker="rigid-bodies")
    still, box = errors_mm(e)
    assert np.median(still) < 6
    assert np.median(box) < 10


def test_stored_poses_are_validated(frames: Frames, tmp_path: Path, capsys: Capture) -> None:
    out = tmp_path / "out"
    labeled(capsys, put(tmp_path / "r", frames[:4], POSES[:4]), out)
    (shard,) = (out / "shards").iterdir()
    (e,) = Shard(shard).episodes()
    assert e.T_world_cam is not None
    assert list(episode_problems(e, flowlab.open_dataset(out).provenance)) == []
    e.T_world_cam[2, :3, :3] *= 2
    (problem,) = episode_problems(e, flowlab.open_dataset(out).provenance)
    assert problem.array == "data/T_world_cam"
    assert "holds no rotation" in problem.what


def test_the_sheet_shows_the_world_and_the_cameras_path(frames: Frames, tmp_path: Path) -> None:
    path = put(tmp_path / "r", frames, POSES)
    preview = preview_recording(path, RecordingSettings(), parse_recording(path, RecordingSettings()))
    assert preview.cloud is not None
    np.testing.assert_allclose(preview.cloud.camera_path_world, POSES[:, :3, 3])
    assert np.abs(np.median(preview.cloud.xyz_world[:, 2])) < 0.15  # the table, and what stands on it
    assert "T.npy" in [s.name for s in preview.streams]
