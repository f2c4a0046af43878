"""Ticks, slow rates, every n-th frame, and dates in names, through the command line; beside each a control."""

from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from real_recordings import INTRINSICS, write_yaml
from test_situations_clock import Inspect, assert_fine, assert_refused, inspect, named, picture, write, write_lists

__all__ = ["inspect"]
STEPS = 20
Name = Callable[[int], str]


def check(tmp_path: Path, inspect: Inspect, name: Name, rate: float | None, *words: str, **keys: Any) -> None:
    """Names are read at a rate without a gap, or refused with these words."""
    streams = [named(name, range(STEPS))] * 2
    found = inspect(write(tmp_path / "r", *streams, **keys))
    if rate is None:
        assert_refused(found, *words)
    else:
        facts = assert_fine(found)
        assert facts["rows"] == STEPS
        assert facts["streams"][0]["fps"] == pytest.approx(rate, rel=0.02)
        assert facts["streams"][0]["gaps_s"] == []


# --- ticks and slow rates -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "stamp",
    [
        lambda t: 3000 * t,  # 90 kHz, 30 a second
        lambda t: 6006 * t,  # 90 kHz, 14.99 a second
        lambda t: 5_000_000 + 1500 * t,  # 90 kHz, 60 a second
        lambda t: 1600 * t,  # 48 kHz
        lambda t: 512 * t,  # of a video, 1/12800 s
        lambda t: 333_333 * t,  # 100 ns
        lambda t: 166_667 * t,
        lambda t: 133_500_000_000_000_000 + 333_334 * t,  # FILETIME
        lambda t: 638_355_168_000_000_000 + 333_334 * t,  # .NET
        lambda t: 1_200_000_000 + 3000 * t,  # 90 kHz for 4 hours
        lambda t: 2000 * t,
    ],
)
@pytest.mark.parametrize("lists", [True, False])
def test_ticks_are_asked_about(tmp_path: Path, inspect: Inspect, stamp: Callable[[int], int], lists: bool) -> None:
    name = lambda t: str(stamp(t))  # noqa: E731
    if lists:
        assert_refused(inspect(write_lists(tmp_path / "r", [name(t) for t in range(STEPS)])), "clock:", "'times'")
    else:
        check(tmp_path, inspect, name, None, "clock:", "times")


def test_slow_pictures_in_a_layout_that_says_milliseconds(tmp_path: Path, inspect: Inspect) -> None:
    episode = tmp_path / "ep"
    for step, fine in ((3000, False), (100, True)):
        write(episode / "cam_0", *[named(lambda t, s=step: f"{s * t:06d}", range(STEPS))] * 2)  # type: ignore[misc]
        (episode / "cam_0" / "recording.yaml").unlink()
        write_yaml(episode / "recording.yaml", intrinsics=INTRINSICS)
        if fine:
            break
        assert_refused(inspect(episode), "may be ms (0.333 pictures a second)")
        for file in (episode / "cam_0").rglob("*.png"):
            file.unlink()
    assert_fine(inspect(episode))


@pytest.mark.parametrize(
    ("stamps", "keys", "fps"),
    [
        (lambda t: 2.0 * t, {"time_unit": "s"}, 0.5),
        (lambda t: 1000 * t, {"fps": 1}, 1),
        (lambda t: 500 * t, {"time_unit": "ms"}, 2),
        (lambda t: f"{t / 5:.3f}", {}, 5),
        (lambda t: 200 * t, {}, 5),
        (lambda t: round(t * 1000 / 15), {}, 15),
        (lambda t: round(t * 1e6 / 15), {}, 15),
        (lambda t: round(t * 1e9 / 60) + 30 * 10**12, {}, 60),
        (lambda t: 1_700_000_000 + 2 * t, {}, 0.5),  # since 1970: no doubt
    ],
)
def test_rates_that_are_clear(
    tmp_path: Path, inspect: Inspect, stamps: Callable[[int], Any], keys: dict[str, Any], fps: float
) -> None:
    facts = assert_fine(inspect(write_lists(tmp_path / "r", [str(stamps(t)) for t in range(STEPS)], **keys)))
    assert facts["streams"][0]["fps"] == pytest.approx(fps, rel=0.02)


@pytest.mark.parametrize("keep", [12, 15, 30, 32, 60])
def test_every_nth_frame_is_asked_about(tmp_path: Path, inspect: Inspect, keep: int) -> None:
    """Row 12: n times the number may also be a time; 'time_unit: frames' says that it is not."""
    name = lambda t: f"{keep * t:06d}"  # noqa: E731
    check(tmp_path, inspect, name, None, f"every {keep}th was kept", "'time_unit: frames'", fps=30)
    check(tmp_path, inspect, name, 30 / keep, fps=30, time_unit="frames")


