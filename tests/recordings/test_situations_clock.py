"""Situations of real users whose times were misread, through the command line; beside each a control."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dry_runs import dry_run
from real_recordings import INTRINSICS, write_png, write_yaml
from test_ros_reader import ALIGNED, COLOR, START_NS, Messages, Say, write_bag

STEPS, FPS = 20, 10
EPOCH = 1_700_000_000
Inspect = Callable[..., tuple[int, dict[str, Any]]]


def picture(t: int) -> tuple[np.ndarray, np.ndarray]:
    """Color and depth of an instant: a bright block slides over noise."""
    rng = np.random.default_rng(t)
    rgb = rng.integers(90, 110, (24, 32, 3)).astype(np.uint8)
    depth = rng.integers(895, 905, (24, 32)).astype(np.uint16)
    rgb[8:16, t % 20 : t % 20 + 8] = 220
    depth[8:16, t % 20 : t % 20 + 8] = 700
    return rgb, depth


def write(folder: Path, color: dict[str, int], depth: dict[str, int], **keys: Any) -> Path:
    """A folder whose pictures of each name show an instant."""
    for name, t in color.items():
        write_png(folder / "color" / f"{name}.png", picture(t)[0])
    for name, t in depth.items():
        write_png(folder / "depth" / f"{name}.png", picture(t)[1])
    write_yaml(folder / "recording.yaml", **{"depth_unit_m": 0.001, "intrinsics": INTRINSICS, **keys})
    return folder


named = lambda pattern, frames: {pattern(t): t for t in frames}  # noqa: E731


@pytest.fixture
def inspect(capsys: pytest.CaptureFixture[str]) -> Inspect:
    """What a dry run says: its exit code, and what it found."""

    def look(path: Path, *more: str) -> tuple[int, dict[str, Any]]:
        run = dry_run(capsys, path, *more)
        return run.code, run.facts

    return look


def assert_fine(found: tuple[int, dict[str, Any]], doubtful: bool = False) -> dict[str, Any]:
    code, facts = found
    assert (code, facts["problem"]) == (0, None)
    assert doubtful or {c["verdict"] for c in facts["checks"]} <= {"ok", "assumed"}, facts["checks"]
    return facts


def assert_refused(found: tuple[int, dict[str, Any]], *words: str) -> None:
    code, facts = found
    assert code == 3
    for word in words:
        assert word in facts["problem"]


# --- names of pictures ------------------------------------------------------------------------------------

MS: Callable[[int], str] = lambda t: f"{EPOCH * 1000 + 100 * t + (t * 7) % 5}"  # noqa: E731
SECONDS: Callable[[int], str] = lambda t: f"{EPOCH + 0.1 * t:.6f}"  # noqa: E731
NS: Callable[[int], str] = lambda t: f"rgb_{EPOCH}{100_000_000 * (t % 10) + 7:09d}"  # noqa: E731
NUMBER: Callable[[int], str] = lambda t: f"{t:06d}"  # noqa: E731


@pytest.mark.parametrize(
    "pattern", [MS, SECONDS, lambda t: f"frame{t:04d}-{MS(t)}", lambda t: SECONDS(t).replace(".", "_")]
)
def test_names_that_are_times_are_read_as_such(tmp_path: Path, inspect: Inspect, pattern: Callable[[int], str]) -> None:
    """Row 11: each stream has lost another frame, and nothing is paired by order."""
    color, depth = ([t for t in range(STEPS) if t != lost] for lost in (5, 12))
    path = write(tmp_path / "r", named(pattern, color), named(pattern, depth))
    facts = assert_fine(inspect(path, "--set", "recording.max_bad_share=0.2"))
    assert facts["rows"] == STEPS - 2
    assert facts["streams"][0]["fps"] == pytest.approx(10, rel=0.05)
    assert facts["sync_ms"]["depth"][1] == pytest.approx(100, abs=5)
    assert [name for name, _ in facts["bad_frames"]] == [f"color/{pattern(12)}.png"]


@pytest.mark.parametrize("pattern", [MS, SECONDS])
def test_names_that_are_times_and_a_rate_that_contradicts(
    tmp_path: Path, inspect: Inspect, pattern: Callable[[int], str]
) -> None:
    streams = [named(pattern, range(STEPS))] * 2
    assert_refused(inspect(write(tmp_path / "no", *streams, fps=30)), "'fps: 30' contradicts them")
    assert_fine(inspect(write(tmp_path / "yes", *streams, fps=10)))


@pytest.mark.parametrize("keep", [2, 3])
def test_every_second_or_third_frame_kept(tmp_path: Path, inspect: Inspect, keep: int) -> None:
    """Row 12: the numbers are kept, and so is the time between them."""
    frames = range(0, keep * STEPS, keep)
    facts = assert_fine(inspect(write(tmp_path / "r", named(NUMBER, frames), named(NUMBER, frames), fps=30)))
    assert facts["streams"][0]["fps"] == pytest.approx(30 / keep, rel=1e-3)


def test_a_hole_of_more_than_half_stays_a_gap(tmp_path: Path, inspect: Inspect) -> None:
    """Row 12: 26 frames are missing, of color only in part."""
    color = [*range(10), *range(36, 46)]
    depth = [*range(12), *range(36, 46)]
    code, facts = inspect(write(tmp_path / "r", named(NUMBER, color), named(NUMBER, depth), fps=FPS))
    assert (code, facts["rows"], facts["bad_frames"]) == (0, 20, [])
    assert facts["streams"][0]["gaps_s"] == [[pytest.approx(0.9), pytest.approx(2.7)]]
    assert facts["sync_ms"]["depth"] == [0, 0]


@pytest.mark.parametrize(
    ("color", "depth"),
    [
        (range(1, 21), range(20)),  # row 21
        (range(20), range(1, 21)),
        (range(1, 21), range(1, 19)),  # row 20: depth is counted anew, two late
        (range(1, 19), range(1, 21)),
        (range(100, 120), range(102, 122)),
        (range(0, 40, 2), range(1, 41, 2)),
        (range(1, 21), range(1001, 1021)),
    ],
)
def test_streams_counted_from_different_origins_are_asked_about(
    tmp_path: Path, inspect: Inspect, color: range, depth: range
) -> None:
    one, other = ({NUMBER(n): k for k, n in enumerate(numbers)} for numbers in (color, depth))
    assert_refused(inspect(write(tmp_path / "r", one, other, fps=FPS)), "numbers:", "'depth_offset_s: 0'")
    if color[0] == 1 and depth[0] == 0:
        facts = assert_fine(inspect(write(tmp_path / "r", one, other, fps=FPS, depth_offset_s=0.1)))
        assert (facts["rows"], facts["sync_ms"]["depth"]) == (20, [0, 0])


def test_holes_and_ends_of_one_counter_pass(tmp_path: Path, inspect: Inspect) -> None:
    color, depth = [t for t in range(40) if t != 7], [t for t in range(2, 40) if t != 20]
    facts = assert_fine(inspect(write(tmp_path / "r", named(NUMBER, color), named(NUMBER, depth), fps=FPS)))
    assert facts["rows"] == 36
    assert len(facts["bad_frames"]) == 3


@pytest.mark.parametrize("names", [("a", "b", "c"), ("1_5", "2_3", "7_9"), ("1.5", "2.123456789", "3.1")])
def test_names_that_tell_no_time_are_asked_about(tmp_path: Path, inspect: Inspect, names: tuple[str, ...]) -> None:
    streams = [{name: k for k, name in enumerate(names)}] * 2
    assert_refused(inspect(write(tmp_path / "r", *streams, fps=FPS)), "times: times.txt")


def test_numbers_that_may_be_frames_or_times_are_asked_about(tmp_path: Path, inspect: Inspect) -> None:
    frames = [33 * t for t in range(STEPS)]
    streams = [{NUMBER(n): t for t, n in enumerate(frames)}] * 2
    assert_refused(inspect(write(tmp_path / "r", *streams)), "'fps: 30'", "'time_unit: ms'")
    assert_refused(inspect(write(tmp_path / "r", *streams, fps=10)), "where fps is 10")
    for keys in ({"time_unit": "ms"}, {"fps": 30}):
        facts = assert_fine(inspect(write(tmp_path / "r", *streams, **keys)))
        assert facts["streams"][0]["fps"] == pytest.approx(30.3, abs=0.1)


# --- RH20T's layout ---------------------------------------------------------------------------------------


def test_frame_numbers_in_the_layout_of_rh20t(tmp_path: Path, inspect: Inspect) -> None:
    """Row 9: with ``fps``, and without; real names in milliseconds pass."""
    color, depth = ([t for t in range(STEPS) if t != lost] for lost in (5, 12))
    for pattern, keys in ((NUMBER, {"fps": 10}), (NUMBER, {}), (MS, {}), (MS, {"fps": 25})):
        episode = tmp_path / f"ep{len(list(tmp_path.iterdir()))}"
        write(episode / "cam_0", named(pattern, color), named(pattern, depth))
        (episode / "cam_0" / "recording.yaml").unlink()
        write_yaml(episode / "recording.yaml", intrinsics=INTRINSICS, **keys)
        found = inspect(episode, "--set", "recording.max_bad_share=0.2")
        if (pattern is NUMBER) == bool(keys):
            facts = assert_fine(found)
            assert facts["rows"] == STEPS - 2
            assert facts["streams"][0]["fps"] == pytest.approx(10, rel=0.05)
        else:
            assert_refused(found, "fps")


# --- lists and files of times -----------------------------------------------------------------------------


def write_lists(folder: Path, stamps: Sequence[str], **keys: Any) -> Path:
    for name, which in (("rgb", 0), ("depth", 1)):
        for t in range(len(stamps)):
            write_png(folder / name / f"{t}.png", picture(t)[which])
        (folder / f"{name}.txt").write_text("".join(f"{s} {name}/{t}.png\n" for t, s in enumerate(stamps)))
    write_yaml(folder / "recording.yaml", intrinsics=INTRINSICS, depth_unit_m=0.001, **keys)
    return folder


@pytest.mark.parametrize(
    ("stamp", "keys"),
    [
        (lambda t: f"{EPOCH + t / 10:.4f}", {}),
        (lambda t: str(EPOCH * 10**3 + 100 * t), {}),
        (lambda t: str(EPOCH * 10**6 + 100_000 * t), {}),
        (lambda t: str(EPOCH * 10**9 + 100_000_000 * t), {}),
        (lambda t: str(100 * t), {}),
        (lambda t: str(100 * t), {"fps": 10}),
        (lambda t: f"{t / 10}", {"fps": 10}),
        (str, {"fps": 10}),
        (lambda t: str(1000 + 2 * t), {"fps": 20}),
        (lambda t: str(5 * t), {"time_unit": "ms"}),
    ],
)
def test_lists_in_any_unit(tmp_path: Path, inspect: Inspect, stamp: Callable[[int], str], keys: dict[str, Any]) -> None:
    """Row 10."""
    facts = assert_fine(inspect(write_lists(tmp_path / "r", [stamp(t) for t in range(STEPS)], **keys)))
    assert facts["rows"] == STEPS
    rate = 200 if keys.get("time_unit") else 10
    assert facts["streams"][0]["fps"] == pytest.approx(rate, rel=1e-3)


@pytest.mark.parametrize(
    ("stamp", "keys", "words"),
    [
        (str, {}, ("may be numbers of frames or s (1 pictures a second)", "'fps: 30'")),
        (lambda t: f"{5 * t}.0", {}, ("may be s (0.2 pictures a second) or ms (200",)),
        (lambda t: f"{EPOCH + t / 10:.4f}", {"fps": 30}, ("'fps: 30' contradicts",)),
        (lambda t: str(50 * t), {"time_unit": "s"}, ("step by 50 s", "'time_unit: ms'")),
        (lambda t: f"{100 * t}e9", {}, ("no plausible time",)),
        (lambda t: f"{EPOCH + t / 10 - 0.55 * (t > 9):.4f}", {}, ("step back by 0.45", "entry 11")),
        (lambda t: f"{EPOCH + (19 - t) / 10:.4f}", {}, ("step back by 0.1", "entry 2 ")),
    ],
)
def test_lists_that_are_not_clear_are_refused(
    tmp_path: Path, inspect: Inspect, stamp: Callable[[int], str], keys: dict[str, Any], words: tuple[str, ...]
) -> None:
    """Rows 7 and 10."""
    assert_refused(inspect(write_lists(tmp_path / "r", [stamp(t) for t in range(STEPS)], **keys)), *words)


@pytest.mark.parametrize(("scale", "digits"), [(1, 4), (1e3, 0), (1e6, 0), (1e9, 0)])
def test_state_in_another_unit_lies_where_the_pictures_do(
    tmp_path: Path, inspect: Inspect, scale: float, digits: int
) -> None:
    streams = [named(NUMBER, range(STEPS))] * 2
    path = write(tmp_path / "r", *streams, fps=FPS, state="s.csv")
    rows = "".join(f"{t / 50 * scale:.{digits}f},{t}\n" for t in range(5 * STEPS))
    (path / "s.csv").write_text("time,x\n" + rows)
    assert assert_fine(inspect(path))["sync_ms"]["state"][1] == pytest.approx(0, abs=1)
    (path / "s.csv").write_text("time,x\n" + "".join(f"{EPOCH + t / 50},{t}\n" for t in range(5 * STEPS)))
    assert_refused(inspect(path), "their clocks differ; write 'state_offset_s: ...'")
    write(path, {}, {}, fps=FPS, state="s.csv", state_offset_s=-EPOCH)
    assert_fine(inspect(path))


# --- messages ---------------------------------------------------------------------------------------------


def write_messages(
    path: Path, *, behind_s: float = 0.0, back_at: int | None = None, drift: float = 0.0, **keys: Any
) -> Path:
    """A camera and a robot, whose clock may be behind; the camera's may be set back by 0.55 s, or run away."""

    def say_all(m: Messages, say: Say) -> None:
        for t in range(STEPS):
            now = START_NS + t * 100_000_000
            stamp = now - 550_000_000 * (back_at is not None and t >= back_at)
            rgb, depth = picture(t)
            say(COLOR, "sensor_msgs/msg/Image", now + 20_000_000, m.image(rgb, "rgb8", stamp))
            say(ALIGNED, "sensor_msgs/msg/Image", now + 22_000_000, m.image(depth, "16UC1", stamp))
            say("/camera/color/camera_info", "sensor_msgs/msg/CameraInfo", now, m.info(INTRINSICS, stamp))
            for k in range(5):
                at = now + k * 20_000_000
                joints = m.joints(np.full(3, float(t)), at - round((behind_s + drift * (t + k / 5) / STEPS) * 1e9))
                say("/joint_states", "sensor_msgs/msg/JointState", at, joints)

    write_yaml(path.with_suffix(".yaml"), **keys)
    return write_bag(path, 1, say_all)


