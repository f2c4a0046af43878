"""Clocks of messages against the times of recording, through the command line; beside each a control."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from real_recordings import INTRINSICS, write_yaml
from test_ros_reader import ALIGNED, COLOR, START_NS, Messages, Say, write_bag
from test_situations_clock import Inspect, assert_fine, assert_refused, inspect, picture

__all__ = ["inspect"]
FRAMES = 30
Clock = Callable[[float], float]
TRUE: Clock = lambda t: t  # noqa: E731


def behind(by_s: float, since_s: float = 0.0) -> Clock:
    """A clock that is behind the true one."""
    return lambda t: t - by_s * (t >= since_s - 1e-9)


def write(
    path: Path,
    *,
    camera: Clock = TRUE,
    depth: Clock | None = None,
    robot: Clock | None = TRUE,
    recorded: Clock = TRUE,
    lost: tuple[int, ...] = (),
    fps: int = 10,
    **keys: Any,
) -> Path:
    """A bag of a camera, and of a robot if it has a clock; ``recorded`` is when a message of an instant arrives."""

    def say_all(m: Messages, say: Say) -> None:
        ns = lambda t: START_NS + round(t * 1e9)  # noqa: E731
        for k in range(FRAMES):
            t = k / fps
            rgb, counts = picture(k)
            if k not in lost:
                say(COLOR, "sensor_msgs/msg/Image", ns(recorded(t) + 0.02), m.image(rgb, "rgb8", ns(camera(t))))
                depth_ns = ns((depth or camera)(t))
                say(ALIGNED, "sensor_msgs/msg/Image", ns(recorded(t) + 0.022), m.image(counts, "16UC1", depth_ns))
            info = m.info(INTRINSICS, ns(camera(t)))
            say("/camera/color/camera_info", "sensor_msgs/msg/CameraInfo", ns(recorded(t)), info)
            for at in () if robot is None else t + np.arange(5) / fps / 5:
                joints = m.joints(np.full(3, at), ns(robot(at)))
                say("/joint_states", "sensor_msgs/msg/JointState", ns(recorded(at)), joints)

    write_yaml(path.with_suffix(".yaml"), **keys)
    return write_bag(path, 1, say_all)


@pytest.mark.parametrize("by_s", [0.15, 0.13, 0.25])
@pytest.mark.parametrize("who", ["camera", "depth"])
def test_a_camera_clock_set_back_does_not_shuffle_pictures(
    tmp_path: Path, inspect: Inspect, by_s: float, who: str
) -> None:
    """Row 7: sorted by their stamps the pictures would interleave; by the times of recording all after it are late."""
    clocks: dict[str, Any] = {who: behind(by_s, since_s=1.5), "robot": None}
    assert_refused(inspect(write(tmp_path / "r.bag", **clocks)), "step back", "entry 16", "clock: recorded")
    facts = assert_fine(inspect(write(tmp_path / "c.bag", clock="recorded", **clocks)))
    assert facts["rows"] == FRAMES


def test_a_robot_clock_set_back_is_refused(tmp_path: Path, inspect: Inspect) -> None:
    found = inspect(write(tmp_path / "r.bag", robot=behind(0.03, since_s=1.5)))
    assert_refused(found, "the stamps of state", "step back")


@pytest.mark.parametrize("robot", [TRUE, None])
@pytest.mark.parametrize(
    ("clock", "way"),
    [
        (behind(-0.5, since_s=1.5), "forward by 500 ms at entry 16"),
        (behind(-3600, since_s=1.5), "forward by 3600 s at entry 16"),
        (behind(-0.3, since_s=2.5), "forward by 300 ms at entry 26"),
        (lambda t: t - 0.4 + behind(-0.4, since_s=0.5)(t) - t, "forward by 400 ms at entry 6"),
    ],
)
def test_a_camera_clock_set_forward_is_named(
    tmp_path: Path, inspect: Inspect, clock: Clock, way: str, robot: Clock | None
) -> None:
    found = inspect(write(tmp_path / "r.bag", camera=clock, robot=robot))
    if "3600" in way and robot is not None:
        assert "the times of recording are taken" in str(assert_fine(found)["checks"])
    else:
        assert_refused(found, f"the clock of color was set {way}")


@pytest.mark.parametrize(
    ("by_s", "until_s", "word"),
    [
        (0.15, 1.3, "step back"),
        (0.25, 1.2, "step back"),
        (-0.3, 1.5, "step back"),
        (0.08, 1.4, "for the entries 11 to 14"),
    ],
)
def test_a_clock_set_for_a_few_messages_is_named(
    tmp_path: Path, inspect: Inspect, by_s: float, until_s: float, word: str
) -> None:
    """Messages that are overtaken are late one by one, these are by the same amount."""
    clock = lambda t: t - by_s * (0.95 < t < until_s - 0.05)  # noqa: E731
    found = inspect(write(tmp_path / "r.bag", camera=clock, robot=None))
    if word == "step back":
        assert_refused(found, word, "clock: recorded")
    else:
        (says,) = (c["says"] for c in found[1]["checks"] if c["about"] == "record times" and c["verdict"] == "doubtful")
        assert word in says


def test_a_small_step_back_of_the_camera_is_doubtful_and_its_own(tmp_path: Path, inspect: Inspect) -> None:
    facts = assert_fine(inspect(write(tmp_path / "r.bag", camera=behind(0.08, since_s=1.5))), doubtful=True)
    (check,) = [c for c in facts["checks"] if c["about"] == "record times"]
    assert check["verdict"] == "doubtful"
    assert "the clock of color was set back by 80 ms" in check["says"]
    assert "of state" not in check["says"]


@pytest.mark.parametrize("by_s", [0.3, -0.3])
def test_depth_whose_clock_differs_is_told_its_own_key(tmp_path: Path, inspect: Inspect, by_s: float) -> None:
    """Row 6: what is written for another stream does not silence it."""
    way = "behind" if by_s > 0 else "ahead of"
    words = (f"the clock of depth is {abs(by_s) * 1000 + np.sign(by_s) * 2:.0f} ms {way}", "'depth_offset_s: ")
    for k, keys in enumerate(({}, {"state_offset_s": -0.019})):
        found = inspect(write(tmp_path / f"{k}.bag", depth=behind(by_s), **keys))
        assert_refused(found, *words)
        assert "write 'state_offset_s" not in found[1]["problem"]
        assert "or 'state_offset_s" not in found[1]["problem"]
    facts = assert_fine(inspect(write(tmp_path / "ok.bag", depth=behind(by_s), depth_offset_s=by_s)))
    assert (facts["rows"], facts["sync_ms"]["depth"][1]) == (FRAMES, 0)


def test_an_offset_that_the_times_of_recording_contradict_is_doubtful(tmp_path: Path, inspect: Inspect) -> None:
    path = write(tmp_path / "r.bag", robot=behind(0.5), state_offset_s=0.2)
    code, facts = inspect(path, "--set", "recording.max_bad_share=0.5")
    (check,) = [c for c in facts["checks"] if c["about"] == "record times"]
    assert (code, check["verdict"]) == (0, "doubtful")
    assert "with 'state_offset_s: 0.2' added" in check["says"]


RNG = np.random.default_rng(4)
ARRIVES = np.maximum.accumulate(np.arange(5000) / 1000 + RNG.exponential(0.03, 5000) * (RNG.random(5000) < 0.05))


@pytest.mark.parametrize(
    "how",
    [
        {},
        {"robot": None},
        {"recorded": lambda t: ARRIVES[round(t * 1000)]},  # a busy network
        {"recorded": lambda t: np.ceil(t / 0.3) * 0.3 + t / 1000},  # it arrives in bursts
        {"recorded": lambda t: t + 0.6 * (t >= 1.5)},  # the recorder's clock was set
        {"recorded": lambda t: 2.0 if 1.4 < t < 2 else t},  # the recorder stalled
        {"lost": (5, 6, 7, 8, 9, 20)},
        {"recorded": lambda t: t + 86400},  # recorded again, the day after
        {"camera": behind(-0.48), "robot": behind(-0.48)},
        {"fps": 15},
        {"camera": lambda t: t + 0.02 * np.sin(40 * t)},  # stamps that jitter
    ],
)
def test_clocks_that_agree_pass(tmp_path: Path, inspect: Inspect, how: dict[str, Any]) -> None:
    assert_fine(inspect(write(tmp_path / "r.bag", **how)))


def test_a_message_that_overtakes_others_is_put_in_order(tmp_path: Path, inspect: Inspect) -> None:
    late = {1.0: 0.15, 2.0: 0.15, 2.9: 0.05}
    path = write(tmp_path / "r.bag", recorded=lambda t: t + late.get(round(t, 6), 0.0), robot=None)
    facts = assert_fine(inspect(path))
    assert (facts["rows"], facts["streams"][0]["gaps_s"]) == (FRAMES, [])