@pytest.mark.parametrize("rate", [30, 24, 15, 60])
def test_hundredths_of_a_second_are_no_frames(tmp_path: Path, inspect: Inspect, rate: int) -> None:
    name = lambda t: f"{1000 + round(100 * t / rate):06d}"  # noqa: E731
    check(tmp_path, inspect, name, None, "times in ticks, as steps from", "'time_unit: frames'", fps=rate)


def test_frames_of_which_some_were_kept_are_said_to_be(tmp_path: Path, inspect: Inspect) -> None:
    for keep, verdict in ((4, "assumed"), (2, "assumed"), (1, "ok")):
        streams = [named(lambda t, k=keep: f"{k * t:06d}", [0, 1, *range(3, STEPS)])] * 2  # type: ignore[misc]
        facts = assert_fine(inspect(write(tmp_path / f"{keep}", *streams, fps=30)))
        (found,) = [c for c in facts["checks"] if c["about"] == "clock"]
        assert (found["verdict"], f"every {keep}th was kept" in found["says"]) == (verdict, keep > 1)


def test_digits_of_a_date_get_no_unit_by_their_step(tmp_path: Path, inspect: Inspect) -> None:
    """Year, day of the year and time of day; a unit would make a false gap at each minute."""
    name = lambda t: f"2023318{221358000 + 100 * t}"  # noqa: E731
    check(tmp_path, inspect, name, None, "digits of a date", "give 'times'")


def test_frames_need_a_rate_and_numbers(tmp_path: Path, inspect: Inspect) -> None:
    check(tmp_path, inspect, lambda t: f"{12 * t:04d}", None, "'fps' is not", time_unit="frames")
    check(tmp_path, inspect, lambda t: f"{t / 10:.3f}", None, "no whole numbers", time_unit="frames", fps=10)


# --- dates ------------------------------------------------------------------------------------------------

START = datetime(2023, 11, 14, 22, 13, 59, 102_000, UTC)


def dated(pattern: str, digits: int = 3, start: datetime = START, fps: float = 10) -> Name:
    """Names that tell a date and time, over the end of a minute; ``%f`` has so many digits."""

    def name(t: int) -> str:
        now = start + timedelta(milliseconds=round(1000 * t / fps))
        return now.strftime(pattern.replace("%f", now.strftime("%f")[:digits]))

    return name


DATES = ["%Y%m%d%H%M%S%f", "%Y%m%d_%H%M%S_%f", "%Y-%m-%dT%H-%M-%S.%fZ", "%Y-%m-%d %H.%M.%S,%f", "rgb_%Y%m%d-%H%M%S%f_0",
         "cam1_%Y_%m_%d_%H_%M_%S_%f", "%H%M%S.%f", "%H-%M-%S-%f", "%H%M%S%f", "a2_%Hh%Mm%S.%f"]  # fmt: skip


@pytest.mark.parametrize("pattern", DATES)
@pytest.mark.parametrize("keys", [{}, {"fps": 10}])
def test_dates_in_names_are_read_as_dates(tmp_path: Path, inspect: Inspect, pattern: str, keys: dict[str, Any]) -> None:
    """Row 11: a minute has 60 seconds, so none is missing after the 59th."""
    check(tmp_path, inspect, dated(pattern), 10, **keys)


@pytest.mark.parametrize(
    ("name", "keys", "fps"),
    [
        (dated("%Y%m%d%H%M%S%f", 6), {}, 10),
        (dated("%Y%m%d_%H%M%S", fps=1), {}, 1),
        (dated("%Y-%m-%d_%H-%M-%S", fps=1), {"fps": 1}, 1),
        (dated("%H%M%S.%f", start=START.replace(hour=23, minute=59)), {}, 10),  # over midnight
        (dated("%Y%m%d%H%M%S%f", start=START.replace(month=12, day=31, hour=23, minute=59)), {}, 10),
        (lambda t: f"20231114_221359_{t:04d}", {"fps": 10}, 10),  # the frames of a recording that began then
        (lambda t: f"2023-11-14_{t:06d}", {"fps": 10}, 10),
        (lambda t: f"{t:04d}_" + dated("%Y%m%d_%H%M%S_%f")(t), {}, 10),
        (lambda t: f"{59.05 + t / 10:09.3f}", {"time_unit": "s"}, 10),  # seconds that go on to 60
        (lambda t: f"{98.05 + t / 10:09.3f}", {}, 10),
    ],
)
def test_dates_and_what_looks_like_them(
    tmp_path: Path, inspect: Inspect, name: Name, keys: dict[str, Any], fps: float
) -> None:
    check(tmp_path, inspect, name, fps, **keys)