def test_one_clock_passes(tmp_path: Path, inspect: Inspect) -> None:
    assert_fine(inspect(write_messages(tmp_path / "r.bag")))
    assert_fine(inspect(write_messages(tmp_path / "fps.bag", fps=10)))
    assert_refused(inspect(write_messages(tmp_path / "no.bag", fps=30)), "'fps: 30' contradicts")


@pytest.mark.parametrize("behind_s", [2.0, -1.5, 0.3])
def test_a_robots_clock_that_is_behind(tmp_path: Path, inspect: Inspect, behind_s: float) -> None:
    """Row 6, and the two ways to say it."""
    write_to = f"'state_offset_s: {behind_s - 0.02:.3g}'"
    assert_refused(
        inspect(write_messages(tmp_path / "r.bag", behind_s=behind_s)), "record times", "clock: recorded", write_to
    )
    for k, keys in enumerate(({"clock": "recorded"}, {"state_offset_s": behind_s})):
        facts = assert_fine(inspect(write_messages(tmp_path / f"{k}.bag", behind_s=behind_s, **keys)))
        assert facts["rows"] >= STEPS - 1
        assert facts["sync_ms"]["state"][0] < 15


def test_a_clock_that_runs_away_or_is_set_back(tmp_path: Path, inspect: Inspect) -> None:
    """Row 7, in messages."""
    assert_refused(inspect(write_messages(tmp_path / "d.bag", drift=0.5)), "drift or jump", "clock: recorded")
    assert_refused(inspect(write_messages(tmp_path / "b.bag", back_at=10)), "step back by 0.45", "entry 11")
    facts = assert_fine(inspect(write_messages(tmp_path / "c.bag", back_at=10, clock="recorded")))
    assert facts["rows"] == STEPS


