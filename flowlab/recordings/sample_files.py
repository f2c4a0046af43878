"""Files of numbers: times, and rows of robot state or actions."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64, Num

from flowlab.errors import DataError
from flowlab.recordings.base import SampleStream
from flowlab.recordings.tables import base_and_unit, find_columns, read_table


def load_times(path: Path) -> Float64[np.ndarray, "N"]:
    """Times [s] of a file, one a line or as a numpy array; they must rise."""
    table = read_table(path)
    if table.values.shape[1] != 1 or table.text:
        raise DataError(f"{path}: has {table.values.shape[1]} numbers a line, expected one time in seconds")
    unit = base_and_unit(table.names[0])[1] if table.names else None
    return check_times(path, table.values[:, 0] * (unit or 1.0))


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
    path: Path,
    name: str,
    times: Path | None,
    color_time_s: Float64[np.ndarray, "F"],
    write_to: str,
    columns: Sequence[str] | None = None,
) -> SampleStream:
    """Rows of numbers: with times of their own (a file, or a column of times), else one per color picture."""
    found = find_columns(read_table(path), name, columns, color_time_s, times is not None)
    own = None if found.time is None else check_times(path, found.time)
    if times is not None:
        own = load_times(times)
    where = color_time_s if own is None else own
    if len(where) != len(found.values):
        of = "times" if own is not None else "color pictures"
        raise DataError(
            f"{path}: has {len(found.values)} rows for {len(where)} {of}; give every row its time [s] in a file named "
            f"in {write_to}, as in '{name}_times: {name}_times.txt'"
        )
    rows = to_float32(found.values)
    if not np.isfinite(rows).all():
        row = int(np.argmax(~np.isfinite(rows).all(1)))
        raise DataError(f"{path}: row {row + 1} holds a value that is not finite, or too large for float32")
    return SampleStream(name, where, rows, columns=found.names)


def to_float32(values: Num[np.ndarray, "..."]) -> Float32[np.ndarray, "..."]:
    """The same numbers; one too large for the type is infinite."""
    with np.errstate(over="ignore"):
        return values.astype(np.float32)
