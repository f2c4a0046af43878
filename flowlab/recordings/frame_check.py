"""The first pass over a recording: which frames make rows, and which are bad, by name and reason."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float64, Int64

from flowlab.recordings.base import BadImage, ImageStream, SampleStream, Streams
from flowlab.recordings.content import PictureDigest, digest, repeated_pictures
from flowlab.recordings.depth_aside import DepthAside, find_depth_aside
from flowlab.recordings.frame_processing import Size
from flowlab.recordings.picture_order import check_order
from flowlab.recordings.picture_samples import PictureSample, chosen, shrink_factor, small_depth, small_gray
from flowlab.recordings.pose_steps import check_steps
from flowlab.recordings.poses import check_known, poses_at
from flowlab.recordings.repeats import find_repeats
from flowlab.recordings.stream_offsets import check_offsets
from flowlab.recordings.sync import nearest_sample
from flowlab.recordings.verdicts import Check

_NEAR = 0.55
"""So many intervals away a sample may be that is the nearest of a stream without a loss."""
_ROUNDING_S = 1e-6
"""Times are sums of floating point: what lies just at a limit is within it."""


@dataclass(frozen=True, slots=True)
class BadFrame:
    """A color frame that makes no row."""

    name: str
    """Of the picture that is at fault, of color or of depth."""
    reason: str


@dataclass(frozen=True, slots=True)
class FrameCheck:
    """What was found by decoding every picture once."""

    color: Int64[np.ndarray, "T"]
    """Index of the color picture of every row."""
    depth: Int64[np.ndarray, "T"]
    """Index of the depth picture of every row."""
    bad: tuple[BadFrame, ...]
    looked_at: int
    """How many color frames were asked for."""
    color_size: Size
    depth_size: Size
    median_counts: float
    """Median depth reading of the first good row, in counts."""
    sync_s: Mapping[str, Float64[np.ndarray, "F"]] = field(default_factory=dict)
    """How far from each color frame its depth and its state are, bad ones included."""
    checks: tuple[Check, ...] = ()
    """What was looked at in the pictures, and what came of it."""
    samples: tuple[PictureSample, ...] = ()
    """Small pictures of some rows, evenly spaced."""
    skipped: Int64[np.ndarray, "B"] = field(default_factory=lambda: np.empty(0, np.int64))
    """Index of the color picture of every bad frame."""
    repeated: Mapping[str, Int64[np.ndarray, "R"]] = field(default_factory=dict)
    """Indices of the pictures of ``color`` and ``depth`` that are the same as the one looked at before."""
    T_world_cam: Float64[np.ndarray, "T 4 4"] | None = None
    """The pose of a camera that moves, at every row."""
    aside: DepthAside | None = None
    """Where depth changes when color does; None where too few pictures tell."""


@dataclass(frozen=True, slots=True)
class _ImageCheck:
    """What decoding one picture told."""

    size: Size
    reason: str = ""
    """Why it is bad; empty where it is good."""
    median: float = 0.0
    digest: PictureDigest | None = None
    """Where it could be decoded."""
    kept: tuple[np.ndarray, int] | None = None
    """The picture shrunk, and by how much, where it is one of those to keep."""


def check_frames(
    streams: Streams,
    *,
    every: int,
    start_s: float,
    stop_s: float | None,
    max_sync_s: float,
    max_state_s: float,
    pose_gap_s: float = 0.0,
    stated: Mapping[str, float] | None = None,
    rendered: bool = False,
    aligned: bool = True,
) -> FrameCheck:
    """Decode every picture that is asked for, and pair them.

    A frame is bad where its color or depth picture cannot be decoded, has another size than most, or no
    depth reading at all; where no depth is within ``max_sync_s`` or no state within ``max_state_s``, and at most half
    an interval; where no poses of a camera that moves are around it that are at most ``pose_gap_s`` apart; and where
    its time does not lie after the frame before. ``stated`` is what the user has added to
    the times of a stream, ``rendered`` whether equal pictures without noise are right, ``aligned`` whether
    depth is seen from the color camera, by what is known.
    """
    frames = _selected(streams.color, every, start_s, stop_s)
    clock = streams.color.time_s[frames]
    max_sync_s = min(max_sync_s, _half(streams.color)) + _ROUNDING_S
    max_state = {s.name: min(max_state_s, max(_half(streams.color), _half(s))) + _ROUNDING_S for s in streams.state}
    match = nearest_sample(clock, streams.depth.time_s)
    off = np.abs(streams.depth.time_s[match] - clock)
    off_state = {s.name: np.abs(s.time_s[nearest_sample(clock, s.time_s)] - clock) for s in streams.state}
    poses = None if streams.poses is None else poses_at(streams.poses, clock, pose_gap_s)
    kept = sorted(chosen(len(frames)))
    keep_color, keep_depth = set(frames[kept].tolist()), set(match[kept].tolist())
    color = {int(i): _look(streams.color, int(i), _look_at_color, int(i) in keep_color) for i in frames}
    depth = {
        int(i): _look(streams.depth, int(i), _look_at_depth, int(i) in keep_depth)
        for i in np.unique(match[off <= max_sync_s])
    }
    color_size, depth_size = _usual_size(color.values()), _usual_size(depth.values())
    good, bad, skipped, last = [], [], [], -np.inf
    for k, (i, j) in enumerate(zip(frames.tolist(), match.tolist(), strict=True)):
        name = streams.color.names[i]
        fault = _fault(name, color[i], color_size)
        if fault is None and clock[k] <= last:
            fault = BadFrame(name, "was taken no later than the frame before it")
        if fault is None and off[k] > max_sync_s:
            fault = BadFrame(name, f"no depth within {_ms(max_sync_s)}: the nearest is {_ms(off[k])} away")
        if fault is None:
            fault = _fault(streams.depth.names[j], depth[j], depth_size) or _stale(name, off_state, k, max_state)
        if fault is None and poses is not None and not poses[1][k]:
            fault = BadFrame(name, f"no pose: none at its time, and none on both sides within {_ms(pose_gap_s)}")
        if fault is not None:
            bad.append(fault)
            skipped.append(i)
            continue
        good.append((i, j))
        last = clock[k]
    rows = np.array(good, np.int64).reshape(-1, 2)
    digests = [{i: look.digest for i, look in looks.items() if look.digest is not None} for looks in (color, depth)]
    state = align_samples(streams.state, streams.color.time_s[rows[:, 0]], nearest_sample)
    frozen, repeats = find_repeats(streams, digests[0], digests[1], rows, state, rendered=rendered)
    told = [{i: d for i, d in kept.items() if i not in rows[list(frozen), which]} for which, kept in enumerate(digests)]
    in_order = check_order(*([kept[int(i)] for i in rows[:, k]] for k, kept in enumerate(digests)))
    checks = (repeats, in_order, *check_offsets(streams, told[0], told[1], stated or {}, aligned=aligned))
    bad += [BadFrame(streams.color.names[rows[k, 0]], reason) for k, reason in frozen.items()]
    skipped += [int(rows[k, 0]) for k in frozen]
    rows = np.delete(rows, list(frozen), axis=0)
    T_world_cam = None
    if streams.poses is not None and poses is not None:
        T_world_cam, _ = poses_at(streams.poses, streams.color.time_s[rows[:, 0]], pose_gap_s)
        shown = tuple(streams.color.names[i] for i in rows[:, 0])
        checks += (check_known(streams.poses, poses[1], pose_gap_s), check_steps(T_world_cam, shown))
    median = depth[int(rows[0, 1])].median if len(rows) else 0.0
    sync = {"depth": off, **off_state}
    samples = tuple(_samples([(int(i), int(j)) for i, j in rows], color, depth))
    repeated = {name: repeated_pictures(kept) for name, kept in zip(("color", "depth"), digests, strict=True)}
    return FrameCheck(
        color=rows[:, 0], depth=rows[:, 1], bad=tuple(bad), looked_at=len(frames), color_size=color_size,
        depth_size=depth_size, median_counts=median, sync_s=sync, checks=checks, samples=samples,
        skipped=np.array(skipped, np.int64), repeated=repeated, T_world_cam=T_world_cam,
        aside=find_depth_aside(rows, *digests) if aligned else None,
    )  # fmt: skip


def _samples(
    rows: list[tuple[int, int]], color: Mapping[int, _ImageCheck], depth: Mapping[int, _ImageCheck]
) -> Iterator[PictureSample]:
    """The rows of which both pictures were kept."""
    for row, (i, j) in enumerate(rows):
        gray, counts = color[i].kept, depth[j].kept
        if gray is not None and counts is not None:
            yield PictureSample(row, gray[0], counts[0], gray[1], counts[1])


def _selected(color: ImageStream, every: int, start_s: float, stop_s: float | None) -> Int64[np.ndarray, "F"]:
    """Indices of the color pictures that are asked for."""
    since = color.time_s - color.time_s[0]
    return np.flatnonzero((since >= start_s) & (since <= (np.inf if stop_s is None else stop_s)))[::every]


def _look(
    stream: ImageStream, index: int, judge: Callable[[np.ndarray], _ImageCheck], keep: bool = False
) -> _ImageCheck:
    """Decode one picture and judge it; kept is one that is good."""
    try:
        picture = stream.read(index)
        found = judge(picture)
        if not found.reason and min(picture.shape[:2]) < shrink_factor(picture):
            found = _ImageCheck(found.size, f"is {found.size[0]}x{found.size[1]}: too narrow to be of a camera")
        if not keep or found.reason:
            return found
        small = small_gray(picture) if picture.ndim == 3 else small_depth(picture)
        return replace(found, kept=(small, shrink_factor(picture)))
    except BadImage as error:
        return _ImageCheck((0, 0), str(error))


def _look_at_color(picture: np.ndarray) -> _ImageCheck:
    """Color is judged by its size."""
    if picture.ndim != 3 or picture.shape[2] != 3 or picture.dtype != np.uint8:
        return _ImageCheck((0, 0), f"is {picture.dtype} {picture.shape}, color is uint8 (height, width, 3)")
    return _ImageCheck((picture.shape[1], picture.shape[0]), digest=digest(picture))


def _look_at_depth(counts: np.ndarray) -> _ImageCheck:
    """Depth is judged by its size and readings."""
    if counts.ndim != 2 or counts.dtype.kind not in "iuf":
        return _ImageCheck((0, 0), f"is {counts.dtype} {counts.shape}, depth is numbers (height, width)")
    readings = counts[counts > 0]
    readings = readings[np.isfinite(readings)]
    size = counts.shape[1], counts.shape[0]
    if not readings.size:
        return _ImageCheck(size, "has no depth reading at all")
    median = float(np.median(readings[:: max(1, readings.size // 4096)]))
    return _ImageCheck(size, median=median, digest=digest(counts))


def _usual_size(needs_frame: Iterable[_ImageCheck]) -> Size:
    """The most frequent size of pictures that could be decoded."""
    sizes = Counter(look.size for look in needs_frame if look.size != (0, 0))
    return sizes.most_common(1)[0][0] if sizes else (0, 0)


def _fault(name: str, look: _ImageCheck, usual: Size) -> BadFrame | None:
    """What is wrong with a picture; None if nothing is."""
    if look.reason:
        return BadFrame(name, look.reason)
    if look.size != usual:
        return BadFrame(name, f"is {look.size[0]}x{look.size[1]}, the others are {usual[0]}x{usual[1]}")
    return None


def _stale(name: str, off_state: Mapping[str, np.ndarray], k: int, max_state_s: Mapping[str, float]) -> BadFrame | None:
    """What is wrong where no sample of robot state is near enough; None if one is."""
    for stream, off in off_state.items():
        if off[k] > max_state_s[stream]:
            return BadFrame(name, f"no {stream} within {_ms(max_state_s[stream])}: the nearest is {_ms(off[k])} away")
    return None


def _half(stream: ImageStream | SampleStream) -> float:
    """Half an interval of a stream, and as much more as intervals vary [s]; farther away is another frame's."""
    steps = np.diff(stream.time_s)
    steps = steps[steps > 0]
    # Not the median: where a third of the frames is lost, that is two of them.
    return _NEAR * float(np.quantile(steps, 0.2)) if len(steps) else np.inf


def _ms(seconds: float) -> str:
    """Seconds in words."""
    return f"{1000 * seconds:.0f} ms"


def align_samples(
    samples: tuple[SampleStream, ...],
    clock: Float64[np.ndarray, "T"],
    pick: Callable[[np.ndarray, np.ndarray], np.ndarray],
) -> np.ndarray:
    """Values (T, D) float32 of several streams at every instant; D = 0 where there are none."""
    parts = [s.values[pick(clock, s.time_s)] for s in samples]
    return np.concatenate([np.empty((len(clock), 0), np.float32), *parts], axis=1)
