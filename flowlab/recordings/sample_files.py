"""Files of numbers: times, and rows of robot state or actions."""

import re
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64, Num

from flowlab.array_files import load_array
from flowlab.errors import DataError
from flowlab.recordings.base import SampleStream
from flowlab.text import cut, shown
from flowlab.untrusted import read_text

_TIME_COLUMNS = ("time", "time_s", "t", "timestamp", "timestamps")


def load_times(path: Path) -> Float64[np.ndarray, "N"]:
    """Times [s] of a file, one a line or as a numpy array; they must rise."""
    time_s = _load(path)[1]
    if time_s.shape[1] != 1:
        raise DataError(f"{path}: has {time_s.shape[1]} numbers a line, expected one time in seconds")
    return check_times(path, time_s[:, 0])


def check_times(path: Path, time_s: Num[np.ndarray, "N"]) -> Float64[np.ndarray, "N"]:
    """The same times, where they can be seconds and never fall."""
    with np.errstate(invalid="ignore", over="ignore"):
        step = np.diff(time_s)
    if not np.isfinite(time_s).all() or (step < 0).any():
        at = int(np.argmax(~(np.append(0, step) >= 0)))
        raise DataError(f"{path}: the times must rise, and entry {at + 1} ({time_s[at]}) does not")
    if len(step) and np.median(step) > 10:
        raise DataError(
            f"{path}: the times must be in seconds; with a median of {np.median(step):g} between two they look like "
            "milli-, micro- or nanoseconds"
        )
    return time_s.astype(np.float64)


def load_samples(
    path: Path, name: str, times: Path | None, color_time_s: Float64[np.ndarray, "F"], write_to: str
) -> SampleStream:
    """Rows of numbers: with times of their own (a file, or a first column ``time``), else one per color picture."""
    header, values = _load(path)
    own = None
    if header and header[0].lower() in _TIME_COLUMNS:
        own, values = check_times(path, values[:, 0]), values[:, 1:]
    if times is not None:
        own = load_times(times)
    where = color_time_s if own is None else own
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
    return SampleStream(name, where, rows)


def _load(path: Path) -> tuple[list[str], np.ndarray]:
    """Names of columns (none where the file has none), and rows (N, D) float64."""
    if path.suffix.lower() != ".npy":
        return _parse(path, read_text(path))
    values = load_array(path)
    if values.dtype.kind not in "biuf":
        raise DataError(f"{path}: holds {cut(str(values.dtype))}, expected numbers")
    return [], _table(path, values.astype(np.float64))


def _parse(path: Path, text: str) -> tuple[list[str], np.ndarray]:
    """Names of columns and rows of numbers of a text."""
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
    return header, np.array([row for _, row in rows], np.float64)


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
