"""Files of numbers."""

from pathlib import Path

import numpy as np
import pytest

from flowlab.errors import DataError
from flowlab.recordings.base import ImageStream
from flowlab.recordings.sample_files import load_samples, load_times

CLOCK = np.array([0.0, 0.1, 0.2])
COLOR = ImageStream(("a", "b", "c"), CLOCK, lambda k: np.zeros((2, 2, 3), np.uint8))


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    "text", ["1,2\n3,4\n5,6\n", "x, y\n1, 2\n3, 4\n5, 6\n", "# x y\n1 2\n\n3 4\n5\t6", "1;2\n3;4\n5;6"]
)
def test_tables_of_numbers_however_they_are_written(tmp_path: Path, text: str) -> None:
    samples = load_samples(write(tmp_path / "state.csv", text), "state", None, COLOR, "recording.yaml")
    np.testing.assert_array_equal(samples.values, [[1, 2], [3, 4], [5, 6]])
    np.testing.assert_array_equal(samples.time_s, CLOCK)
    assert samples.values.dtype == np.float32


def test_a_first_column_of_times_is_the_clock(tmp_path: Path) -> None:
    file = write(tmp_path / "state.csv", "time,x\n0.05,1\n0.15,2\n")
    samples = load_samples(file, "state", None, COLOR, "recording.yaml")
    np.testing.assert_array_equal(samples.time_s, [0.05, 0.15])
    np.testing.assert_array_equal(samples.values, [[1], [2]])


def test_times_may_be_in_a_file_of_their_own(tmp_path: Path) -> None:
    np.save(tmp_path / "state.npy", np.arange(4.0))
    times = write(tmp_path / "t.txt", "# seconds\n0.5\n0.6\n0.6\n1e0\n")
    samples = load_samples(tmp_path / "state.npy", "state", times, COLOR, "recording.yaml")
    np.testing.assert_array_equal(samples.time_s, [0.5, 0.6, 0.6, 1.0])
    assert samples.values.shape == (4, 1)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("s.csv", "1,2\n3,4\n", r"has 2 rows for 3 color pictures; .* 'state_times: state_times\.txt'"),
        ("s.csv", "1,2\n3\n5,6\n", "line 2 has 1 cells, expected 2, as in the first: '3'"),
        ("s.csv", "1,2\n3,x\n5,6\n", "line 2 is not 2 numbers: '3,x'"),
        ("s.csv", "1,2\n3,nan\n5,6\n", "row 2 holds a value that is not finite"),
        ("s.csv", "time,x\n0,1\nnan,2\n1,3\n", r"entry 2 \(nan\) is no time"),
        ("s.csv", "# empty\n", "holds no row"),
        ("s.npy", "not numpy", "not a readable NumPy file"),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, name: str, text: str, message: str) -> None:
    with pytest.raises(DataError, match=message) as caught:
        load_samples(write(tmp_path / name, text), "state", None, COLOR, "recording.yaml")
    assert name in str(caught.value)


@pytest.mark.parametrize(("text", "integers"), [("0\n33\n66\n", True), ("0.0\n33.0\n66.0\n", False)])
def test_times_are_given_as_they_stand_there(tmp_path: Path, text: str, integers: bool) -> None:
    stamps, timing = load_times(write(tmp_path / "t.txt", text))
    np.testing.assert_array_equal(stamps, [0, 33, 66])
    assert (timing.source, timing.unit, timing.integers) == ("t.txt", None, integers)


def test_times_are_one_a_line(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="has 2 numbers a line"):
        load_times(write(tmp_path / "t.txt", "0 1\n1 2\n"))


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"state\.npy: there is no such file"):
        load_samples(tmp_path / "state.npy", "state", None, COLOR, "recording.yaml")
