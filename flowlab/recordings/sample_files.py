"""Files of numbers: times, and rows of robot state or actions."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64, Num

from flowlab.errors import DataError
from flowlab.recordings.base import ImageStream, SampleStream
from flowlab.recordings.columns import base_and_unit, file_stem, find_columns
from flowlab.recordings.stamps import Timing, rough_seconds
from flowlab.recordings.tables import read_table


def load_times(path: Path) -> tuple[Float64[np.ndarray, "N"], Timing]:
    """Times of a file, one a line or as a numpy array, and what is known of them."""
    table = read_table(path)
    if table.values.shape[1] != 1 or table.text:
        raise DataError(f"{path}: has {table.values.shape[1]} numbers a line, expected one time")
    unit = base_and_unit(table.names[0])[1] if table.names else None
    return check_times(path, table.values[:, 0] * (unit or 1.0), table.integers, unit is not None)


def check_times(
    path: Path, time: Num[np.ndarray, "N"], integers: bool, in_seconds: bool = False
) -> tuple[Float64[np.ndarray, "N"], Timing]:
    """The same times, where they are finite; in which unit they are is decided elsewhere, where nothing states it."""
    if not np.isfinite(time).all():
        at = int(np.argmin(np.isfinite(time)))
        raise DataError(f"{path}: entry {at + 1} ({time[at]}) is no time")
    return time.astype(np.float64), Timing(path.name, unit="s" if in_seconds else None, integers=integers)


def load_samples(
    path: Path,
    name: str,
    times: Path | None,
    color: ImageStream,
    write_to: str,
    columns: Sequence[str] | None = None,
    fps: float | None = None,
) -> SampleStream:
    """Rows of numbers: with times, or numbers of frames, of their own (a file, or a column), else one per picture."""
    numbered = color.timing.names and color.timing.integers and fps is not None
    rough_s = rough_seconds(color.time_s, color.timing, fps)
    table = read_table(path)
    pictures = {file_stem(n): t for n, t in zip(color.names, color.time_s.tolist(), strict=True)} if table.text else {}
    found = find_columns(table, name, columns, rough_s, bool(times), numbered, pictures)
    own = None if found.time is None else check_times(path, found.time, not (found.time % 1).any(), found.unit_known)
    if own is not None and found.are_stamps:
        own = own[0], color.timing
    elif own is not None and found.are_frames:
        own = own[0], replace(own[1], names=True)
    if times is not None:
        own = load_times(times)
    where, timing = (color.time_s, color.timing) if own is None else own
    if len(where) != len(found.values):
        of = "times" if own is not None else "color pictures"
        raise DataError(
            f"{path}: has {len(found.values)} rows for {len(where)} {of}; give every row its time [s] in a file named "
            f"in {write_to}, as in '{name}_times: {name}_times.txt'"
        )
    rows = to_float32(found.values)
    if not np.isfinite(rows).all():
        row = int(np.argmax(~np.isfinite(rows).all(1)))
        raise DataError(
            f"{path}: row {row + 1} holds a value that is not finite, or too large for float32; take such rows out, "
            f"and give the others times, as with '{name}_times'"
        )
    return SampleStream(name, where, rows, timing, columns=found.names)


def to_float32(values: Num[np.ndarray, "..."]) -> Float32[np.ndarray, "..."]:
    """The same numbers; one too large for the type is infinite."""
    with np.errstate(over="ignore"):
        return values.astype(np.float32)
