"""Whatever is accepted is paired by what was true: random recordings, by their generator's own times."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import hypothesis
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from thoroughness import examples

from flowlab.recordings.base import ImageStream, SampleStream, Streams
from flowlab.recordings.clock import put_on_one_clock
from flowlab.recordings.file_stamps import read_names
from flowlab.recordings.frame_check import align_samples, check_frames
from flowlab.recordings.recording_yaml import Metadata
from flowlab.recordings.stamps import SECONDS, Timing, UnclearStamps
from flowlab.recordings.sync import nearest_sample
from flowlab.recordings.verdicts import Verdict

EPOCH = 1_700_000_000


@dataclass(frozen=True)
class Truth:
    """What really happened."""

    color_s: np.ndarray
    depth_s: np.ndarray
    state_s: np.ndarray
    step_s: float


@st.composite
def truths(draw: st.DrawFn) -> Truth:
    """Streams with losses, an offset between them, jitter, at random rates."""
    rng = np.random.default_rng(draw(st.integers(0, 10**6)))
    step, count = 1 / draw(st.sampled_from([5, 10, 15, 30, 60, 90])), draw(st.integers(12, 60))
    jitter, loss = draw(st.sampled_from([0, 0.02, 0.05])), draw(st.sampled_from([0, 0, 0.05, 0.2]))
    clock = step * (np.arange(count) + jitter * rng.uniform(-1, 1, count))
    kept = [np.sort(rng.permutation(count)[: max(4, count - rng.binomial(count, loss))]) for _ in range(2)]
    off = draw(st.sampled_from([0, 0.1, 0.3, -0.2])) * step
    faster = draw(st.sampled_from([2, 3, 7]))
    state = np.arange(-2, faster * count) * step / faster
    hole = draw(st.integers(0, len(state) // 3)) if draw(st.booleans()) else 0
    state = np.delete(state, np.arange(len(state) // 2, len(state) // 2 + hole))
    return Truth(clock[kept[0]], clock[kept[1]] + off, state, step)


def numbers(truth: Truth) -> list[np.ndarray]:
    """The number that one counter gives each picture."""
    return [np.rint(s / truth.step_s - 0.01).astype(int) for s in (truth.color_s, truth.depth_s)]


@st.composite
def recordings(draw: st.DrawFn) -> tuple[Truth, list[Any], list[Timing], Metadata]:
    """What happened, and how a recording tells of it: stamps of color, depth and state, and what is said."""
    truth = draw(truths())
    every = [truth.color_s, truth.depth_s, truth.state_s]
    kind = draw(st.sampled_from(["names", "counted", "recounted", "origins", "list", "messages"]))
    base = draw(st.sampled_from([0, 17.3, EPOCH]))
    unit = draw(st.sampled_from(sorted(SECONDS)))
    fps = draw(st.sampled_from([None, 1 / truth.step_s, 30.0]))
    known = {"fps": fps, "time_unit": draw(st.sampled_from([None, None, unit]))}
    integers = unit != "s" and draw(st.booleans())
    stamps = [np.rint((s + base) / SECONDS[unit]) if integers else (s + base) / SECONDS[unit] for s in every]
    timing = Timing("times", unit=None, integers=integers, names=kind == "names" and integers)
    if kind == "messages":
        behind = draw(st.sampled_from([0, 0, 2.0, -0.5, 3600.0]))
        stamps = [every[0] + EPOCH, every[1] + EPOCH, every[2] + EPOCH - behind]
        timings = [Timing("stamps", overtaking=True, recorded_s=s + EPOCH + 0.004) for s in every]
        if draw(st.booleans()):
            stamps[2] = np.full(len(every[2]), np.nan)
        clock = draw(st.sampled_from([None, None, "recorded"]))
        return truth, stamps, timings, Metadata(fps=fps, clock=clock)
    if kind in ("counted", "recounted", "origins"):
        counted = numbers(truth)
        if kind == "recounted":  # each stream by itself, and one begins later
            late, count = draw(st.integers(1, 4)), len(truth.color_s) + 4
            whole = truth.step_s * np.arange(count)
            truth = Truth(whole, whole[late:], truth.state_s, truth.step_s)
            counted = [np.arange(count), np.arange(count - late)]
        if kind == "origins":
            shift = draw(st.sampled_from([1, -1, 7]))
            # A loss at one end that makes up for the shift leaves no trace in the numbers.
            hypothesis.assume((counted[0][[0, -1]] == counted[1][[0, -1]]).all())
            counted[1] = counted[1] + shift
        first = draw(st.sampled_from([0, 1])) if kind != "origins" else 0
        counts = Timing("names", unit=None, integers=True, names=True)
        counts2 = Timing("names of depth", unit=None, integers=True, names=True)
        state_s = truth.state_s - truth.color_s[0]
        stamps = [(counted[0] + first).astype(float), (counted[1] + first).astype(float), state_s]
        return truth, stamps, [counts, counts2, Timing("state times")], Metadata(fps=1 / truth.step_s)
    return truth, stamps, [timing, timing, timing], Metadata(**known)


def streams_of(stamps: list[np.ndarray], timings: list[Timing], truth: Truth) -> Streams:
    """Streams whose pictures and samples are when they were taken."""

    def color(i: int) -> np.ndarray:
        return np.full((2, 2, 3), i % 200, np.uint8) + np.arange(3, dtype=np.uint8)

    def depth(i: int) -> np.ndarray:
        return np.full((2, 2), 500 + i, np.uint16) + np.arange(2, dtype=np.uint16)

    names = [tuple(map(str, range(len(s)))) for s in stamps[:2]]
    rows = truth.state_s[:, None].astype(np.float32)
    return Streams(
        ImageStream(names[0], stamps[0].astype(float), color, timings[0]),
        ImageStream(names[1], stamps[1].astype(float), depth, timings[1]),
        state=(SampleStream("state", stamps[2].astype(float), rows, timings[2]),),
    )


@settings(max_examples=examples(2000), deadline=None, derandomize=True)
@given(recordings())
def test_what_is_accepted_is_from_within_half_a_frame(
    recording: tuple[Truth, list[np.ndarray], list[Timing], Metadata],
) -> None:
    truth, stamps, timings, known = recording
    try:
        streams = put_on_one_clock(streams_of(stamps, timings, truth), known)
    except UnclearStamps:
        return
    if any(check.verdict is Verdict.REFUSED for check in streams.checks):
        return
    seen = check_frames(streams, every=1, start_s=0.0, stop_s=None, max_sync_s=0.02, max_state_s=0.1)
    near = 0.65 * truth.step_s  # half a frame, and its jitter
    color = truth.color_s[[int(streams.color.names[i]) for i in seen.color]]
    depth = truth.depth_s[[int(streams.depth.names[i]) for i in seen.depth]]
    state = align_samples(streams.state, streams.color.time_s[seen.color], nearest_sample)[:, 0]
    assert (np.abs(color - depth) <= near).all()
    assert (np.abs(color - state) <= near + 0.005).all()
    took = np.diff(streams.color.time_s[seen.color]) - np.diff(color)
    assert (np.abs(took) <= 0.25 * truth.step_s + 1e-6).all(), "time runs as it did"


def test_most_plain_recordings_are_accepted() -> None:
    """Not by refusing all: names that are times since 1970, in every unit, with losses."""
    for unit, digits in (("s", 6), ("ms", 0), ("us", 0), ("ns", 0)):
        truth = np.delete(np.arange(40), [3, 17, 18]) / 30
        files = [Path(f"{(EPOCH + t) / SECONDS[unit]:.{digits}f}.png") for t in truth]
        color, depth = (read_names(files, name) for name in ("color", "depth"))
        read = lambda i: np.zeros((2, 2), np.uint16)  # noqa: E731
        names = tuple(map(str, range(len(truth))))
        streams = put_on_one_clock(
            Streams(ImageStream(names, color[1], read, color[2]), ImageStream(names, depth[1], read, depth[2])),
            Metadata(),
        )
        np.testing.assert_allclose(np.diff(streams.color.time_s), np.diff(truth), atol=2e-3)
        assert all(check.verdict in (Verdict.OK, Verdict.ASSUMED) for check in streams.checks)
