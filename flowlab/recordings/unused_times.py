"""Files and arrays of times that no stream uses: whether they agree with the times that are taken."""

import re
from pathlib import PurePosixPath
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float64

from flowlab.recordings.file_contents import Contents
from flowlab.recordings.recording_yaml import FILE_NAME
from flowlab.recordings.stamps import SECONDS
from flowlab.text import cut

if TYPE_CHECKING:
    from flowlab.recordings.parsing import ParsedRecording

_TIMES = re.compile(r"(?:^|[_\-. ])(?:times?|ts|t|stamps?|clock)(?:$|[_\-. ])|timestamp|time_?stamp", re.IGNORECASE)
_OF = {"depth": "depth_times", "state": "state_times", "joint": "state_times", "robot": "state_times",
       "action": "action_times"}  # fmt: skip
"""Of which stream times are, by a part of their name, and the key that names them; else of color."""
_READ = ("", ".npy", ".txt", ".csv", ".tsv", ".log", ".dat")
"""Endings of files of times that are read, and of arrays."""
_NEAR = 0.5
"""Times agree that differ by less than this share of the usual step."""


def called_times(name: str, contents: Contents) -> bool:
    """Whether something is called as times are, and holds one number for each instant, or what is not known."""
    values = contents.values
    one = values is None or values.ndim == 1 or (values.ndim == 2 and 1 in values.shape)
    return one and _TIMES.search(PurePosixPath(name).stem) is not None


def times_doubt(source: "ParsedRecording", name: str, contents: Contents) -> str | None:
    """What is said of times that are not used; None where they agree with those that are."""
    stem = PurePosixPath(name).stem.lower()
    key = next((k for part, k in _OF.items() if part in stem), "times")
    taken = _taken(source, key)
    values = None if contents.values is None else contents.values.astype(np.float64).reshape(-1)
    if taken is not None and values is not None and _agree(values, taken, absolute=key != "times"):
        return None
    return f"is not used, and is not known to agree with the times that are; {_advice(source, name, key)}"


def _advice(source: "ParsedRecording", name: str, key: str) -> str:
    """What to do where a file has the times of a stream."""
    if PurePosixPath(name).suffix.lower() not in _READ:
        return f"if it has the times of {_called(key)}, write them, one a line, into a file named with '{key}'"
    if source.reader.name == "plain" or (key not in ("times", "depth_times") and source.path.is_dir()):
        return f"if it has the times of {_called(key)}, write '{key}: {cut(name)}' into {FILE_NAME}"
    if source.reader.name == "arrays":
        name = {"times": "timestamp"}.get(key, f"{_called(key)}_timestamps")
        return f"if it has the times of {_called(key)}, call it '{name}'"
    return f"if it has the times of {_called(key)}, write a plain folder, with '{key}'"


def _called(key: str) -> str:
    return "color" if key == "times" else key.removesuffix("_times")


def _taken(source: "ParsedRecording", key: str) -> Float64[np.ndarray, "N"] | None:
    """The times of the stream that are used; None where there is no such stream."""
    streams = source.streams
    samples = {"state_times": streams.state, "action_times": streams.action}
    if key in samples:
        return samples[key][0].time_s if samples[key] else None
    return streams.color.time_s if key == "times" else streams.depth.time_s


def _agree(values: Float64[np.ndarray, "M"], taken: Float64[np.ndarray, "N"], absolute: bool) -> bool:
    """Whether times are those that are taken, in whatever unit; or so but for an offset, unless ``absolute``."""
    if len(values) != len(taken) or len(taken) < 2 or not np.isfinite(values).all():
        return False
    near = _NEAR * float(np.median(np.diff(taken)))
    for seconds in SECONDS.values():
        off = values * seconds - taken
        off = off if absolute else off - off[0]
        if np.abs(off).max() < near:
            return True
    return False
