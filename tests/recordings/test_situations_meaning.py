"""What the numbers of a robot are, and whose: times among them, two publishers, names that are chosen."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from dry_runs import dry_run
from real_recordings import INTRINSICS, STEPS, colors, counts, write_folder, write_yaml
from test_ros_reader import START_NS, STEP_NS, Messages, Say, instant, say_camera, say_robot_and_camera, write_bag

from flowlab.errors import DataError
from flowlab.recordings.clock_numbers import find_clocks
from flowlab.recordings.readers.publishers import Who, tell_apart
from flowlab.recordings.tables import parse_table
from flowlab.recordings.turns import find_turns

Capture = pytest.CaptureFixture[str]
Verdicts = dict[str, tuple[str, str]]
JOINTS, POSE = "sensor_msgs/msg/JointState", "geometry_msgs/msg/PoseStamped"
ODD = "std_msgs/msg/ColorRGBA"
ROWS = 12
T = np.arange(ROWS) / 10
X = np.stack([T**2, 1 - T, np.sin(7 * T)], 1)
EPOCH = 1.7e9 + T


def looked_at(capsys: Capture, path: Path) -> tuple[int, dict[str, Any], Verdicts]:
    """Exit code, the facts of a dry run, and what came of each check."""
    run = dry_run(capsys, path)
    return run.code, run.facts, run.checks


def lines(header: str, *columns: np.ndarray, sep: str = ",", form: str = "{:.6f}") -> str:
    rows = [sep.join(form.format(x) for x in row) for row in np.stack(columns, 1)]
    return "\n".join([header, *rows] if header else rows) + "\n"


# --- times among the numbers of a robot ---------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (lines("host_timestamp_ms,x,y", 1000 * T, *X[:, :2].T), r"'host_timestamp_ms' is called.*\['x', 'y'\]"),
        (lines("local_time,x", EPOCH, X[:, 0]), "'local_time' is beyond"),
        (lines("x,y,robot_timestamp", X[:, 0], X[:, 1], EPOCH), "'robot_timestamp' is beyond"),
        (lines("Zeit;x;y", T, X[:, 0], X[:, 1], sep=";"), "'Zeit' is called as times are"),
        (lines("x,time_since_start", X[:, 0], T), "'time_since_start' is called"),
        (lines("", X[:, 0], X[:, 1], EPOCH), "column 3 is beyond"),
        (lines("", X[:, 0], T, X[:, 1]), "column 2 goes on by 1 a second"),
        (lines("", X[:, 0], 5e5 + 1000 * T), "column 2 goes on by 1000 a second"),
        (lines("x,y,z", *X.T), ""),
        (lines("x,y", T, X[:, 0]), ""),
        (lines("time,x_centimeters", T, 3 * T), ""),
    ],
)
def test_a_clock_in_a_table_is_asked_about(tmp_path: Path, capsys: Capture, text: str, says: str) -> None:
    folder = write_folder(tmp_path / "r", steps=ROWS, state="robot.csv")
    (folder / "robot.csv").write_text(text)
    code, facts, found = looked_at(capsys, folder)
    assert code == (3 if says else 0), facts["problem"]
    assert re.search(says, str(facts["problem"])), facts["problem"]
    assert says or found["state numbers"][0] == "ok"


@pytest.mark.parametrize(
    ("place", "clock", "verdict"),
    [
        (0, EPOCH, "refused"),
        (2, EPOCH, "refused"),
        (1, 1e9 * EPOCH, "refused"),
        (3, 77 + T, "refused"),
        (0, X[:, 0], "ok"),
    ],
)
def test_a_clock_in_arrays_is_refused(
    tmp_path: Path, capsys: Capture, place: int, clock: np.ndarray, verdict: str
) -> None:
    state = np.insert(X, place, clock, axis=1)
    np.savez(tmp_path / "r.npz", img=colors(ROWS), depth=counts(ROWS), state=state, action=X)
    write_yaml(tmp_path / "r.yaml", fps=10, depth_unit_m=0.001, intrinsics=INTRINSICS)
    code, _, found = looked_at(capsys, tmp_path / "r.npz")
    assert (code, found["state numbers"][0]) == (0 if verdict == "ok" else 3, verdict), found["state numbers"]
    assert found["action numbers"][0] == "ok"


def test_what_the_user_names_is_no_clock_to_ask_about(tmp_path: Path, capsys: Capture) -> None:
    folder = write_folder(tmp_path / "r", steps=ROWS, state="robot.csv", state_columns=["robot_time", "x"])
    (folder / "robot.csv").write_text(lines("robot_time,x", EPOCH, X[:, 0]))
    code, facts, _ = looked_at(capsys, folder)
    assert (code, facts["state_names"]) == (0, ["robot_time", "x"])


def test_a_simple_motion_is_no_clock() -> None:
    assert not find_clocks(np.stack([T, 5 + T, 9 + T], 1), (), T)  # all joints move alike
    assert not find_clocks(np.stack([0.9 * T, X[:, 0]], 1), (), T)
    assert not find_clocks(np.stack([T, X[:, 0]], 1), ("joint_1", "joint_2"), T)
    assert not find_clocks(np.stack([T, X[:, 0]], 1), ("left_x", "left_qw"), T)
    for name, rate in (("channel", 1.0), ("counter_us", 1e6)):
        (found,) = find_clocks(np.stack([rate * T, X[:, 0]], 1), (name, "joint_2"), T)
        assert not found.certain


# --- decimal commas -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("0,000,0,200\n0,100,0,200\n0,250,0,200\n", "the cells 0 and 100 may be one number, 0.100"),
        ("0,050\n0,100\n", "one number, 0.050"),
        ("x\n0,050\n0,100\n", "one number, 0.050"),
        ("-0,25,1,75\n0,50,1,50\n", "one number, -0.25"),
        ("1,5,2,8\n1,9,3,1\n2,3,3,4\n2,7,3,7\n3,1,4,0\n", "one number, 1.5"),
        ("1,25e-1,0,20\n1,35e-1,0,21\n", "the cells 1 and 25e-1 may be one number, 1.25e-1"),
        ("0,5E+1\n1,2\n", r"one number, 0\.5E\+1"),
        ("x;y\n1.200,5;2,5\n1.201,5;2,5\n", r"line 2 has '1\.200,5', with a decimal comma or a sign between thousands"),
        ('x,y\n"0,100","0,250"\n', "line 2 has '0,100', with a decimal comma"),
        ("x,y,z\n1,2\n", "line 2 has 2 cells, expected 3, as many as names: '1,2'"),
        ("date,x\n2024-01-05 12:00:00.1,3\n", ""),
        ("0,1,0,1\n1,0,0,1\n0,0,1,1\n", ""),
        ("100,200,300,400\n150,250,310,410\n", ""),
        ("a,b\n1,050\n2,100\n", ""),
        ("a,b\n1,25e-1\n2,35e-1\n", ""),
        ("1e3,25e-1\n2e3,35e-1\n", ""),
    ],
)  # fmt: skip
def test_commas_within_numbers_are_asked_about(text: str, says: str) -> None:
    if not says:
        assert parse_table(Path("s.csv"), text).values.size
        return
    with pytest.raises(DataError, match=says):
        parse_table(Path("s.csv"), text)


# --- publishers ---------------------------------------------------------------------------------------------


def in_turn(name: Callable[[str, int], str], frame: bool) -> Callable[[Messages, Say], None]:
    """Two arms that publish in turn, their joints and frames called so."""

    def say_all(m: Messages, say: Say) -> None:
        say_camera(m, say)
        for k in range(5 * STEPS):
            for arm, offset in (("left", 0.0), ("right", 3.0)):
                time_ns = START_NS + k * STEP_NS // 5 + (5_000_000 if arm == "right" else 0)
                message = m.joints(offset + np.sin(0.2 * k + np.arange(3)), time_ns)
                message.name = [name(arm, j) for j in range(3)] if name("", 0) is not None else []
                message.header.frame_id = f"{arm}_base" if frame else ""
                say("/joint_states", JOINTS, time_ns, message)

    return say_all


def poses_in_turn(m: Messages, say: Say) -> None:
    say_camera(m, say)
    for k in range(2 * STEPS):
        for arm, x in (("left", 0.0), ("right", 1.0)):
            time_ns = START_NS + k * STEP_NS // 2 + (5_000_000 if arm == "right" else 0)
            point = m.make("geometry_msgs/msg/Point", x=x + 0.01 * k * k, y=0.0, z=0.0)
            turn = m.make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
            pose = m.make("geometry_msgs/msg/Pose", position=point, orientation=turn)
            say("/tcp", POSE, time_ns, m.make(POSE, header=m.header(time_ns, arm), pose=pose))


@pytest.mark.parametrize(
    ("path", "version", "say_all", "code", "first"),
    [
        ("r.bag", 1, in_turn(lambda arm, j: f"{arm}{j}", False), 0, "left0"),
        ("r.mcap", 2, in_turn(lambda arm, j: f"j{j}", True), 0, "left_base/j0"),
        ("r.bag", 1, in_turn(lambda arm, j: None, True), 0, "left_base/0"),  # type: ignore[arg-type, return-value]
        ("r.db3", 2, in_turn(lambda arm, j: None, False), 3, None),  # type: ignore[arg-type, return-value]
        ("r.bag", 1, in_turn(lambda arm, j: f"j{j}", False), 3, None),
        ("r.bag", 1, poses_in_turn, 0, "left/0"),
    ],
)
def test_two_on_one_topic_are_told_apart_or_refused(
    tmp_path: Path, capsys: Capture, path: str, version: int, say_all: Any, code: int, first: str | None
) -> None:
    topics = {"state": "/tcp"} if say_all is poses_in_turn else {}
    bag = write_bag(tmp_path / path, version, say_all)
    write_yaml(bag / "recording.yaml" if bag.is_dir() else bag.with_suffix(".yaml"), topics=topics)
    found, facts, checks = looked_at(capsys, bag)
    assert found == code, facts["problem"]
    if first is None:
        assert "leaps between smooth tracks" in checks["state numbers"][1]
    else:
        assert (facts["state_names"][0], facts["state_width"] in (6, 14)) == (first, True)
        assert checks["state numbers"][0] == "ok"


def test_numbers_of_one_robot_do_not_leap() -> None:
    rng, t = np.random.default_rng(0), np.linspace(0, 6, 200)
    arm = np.stack([np.sin(0.4 * t * (k + 1) + k) for k in range(7)], 1) + 1e-3 * rng.normal(size=(200, 7))
    flipped, switched = arm.copy(), arm.copy()
    flipped[:, 3:] *= rng.choice([-1, 1], 200)[:, None]  # the sign of a quaternion says nothing
    switched[:, 6] = np.arange(200) // 2 % 2
    wrapped = arm.copy()
    wrapped[:, 5] = np.pi * rng.choice([-1, 1], 200) + 1e-3 * rng.normal(size=200)
    for values in (
        arm,
        flipped,
        switched,
        wrapped,
        np.zeros((200, 7)),
        rng.normal(size=(200, 7)),
        np.round(0.01 * arm, 2),
    ):
        assert find_turns(values) is None
    other = arm[::-1] + 0.4
    k = np.arange(200)
    for who in (k % 2 > 0, k % 4 > 0, k // 5 % 2 > 0, rng.random(200) < 0.3):
        assert find_turns(np.where(who[:, None], arm, other)) is not None
    assert find_turns(np.where((k % 21 == 7)[:, None], arm, 3 + other)) is not None
    assert find_turns(np.where((np.arange(200) % 2 > 0)[:, None], arm, 9 + other)[:, :1]) is not None


def rough(kind: str) -> np.ndarray:
    """Actions of one robot, as rough from row to row as two robots in turn may seem."""
    rng, k = np.random.default_rng(3), np.arange(61)
    path = np.sin(0.03 * np.cumsum(np.abs(rng.normal(size=61)))[:, None] * (1 + 0.3 * np.arange(7)) + np.arange(7))
    keys = np.eye(7)[rng.integers(0, 7, 61)] * rng.choice([-1, 1], (61, 1))
    tremor = 0.05 * path + 0.02 * np.sin(np.pi / 2 * k)[:, None]
    held = np.where(
        (k // 5 % 2 > 0)[:, None], path[0], -path[9] + 0.01 * np.repeat(rng.normal(size=(13, 7)), 5, 0)[:61]
    )
    gripper = np.column_stack([path[:, :6], (rng.random(61) < 0.5) + 0.01 * rng.normal(size=61)])
    noise = rng.normal(size=(61, 7)) * (rng.random((61, 1)) < 0.3)
    steps = np.diff(path, axis=0, append=0)
    made = {"differences": steps, "keys": keys, "tremor": tremor, "held": held, "gripper": gripper, "bursts": noise}
    return made[kind][:60]


@pytest.mark.parametrize("kind", ["differences", "keys", "tremor", "held", "gripper", "bursts"])
def test_rough_actions_of_one_robot_are_its_own(kind: str) -> None:
    assert find_turns(rough(kind)) is None


def test_actions_that_leap_are_asked_about(tmp_path: Path, capsys: Capture) -> None:
    folder = write_folder(tmp_path / "r", steps=30, action="a.npy")
    np.save(folder / "a.npy", rough("differences")[:30])
    code, _, checks = looked_at(capsys, folder)
    assert (code, checks["action numbers"][0]) == (0, "ok")
    arm = np.sin(0.1 * np.arange(30)[:, None] + np.arange(7))
    np.save(folder / "a.npy", arm + 3.0 * (np.arange(30) // 3 % 2)[:, None])
    code, facts, _ = looked_at(capsys, folder)
    assert code == 3
    assert "write 'one_robot: true'" in facts["problem"]
    write_yaml(folder / "recording.yaml", **yaml.safe_load((folder / "recording.yaml").read_text()), one_robot=True)
    code, _, checks = looked_at(capsys, folder)
    assert (code, checks["action numbers"][0]) == (0, "assumed")


def test_who_sent_is_told_by_frame_name_or_node() -> None:
    arms = [Who("base", "", f"/driver_{k % 2}") for k in range(6)]
    assert tell_apart(arms) == ([f"/driver_{k % 2}" for k in range(6)], "connection")
    assert tell_apart([Who("base", "", "/a")] * 3 + [Who("base", "", "/b")] * 3) is None  # started anew
    assert tell_apart([Who("", f"arm{k % 2}", "/a") for k in range(6)])[1] == "their names"  # type: ignore[index]
    assert tell_apart([Who(f"frame{k}", "", "/a") for k in range(20)]) is None


# --- what the user chooses, and what cannot be read ---------------------------------------------------------


@pytest.mark.parametrize(
    ("keys", "names", "says"),
    [
        ({"state_columns": ["j4", "j0"]}, ["j4", "j0"], ""),
        ({"state_columns": ["j4", "elbow"]}, None, r"names 'elbow', and the state has 'j0', 'j1'"),
        ({"state_columns": ["j4", "j4"]}, None, "names a column twice"),
        ({"action_columns": ["j4"]}, None, "'action_columns' is said, but there is no action"),
        ({"state_times": "t.txt"}, None, "'state_times' is said, but no file"),
    ],
)
def test_joints_are_chosen_by_name(
    tmp_path: Path, capsys: Capture, keys: dict[str, Any], names: list[str] | None, says: str
) -> None:
    bag = write_bag(tmp_path / "r.bag", 1, say_robot_and_camera)
    write_yaml(tmp_path / "r.yaml", **keys)
    code, facts, _ = looked_at(capsys, bag)
    assert code == (3 if says else 0), facts["problem"]
    assert re.search(says, str(facts["problem"])), facts["problem"]
    assert names is None or facts["state_names"] == names


def test_columns_cannot_be_chosen_where_none_has_a_name(tmp_path: Path, capsys: Capture) -> None:
    np.savez(tmp_path / "r.npz", img=colors(), depth=counts(), state=X[:STEPS])
    write_yaml(tmp_path / "r.yaml", fps=10, depth_unit_m=0.001, intrinsics=INTRINSICS, state_columns=["x"])
    code, facts, _ = looked_at(capsys, tmp_path / "r.npz")
    assert (code, "have no names here" in facts["problem"]) == (3, True)


@pytest.mark.parametrize("topic", [None, "/odd"])
@pytest.mark.parametrize(
    ("path", "version", "good", "bad", "why"),
    [
        ("r.bag", 1, b"float32 g\n", b"float32 ?\n", "its definition cannot be read"),
        ("r.mcap", 2, b"float32 g\n", b"float32 ?\n", "its definition cannot be read"),
        ("r.mcap", 2, b"ColorRGBA\7\0\0\0ros2msg", b"ColorRGBA\7\0\0\0jschema", "its messages are of an unknown type"),
    ],
)
def test_a_topic_that_cannot_be_read_costs_no_other(
    tmp_path: Path, capsys: Capture, path: str, version: int, good: bytes, bad: bytes, why: str,
    topic: str | None,
) -> None:  # fmt: skip
    def say_all(m: Messages, say: Say) -> None:
        say_robot_and_camera(m, say)
        for t in range(STEPS):
            say(
                "/odd",
                "std_msgs/msg/ColorRGBA",
                instant(t),
                m.make("std_msgs/msg/ColorRGBA", r=0.0, g=0.0, b=0.0, a=1.0),
            )

    bag = write_bag(tmp_path / path, version, say_all)
    file = next(bag.glob("*.mcap")) if bag.is_dir() else bag
    content = file.read_bytes()
    assert good in content
    file.write_bytes(content.replace(good, bad))
    write_yaml(bag / "recording.yaml" if bag.is_dir() else bag.with_suffix(".yaml"), topics={"state": topic})
    code, facts, found = looked_at(capsys, bag)
    if topic is None:
        assert (code, facts["state_width"]) == (0, 7), facts["problem"]
        assert found["unread topics"][0] == "ok"
        assert f"/odd ({ODD}: {why}" in found["unread topics"][1]
    else:
        assert (code, "/odd cannot be read" in facts["problem"]) == (3, True)