# --- what pictures hold -----------------------------------------------------------------------------------


@pytest.mark.parametrize("far", [65535, 9000])
def test_depth_at_its_limit_is_no_reading(tmp_path: Path, inspect: Inspect, far: int) -> None:
    """Row 26: 65535, or the far plane of a renderer, in a part of every picture."""
    path = write(tmp_path / "r", named(NUMBER, range(STEPS)), named(NUMBER, range(STEPS)), fps=FPS)
    for t in range(STEPS):
        depth = picture(t)[1]
        depth[:6] = far
        write_png(path / "depth" / f"{t:06d}.png", depth)
    facts = assert_fine(inspect(path))
    (says,) = (c["says"] for c in facts["checks"] if c["about"] == "saturated depth")
    assert says.startswith(f"{far} counts are taken as no reading: the greatest, in 25.0%")


def test_a_wall_behind_a_box_is_a_reading(tmp_path: Path, inspect: Inspect) -> None:
    path = write(tmp_path / "r", named(NUMBER, range(STEPS)), named(NUMBER, range(STEPS)), fps=FPS)
    for t in range(STEPS):
        write_png(path / "depth" / f"{t:06d}.png", np.where(picture(t)[1] > 800, 900, 600).astype(np.uint16))
    checks = assert_fine(inspect(path))["checks"]
    assert [c["verdict"] for c in checks if c["about"] == "saturated depth"] == ["ok"]


