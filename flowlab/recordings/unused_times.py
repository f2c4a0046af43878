"""Files and arrays of times that no stream uses: whether they agree with the times that are taken."""

import re
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float64

from flowlab.array_files import load_array, map_member
from flowlab.errors import FlowlabError
from flowlab.recordings.folder_files import files_below
from flowlab.recordings.metadata import FILE_NAME
from flowlab.recordings.stamps import SECONDS
from flowlab.recordings.verdicts import Check, Verdict
from flowlab.text import cut
from flowlab.untrusted import read_text

if TYPE_CHECKING:
    from flowlab.recordings.parsing import ParsedRecording

_TIMES = re.compile(r"(?:^|[_\-. ])(?:times?|ts|t|stamps?|clock)(?:$|[_\-. ])|timestamp|time_?stamp", re.IGNORECASE)
_ENDINGS = (".npy", ".txt", ".csv", ".tsv", ".log")
_OF = {"depth": "depth_times", "state": "state_times", "joint": "state_times", "robot": "state_times",
       "action": "action_times"}  # fmt: skip
"""Of which stream times are, by a part of their name, and the key that names them; else of color."""
_NEAR = 0.5
"""Times agree that differ by less than this share of the usual step."""


def check_unused_times(source: "ParsedRecording") -> Iterator[Check]:
    """A doubt about all times beside a recording that are not used and are not those which were taken."""
    if source.reader.name not in ("plain", "tum", "arrays"):
        return
    for name, path in _unused(source):
        stem = Path(name).stem
        key = next((k for part, k in _OF.items() if part in stem.lower()), "times")
        taken = _taken(source, key)
        values = _values(path, stem)
        if taken is None or (values is not None and _agree(values, taken, absolute=key != "times")):
            continue
        says = (
            f"{cut(name)} is not used, and is not known to agree with the times that are; {_advice(source, name, key)}"
        )
        yield Check("times", Verdict.DOUBTFUL, says)


def _advice(source: "ParsedRecording", name: str, key: str) -> str:
    """What to do where a file has the times of a stream."""
    if source.reader.name != "arrays":
        return f"if it has the times of {_called(key)}, write '{key}: {cut(name)}' into {FILE_NAME}, else move it away"
    if key == "times":
        return "if it has the times of the pictures, call it 'timestamp', else move it away"
    how = "" if key == "depth_times" else f"'{key[:-6]}' and '{key}' in {FILE_NAME} name files with them, or "
    return f"if it has the times of {_called(key)}, {how}write a plain folder, with '{key}'"


def _called(key: str) -> str:
    return "color" if key == "times" else key.removesuffix("_times")


def _unused(source: "ParsedRecording") -> Iterator[tuple[str, Path]]:
    """Names that are called as times, and where they lie."""
    known = source.metadata
    used = {known.times, known.depth_times, known.state, known.state_times, known.action, known.action_times,
            known.T_world_cam_file, known.T_world_cam_times, *(source.streams.used or ())}  # fmt: skip
    if source.path.is_dir():
        names = [(f.name, f.path) for f in files_below(source.path) if Path(f.name).suffix.lower() in _ENDINGS]
    elif source.path.suffix == ".npz":
        with zipfile.ZipFile(source.path) as file:
            names = [(n, source.path) for n in file.namelist() if n.endswith(".npy")]
    else:
        names = []
    yield from ((n, p) for n, p in names if n not in used and len(Path(n).parts) < 3 and _TIMES.search(Path(n).stem))


def _taken(source: "ParsedRecording", key: str) -> Float64[np.ndarray, "N"] | None:
    """The times of the stream that are used; None where there is no such stream."""
    streams = source.streams
    samples = {"state_times": streams.state, "action_times": streams.action}
    if key in samples:
        return samples[key][0].time_s if samples[key] else None
    return streams.color.time_s if key == "times" else streams.depth.time_s


def _values(path: Path, stem: str) -> Float64[np.ndarray, "N"] | None:
    """The numbers of a file, one a row; None where it has others."""
    try:
        if path.suffix == ".npz":
            values = map_member(path, stem)
        elif path.suffix == ".npy":
            values = load_array(path)
        else:
            values = np.array([float(line) for line in read_text(path).split("\n") if line.strip()])
        return np.asarray(values, np.float64).reshape(-1)
    except (FlowlabError, ValueError, TypeError, OSError, KeyError):
        return None


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
