"""What was recognized of a recording, for a look before the work."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from flowlab.errors import DataError
from flowlab.recordings.base import channel_names
from flowlab.recordings.frame_check import BadFrame
from flowlab.recordings.frame_processing import Size
from flowlab.recordings.parsing import ParsedRecording, RecordingSettings, parse_recording
from flowlab.recordings.recording_yaml import Metadata
from flowlab.recordings.sync import find_gaps, sampling_rate
from flowlab.recordings.verdicts import Check, raise_refused


@dataclass(frozen=True, slots=True)
class StreamInfo:
    """One stream of a recording, in numbers."""

    name: str
    count: int
    fps: float
    """1 / median interval [1/s]; 0 for a single sample."""
    first_s: float
    """Since the first color frame [s]."""
    last_s: float
    gaps: tuple[tuple[float, float], ...]
    """Start, since the first color frame, and length [s] of every interval of more than 1.5 median ones."""


@dataclass(frozen=True, slots=True)
class RecordingDescription:
    """What was recognized of a recording."""

    path: Path
    reader: str
    task: str | None
    """What the recording itself calls its task."""
    streams: tuple[StreamInfo, ...]
    sync_s: Mapping[str, tuple[float, float]]
    """Median and greatest distance in time from a color frame to its depth and to its state [s]."""
    rows: int
    """How many rows it would give."""
    color_size: Size
    depth_size: Size
    frame_size: Size | None
    """Of the frames given out; None where calibration is missing."""
    depth_unit_m: float | None
    origin: Mapping[str, str]
    """Where each key of calibration was found, such as ``intrinsics`` and ``depth_unit_m``."""
    metadata: Metadata
    """Everything known of it, from all sources."""
    state_width: int
    action_width: int
    state_names: tuple[str, ...]
    """What the numbers of the state are called; empty where that is not known."""
    action_names: tuple[str, ...]
    bad: tuple[BadFrame, ...]
    checks: tuple[Check, ...]
    """What was looked at, and what came of it."""
    problem: str | None
    """Why it cannot be opened as it is; None where it can."""


def describe(path: Path, settings: RecordingSettings) -> RecordingDescription:
    """What is recognized of a recording, even where it cannot be opened for want of calibration."""
    return describe_parsed(parse_recording(Path(path), settings), settings)


def describe_parsed(source: ParsedRecording, settings: RecordingSettings) -> RecordingDescription:
    """What is recognized of a recording whose layout is understood."""
    path = source.path
    seen, streams, problem, frame_size = source.frame_check, source.streams, None, None
    try:
        raise_refused(path, source.streams.checks)  # why frames are bad, where their clock is
        camera = source.frame_processor(settings).camera
        frame_size = camera.width, camera.height
        source.check_bad_frames(settings)
        raise_refused(path, source.checks)
    except DataError as error:
        problem = str(error)
    rows = source.rows()
    start = streams.color.time_s[0]
    named = [("color", streams.color.time_s), ("depth", streams.depth.time_s)]
    named += [(s.name, s.time_s) for s in (*streams.state, *streams.action)]
    named += [] if streams.poses is None else [("poses", streams.poses.time_s)]
    return RecordingDescription(
        path=source.path,
        reader=source.reader.name,
        task=source.metadata.task,
        streams=tuple(_info(name, time_s - start) for name, time_s in named),
        sync_s={k: (float(np.median(off)), float(off.max())) for k, off in seen.sync_s.items() if len(off)},
        rows=len(seen.color),
        color_size=seen.color_size,
        depth_size=seen.depth_size,
        frame_size=frame_size,
        depth_unit_m=source.metadata.depth_unit_m,
        origin=source.origin,
        metadata=source.metadata,
        state_width=rows.state.shape[1],
        action_width=rows.action.shape[1],
        state_names=tuple(channel_names(streams.state)),
        action_names=tuple(channel_names(streams.action)),
        bad=seen.bad,
        checks=source.checks,
        problem=problem,
    )


def _info(name: str, time_s: Float64[np.ndarray, "N"]) -> StreamInfo:
    """A stream in numbers."""
    return StreamInfo(name, len(time_s), sampling_rate(time_s), float(time_s[0]), float(time_s[-1]), find_gaps(time_s))