def shaken(late: int, frames: int = 80) -> list[int]:
    """Which picture is shown when: a block that moves in fits and starts."""
    rng = np.random.default_rng(3)
    steps = rng.choice([0, 1, 2, 3], frames + late, p=[0.4, 0.2, 0.2, 0.2])
    return [int(k) for k in np.cumsum(steps)[late:]]


@pytest.mark.parametrize("late", [0, 3])
def test_motion_tells_an_offset_that_numbers_do_not(tmp_path: Path, inspect: Inspect, late: int) -> None:
    """Both are counted from 0 without a hole, and depth begins three frames later."""
    moves = [np.array([(10 * k) % 25 for k in shaken(n)]) for n in (0, late)]
    for which, folder in ((0, "color"), (1, "depth")):
        for t, k in enumerate(moves[which]):
            shown = np.full((24, 32), 900, np.uint16) if which else np.full((24, 32, 3), 90, np.uint8)
            shown[8:16, k : k + 7] = 600 if which else 230
            shown[0, 0] = 800 + t % 90 if which else t % 90
            write_png(tmp_path / "r" / folder / f"{t:04d}.png", shown)
    keys = {"fps": 30, "depth_unit_m": 0.001, "intrinsics": INTRINSICS}
    write_yaml(tmp_path / "r" / "recording.yaml", **keys)
    if not late:
        assert_fine(inspect(tmp_path / "r"))
        return
    assert_refused(inspect(tmp_path / "r"), "motion of depth: 0.10 s before that of color", "'depth_offset_s: 0.1'")
    write_yaml(tmp_path / "r" / "recording.yaml", **keys, depth_offset_s=0.1)
    assert_fine(inspect(tmp_path / "r"))
