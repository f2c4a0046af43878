"""Files of numbers: times, and rows of robot state or actions."""

import re
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64, Num

from flowlab.array_files import load_array
from flowlab.errors import DataError
from flowlab.recordings.base import ImageStream, SampleStream
from flowlab.recordings.stamps import Timing
from flowlab.text import cut, shown
from flowlab.untrusted import read_text

_TIME_COLUMNS = ("time", "time_s", "t", "timestamp", "timestamps")


def load_times(path: Path) -> tuple[Float64[np.ndarray, "N"], Timing]:
    """Times of a file, one a line or as a numpy array, as they stand there, and what is known of them."""
    _, time, integers = _load(path)
    if time.shape[1] != 1:
        raise DataError(f"{path}: has {time.shape[1]} numbers a line, expected one time")
    return check_times(path, time[:, 0], integers)


def check_times(path: Path, time: Num[np.ndarray, "N"], integers: bool) -> tuple[Float64[np.ndarray, "N"], Timing]:
    """The same times, where they are finite; in which unit they are is decided elsewhere."""
    if not np.isfinite(time).all():
        at = int(np.argmin(np.isfinite(time)))
        raise DataError(f"{path}: entry {at + 1} ({time[at]}) is no time")
    return time.astype(np.float64), Timing(path.name, unit=None, integers=integers)


def load_samples(path: Path, name: str, times: Path | None, color: ImageStream, write_to: str) -> SampleStream:
    """Rows of numbers: with times of their own (a file, or a first column ``time``), else one per color picture."""
    header, values, _ = _load(path)
    own = None
    if header and header[0].lower() in _TIME_COLUMNS:
        whole = not (values[:, 0] % 1).any()
        own, values = check_times(path, values[:, 0], whole), values[:, 1:]
    if times is not None:
        own = load_times(times)
    where, timing = (color.time_s, color.timing) if own is None else own
    if len(where) != len(values):
        of = "times" if own is not None else "color pictures"
        raise DataError(
            f"{path}: has {len(values)} rows for {len(where)} {of}; give every row its time [s] in a file named "
            f"in {write_to}, as in '{name}_times: {name}_times.txt'"
        )
    rows = to_float32(values)
    if not np.isfinite(rows).all():
        row = int(np.argmax(~np.isfinite(rows).all(1)))
        raise DataError(f"{path}: row {row + 1} holds a value that is not finite, or too large for float32")
    return SampleStream(name, where, rows, timing)


def _load(path: Path) -> tuple[list[str], np.ndarray, bool]:
    """Names of columns (none where the file has none), rows (N, D) float64, and whether all are integers."""
    if path.suffix.lower() != ".npy":
        return _parse(path, read_text(path))
    values = load_array(path)
    if values.dtype.kind not in "biuf":
        raise DataError(f"{path}: holds {cut(str(values.dtype))}, expected numbers")
    return [], _table(path, values.astype(np.float64)), values.dtype.kind in "iu"


def _parse(path: Path, text: str) -> tuple[list[str], np.ndarray, bool]:
    """Names of columns and rows of numbers of a text, and whether all are written as integers."""
    lines = [(n, line.strip()) for n, line in enumerate(text.splitlines(), 1)]
    rows = [(n, re.split(r"[,;\s]+", line.strip(",; "))) for n, line in lines if line and not line.startswith("#")]
    header: list[str] = []
    if rows and not _is_number(rows[0][1][0]):
        header = rows.pop(0)[1]
    if not rows:
        raise DataError(f"{path}: holds no row of numbers")
    width = len(header) or len(rows[0][1])
    for n, row in rows:
        if len(row) != width or not all(map(_is_number, row)):
            raise DataError(f"{path}: line {n} is not {width} numbers: {shown(' '.join(row))}")
    integers = all(number.lstrip("+-").isdecimal() for _, row in rows for number in row)
    return header, np.array([row for _, row in rows], np.float64), integers


def _table(path: Path, values: np.ndarray) -> np.ndarray:
    """Values as rows (N, D)."""
    if values.ndim == 1:
        values = values[:, None]
    if values.ndim != 2 or not len(values):
        raise DataError(f"{path}: has the shape {cut(str(values.shape))}, expected (rows, numbers)")
    return values


def to_float32(values: Num[np.ndarray, "..."]) -> Float32[np.ndarray, "..."]:
    """The same numbers; one too large for the type is infinite."""
    with np.errstate(over="ignore"):
        return values.astype(np.float32)


def _is_number(text: str) -> bool:
    """Whether a text is a number."""
    try:
        float(text)
    except ValueError:
        return False
    return True