@pytest.mark.parametrize(
    ("name", "word"),
    [
        (dated("%Y%m%d_%H%M%S_%f", 2), "may be a part of a second or not"),
        (lambda t: dated("%Y%m%d_%H%M%S_%f")(t) + f"_{t}", "another number that changes"),
        (dated("%Y%m%d_%H%M%S.%f_pm"), "half a day"),
        (lambda t: f"20230230_2213{50 + t:02d}_000" if t < 10 else f"20230230_2214{t - 10:02d}_000", "is no date"),
    ],
)
def test_dates_that_are_not_clear_are_asked_about(tmp_path: Path, inspect: Inspect, name: Name, word: str) -> None:
    check(tmp_path, inspect, name, None, word)


@pytest.mark.parametrize("pattern", ["%Y%m%d%H%M%S.%f", "%Y%m%d%H%M%S%f", "%H%M%S.%f"])
def test_dates_in_lists_and_tables_are_no_numbers(tmp_path: Path, inspect: Inspect, pattern: str) -> None:
    texts = [dated(pattern)(t) for t in range(STEPS)]
    word = "times of day" if "Y" not in pattern else "dates"
    assert_refused(inspect(write_lists(tmp_path / "r", texts)), word, "no count of time")
    path = write(tmp_path / "t", *[named("{:04d}".format, range(STEPS))] * 2, times="times.txt")
    (path / "times.txt").write_text("\n".join(texts))
    assert_refused(inspect(path), word, "no count of time")
    (path / "times.txt").write_text("\n".join(str(s) for s in np.arange(STEPS) / 10 + 59.1))
    assert_fine(inspect(path))


# --- times that lie beside --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("file", "step", "key"),
    [
        ("timestamps.txt", 0.2, "times: timestamps.txt"),
        ("times.txt", 200.0, "times: times.txt"),
        ("color_ts.npy", 0.2, "times: color_ts.npy"),
        ("depth_timestamps.txt", 0.2, "depth_times: depth_timestamps.txt"),
        ("timestamps.csv", 0.2, "times: timestamps.csv"),
        ("timestamps.csv", 0.1, None),
        ("timestamps.txt", 0.1, None),
        ("times.npy", 100.0, None),
        ("time_of_flight_notes.txt", None, None),
    ],
)
def test_times_beside_the_pictures_are_compared(
    tmp_path: Path, inspect: Inspect, file: str, step: float | None, key: str | None
) -> None:
    """Times that nothing names, where 'fps' tells others."""
    path = write(tmp_path / "r", *[named("{:04d}".format, range(STEPS))] * 2, fps=10)
    values = 1.7e9 + np.arange(STEPS) * (step or 0) if (step or 0) < 1 else np.arange(STEPS) * (step or 0)
    text = "\n".join(map(str, values)) if step else "words"
    if file.endswith(".npy"):
        np.save(path / file, values)
    else:
        (path / file).write_text("timestamp\n" + text if file.endswith(".csv") else text)
    facts = assert_fine(inspect(path), doubtful=True)
    doubts = [c["says"] for c in facts["checks"] if c["verdict"] == "doubtful"]
    assert [key in d for d in doubts] == [True] if key else doubts == []


@pytest.mark.parametrize(
    ("name", "late", "lost"),
    [("depth_timestamps", 0.2, 2), ("state_times", 0.3, 3), ("color_timestamps", 0.0, 0), ("depth_ts", 0.01, 0)],
)
@pytest.mark.parametrize("packed", [True, False])
def test_arrays_have_times_of_their_own(
    tmp_path: Path, inspect: Inspect, name: str, late: float, lost: int, packed: bool
) -> None:
    times = np.arange(STEPS) / 10
    color, depth = (np.stack([picture(t)[which] for t in range(STEPS)]) for which in (0, 1))
    arrays = {"img": color, "depth": depth, "timestamp": times, "state": np.random.default_rng(0).random((STEPS, 3))}
    arrays[name] = times + late
    path = tmp_path / "r.npz" if packed else tmp_path / "r"
    if packed:
        np.savez(path, **arrays)  # type: ignore[arg-type]
    else:
        path.mkdir()
        for array, values in arrays.items():
            np.save(path / f"{array}.npy", values)
    beside = path.with_suffix(".yaml") if packed else path / "recording.yaml"
    write_yaml(beside, intrinsics=INTRINSICS, depth_unit_m=0.001)
    _, facts = inspect(path)
    assert len(facts["bad_frames"]) == lost, facts["bad_frames"]
    assert {c["says"] for c in facts["checks"] if c["about"] == "left out"} <= {
        f"every {'array' if packed else 'file'} is used",
        f"timestamp{'' if packed else '.npy'} (says what is used)",
    }
