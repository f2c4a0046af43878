"""One clock for all streams: every recording passes here, whatever its layout, before anything is paired."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal, TypeVar

import numpy as np
from jaxtyping import Float64, Int64

from flowlab.recordings.base import ImageStream, SampleStream, Streams
from flowlab.recordings.dates import check_no_dates
from flowlab.recordings.numbering import check_numbers
from flowlab.recordings.record_times import choose_clock, was_set_back
from flowlab.recordings.recording_yaml import Metadata
from flowlab.recordings.stamps import SECONDS, Timing, UnclearStamps, Unit, decide_sample_unit, decide_unit, kept_every
from flowlab.recordings.sync import find_gaps, sampling_rate
from flowlab.recordings.verdicts import Check, Verdict

_APART_S = 0.5
"""Streams whose spans lie this far apart have nothing in common."""
_IN_ORDER = 0.5
"""Stamps sorted by time are those of one clock where none follows sooner than this share of the usual step."""
_OVERTAKEN = 2.5
"""Messages that overtake others do so by no more than this many steps."""
_GAPPY = 0.5
"""Share of the time that gaps may take before that is doubtful."""
AnyStream = TypeVar("AnyStream", ImageStream, SampleStream)


@dataclass(frozen=True, slots=True)
class _PictureClock:
    """How the stamps of color and depth become seconds."""

    color: Unit | Literal["frames"]
    depth: Unit | Literal["frames"]
    first: float
    """Number of the first color frame, at which the time is 0, where frames are numbered."""
    fps: float

    def seconds(self, stamps: Float64[np.ndarray, "N"], unit: str) -> Float64[np.ndarray, "N"]:
        """The same instants [s]."""
        return (stamps - self.first) / self.fps if unit == "frames" else stamps * SECONDS[unit]


def put_on_one_clock(streams: Streams, known: Metadata) -> Streams:
    """The same streams in the order of time, in seconds of one clock, with what was found added to their checks.

    Args:
        streams: As a reader gives them: stamps in the order of the recording, with what is known of their unit.
        known: What is known of the recording, by the user and by itself.

    Raises:
        UnclearStamps: The stamps do not rise, their unit is not clear, or streams have nothing in common; the message
            says what to write.
    """
    _check_said(streams, known)
    stamped = {n: (s.time_s + (getattr(known, key, 0) or 0), s.timing, key) for n, s, key in _named(streams)}
    recorded, checks = choose_clock(stamped, known)
    color, depth = (_in_order(s, name, recorded) for s, name in ((streams.color, "color"), (streams.depth, "depth")))
    state, action = (
        tuple(_in_order(s, s.name, recorded) for s in samples) for samples in (streams.state, streams.action)
    )
    for time_s, timing in ((s.time_s, s.timing) for s in (color, depth)):
        check_no_dates(time_s, timing)
    for sample in (*state, *action):
        check_no_dates(sample.time_s, sample.timing)
    units = [decide_unit(s.time_s, s.timing, fps=known.fps, stated=known.time_unit) for s in (color, depth)]
    if "frames" in units and units[0] != units[1]:
        raise UnclearStamps(
            f"{color.timing.source} are {_called(units[0])}, {depth.timing.source} {_called(units[1])}; "
            "give the times of both in 'times' and 'depth_times'"
        )
    clock = _PictureClock(units[0], units[1], float(color.time_s[0]), known.fps or 1.0)
    checks += _number_checks(clock, color, depth, (*state, *action), known)
    lag = known.state_offset_s or 0.0
    poses, late = streams.poses, known.T_world_cam_offset_s or 0.0
    if poses is not None:
        poses = _sample_timed(_in_order(poses, poses.name, recorded), streams, color, clock, known, late)
    timed = replace(
        streams,
        poses=poses,
        color=_timed(color, clock.seconds(color.time_s, units[0])),
        depth=_timed(depth, clock.seconds(depth.time_s, units[1]) + (known.depth_offset_s or 0.0)),
        state=tuple(_sample_timed(s, streams, color, clock, known, lag) for s in state),
        action=tuple(_sample_timed(s, streams, color, clock, known, lag) for s in action),
    )
    if all(check.verdict is not Verdict.REFUSED for check in checks):
        _check_overlap(timed)
    said = Check("clock", *_clock_words(replace(streams, color=color, depth=depth), units, known))
    return replace(timed, checks=(*streams.checks, said, *checks, *_step_checks(timed)))


def _named(streams: Streams) -> Iterator[tuple[str, ImageStream | SampleStream, str]]:
    """Every stream, what it is called, and the key with which the user says what to add to its times."""
    yield "color", streams.color, ""
    yield "depth", streams.depth, "depth_offset_s"
    for s in (*streams.state, *streams.action):
        yield s.name, s, "state_offset_s"
    if streams.poses is not None:
        yield streams.poses.name, streams.poses, "T_world_cam_offset_s"


def _check_said(streams: Streams, known: Metadata) -> None:
    """Refuse what the user says of the clock where there is nothing that it could be said of."""
    timings = [streams.color.timing, streams.depth.timing, *(s.timing for s in (*streams.state, *streams.action))]
    if known.time_unit is not None and all(t.unit not in (None, known.time_unit) for t in timings):
        raise UnclearStamps(f"'time_unit: {known.time_unit}' is said, but {timings[0].source} are in "
                            f"{timings[0].unit} in this layout; leave it out")  # fmt: skip
    if known.clock == "recorded" and all(t.recorded_s is None for t in timings):
        raise UnclearStamps("'clock: recorded' is said, but there are no times of recording in it; leave it out")
    if known.state_offset_s and not (streams.state or streams.action):
        raise UnclearStamps("'state_offset_s' is said, but there is no state; leave it out")


def _in_order(stream: AnyStream, name: str, recorded: bool) -> AnyStream:
    """A stream in the order of time, by its stamps or by the times of recording; one that goes back is refused."""
    timing, stamps = stream.timing, stream.time_s
    if timing.recorded_s is not None and (recorded or not np.isfinite(stamps).all()):
        stamps = timing.recorded_s
    back = np.flatnonzero(np.diff(stamps) < 0)
    if not len(back):
        return replace(stream, time_s=stamps)
    order = np.argsort(stamps, kind="stable")
    steps = np.diff(stamps[order])
    usual = np.median(steps)
    overtaken = (
        timing.overtaking
        and -np.diff(stamps).min() <= _OVERTAKEN * usual
        and (timing.recorded_s is None or not was_set_back(stamps, timing.recorded_s))
    )
    if overtaken and steps.min() >= _IN_ORDER * usual:
        return _reordered(replace(stream, time_s=stamps), order)
    at = int(back[0])
    unit = "" if timing.unit is None else f" {timing.unit}"
    raise UnclearStamps(
        f"the stamps of {name} must rise, and {timing.source} step back by {stamps[at] - stamps[at + 1]:.6g}{unit} at "
        f"entry {at + 2} (from {stamps[at]:.15g} to {stamps[at + 1]:.15g}{_more(len(back))}); their clock was set "
        "back, or they are not in the order of time: cut the recording there, or correct them"
        + ("; 'clock: recorded' takes the times of recording" if timing.recorded_s is not None else "")
    )


def _more(count: int) -> str:
    return f", and {count - 1} times more" if count > 1 else ""


def _reordered(stream: AnyStream, order: Int64[np.ndarray, "N"]) -> AnyStream:
    """The same stream in another order."""
    stream = replace(stream, time_s=stream.time_s[order])
    if isinstance(stream, SampleStream):
        return replace(stream, values=stream.values[order])
    names = tuple(stream.names[i] for i in order)
    return replace(stream, names=names, read=partial(_read_at, stream.read, order))


def _read_at(read, order, index) -> np.ndarray:  # type: ignore[no-untyped-def]
    """Decode the picture that is the ``index``-th in time."""
    picture: np.ndarray = read(int(order[index]))
    return picture


def _timed(stream: AnyStream, time_s: Float64[np.ndarray, "N"]) -> AnyStream:
    """A stream with times on the common clock."""
    return replace(stream, time_s=time_s, timing=Timing(stream.timing.source))


def _number_frames(clock: _PictureClock, sample: SampleStream) -> bool:
    """Whether a stream of samples is numbered by the frames of the pictures."""
    timing = sample.timing
    return clock.color == "frames" and timing.unit is None and timing.names and timing.integers


def _sample_timed(
    sample: SampleStream, streams: Streams, color: ImageStream, clock: _PictureClock, known: Metadata, lag: float
) -> SampleStream:
    """Samples with times on the clock of the pictures."""
    own = sample.timing is not streams.color.timing
    if not own or _number_frames(clock, sample):
        return _timed(sample, clock.seconds(sample.time_s, clock.color) + lag)
    pictures_s = clock.seconds(color.time_s, clock.color)
    unit = decide_sample_unit(sample.time_s, sample.timing, pictures_s - lag, known.time_unit)
    return _timed(sample, sample.time_s * SECONDS[unit] + lag)


def _number_checks(
    clock: _PictureClock, color: ImageStream, depth: ImageStream, samples: tuple[SampleStream, ...], known: Metadata
) -> tuple[Check, ...]:
    """Whether numbers of frames are those of one counter."""
    if clock.color != "frames" or color.timing is depth.timing:
        return ()
    stated = {"depth": known.depth_offset_s, "state": known.state_offset_s}
    found = [check_numbers(color.time_s, depth.time_s, "depth", stated["depth"] is not None)]
    numbered = (s for s in samples if s.timing is not color.timing and _number_frames(clock, s))
    found += (check_numbers(color.time_s, s.time_s, s.name, stated["state"] is not None) for s in numbered)
    return tuple(found)


def _check_overlap(streams: Streams) -> None:
    """Refuse streams that were not recorded at the same time as the pictures."""
    color = streams.color.time_s
    for name, stream, key in _named(streams):
        time_s = stream.time_s
        if len(time_s) and max(time_s[0] - color[-1], color[0] - time_s[-1]) > _APART_S:
            raise UnclearStamps(
                f"color lies between {color[0]:.15g} and {color[-1]:.15g} s, and {name} between {time_s[0]:.15g} and "
                f"{time_s[-1]:.15g} s: their clocks differ; write '{key}: ...', the seconds to add to the times of "
                f"{'state' if key == 'state_offset_s' else name}"
            )


def _clock_words(streams: Streams, units: Sequence[str], known: Metadata) -> tuple[Verdict, str]:
    """In which unit the stamps of pictures are, and how that is known."""
    found, verdict = [], Verdict.OK
    for name, stream, unit in (("color", streams.color, units[0]), ("depth", streams.depth, units[1])):
        how = f"with 'fps: {known.fps:g}'" if unit == "frames" else "as the layout says"
        if unit != "frames" and stream.timing.unit is None:
            how = "as 'time_unit' says" if known.time_unit else "by how they step and where they begin"
            verdict = verdict if unit == "s" or known.time_unit else Verdict.ASSUMED
        every = kept_every(stream.time_s) if unit == "frames" else 1
        if every > 1 and known.time_unit is None:
            rate = (known.fps or 1.0) / every
            how += f", of which every {every}th was kept, {rate:.3g} a second ('time_unit' says what else they may be)"
            verdict = Verdict.ASSUMED
        found.append(f"{name}: {stream.timing.source} are {_called(unit)}, {how}")
    offsets = {key: getattr(known, key) for key in ("depth_offset_s", "state_offset_s", "T_world_cam_offset_s")}
    found += (f"'{key}: {value:g}' is added" for key, value in offsets.items() if value)
    return verdict, "; ".join(found)


def _called(unit: str) -> str:
    return "numbers of frames" if unit == "frames" else f"times in {unit}"


def _step_checks(streams: Streams) -> Iterator[Check]:
    """Gaps, and instants that come twice, in every stream."""
    doubts, found = [], []
    every = [("color", streams.color.time_s), ("depth", streams.depth.time_s)]
    for name, time_s in [*every, *((s.name, s.time_s) for s in streams.state)]:
        gaps = find_gaps(time_s)
        ties = np.flatnonzero(np.diff(time_s) == 0)
        words = f"{name} at {sampling_rate(time_s):.3g} a second, {len(gaps) or 'no'} gap{'s' * (len(gaps) != 1)}"
        if len(ties):
            words += f", {len(ties)} of the same time as the one before (the first is number {ties[0] + 2})"
        found.append(words)
        if name in ("color", "depth") and (len(ties) or sum(g for _, g in gaps) > _GAPPY * np.ptp(time_s)):
            doubts.append(name)
    yield Check("steps", Verdict.DOUBTFUL if doubts else Verdict.OK, "; ".join(found))
