"""Pictures that come again while time goes on: a camera that froze, or one that is slower than its recorder."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float64, Int64, Num

from flowlab.recordings.base import ImageStream, Streams
from flowlab.recordings.content import PictureDigest, change_between, has_noise, is_equal, runs
from flowlab.recordings.stale import encoded_anew, older_pictures, repeated_parts
from flowlab.recordings.verdicts import Check, Verdict

_RUN = 3
"""So many equal pictures in a row are no accident."""
_MANY = 0.1
"""Share of pictures that may equal the one before, as cameras give one twice now and then."""
_JUMP = 2.5
"""A camera that stood still is told by this many times the usual change after it."""
_MOVED = 0.05
"""A robot moved where a number of its state changed by this share of its range."""
_OVER_NOISE = 1.5
"""Pictures with noise show motion where they change by this many times what is usual."""
_NOISY = (0.3, 0.7)
"""Noise changes this share of the pixels from picture to picture, in this share of the pairs."""
_ALL_OVER = 0.5
"""A camera that moves changes this share of the pixels."""
_AT_ONCE = 0.5
"""It stops at once where the last change is more than this share of what is usual."""
_NEARLY = 0.02
"""Pictures with noise that differ in less than this share of the pixels are one, as where a clock is drawn over it."""
_FEWEST = 4
"""So many different pictures tell whether they have noise."""
_STEADY = (0.95, 5)
"""Share of the new pictures that come as evenly as whole pictures can, and how many repeats tell that."""
_SLOWER = 1.15
"""A camera that gives a new picture every so many rows is slower than its recorder."""


@dataclass(frozen=True)
class _Pictures:
    """The pictures of one stream at all rows."""

    stream: ImageStream
    index: Int64[np.ndarray, "T"]
    """Of the picture of each row."""
    kept: tuple[PictureDigest, ...]

    @cached_property
    def equal(self) -> Bool[np.ndarray, "N"]:
        """Whether each but the first equals the one before bit by bit."""
        return np.array([is_equal(a, b) for a, b in pairwise(self.kept)], bool)

    @cached_property
    def noisy(self) -> bool:
        """Whether no two pictures are the same, however still the scene is."""
        new = np.concatenate([[True], ~self.equal])
        return has_noise(np.array([k.small.ravel() for k in self.kept], np.float32)[new])

    @cached_property
    def same(self) -> Bool[np.ndarray, "N"]:
        """Whether each but the first is the one before it."""
        nearly = [self.noisy and (a.small != b.small).mean() < _NEARLY for a, b in pairwise(self.kept)]
        return self.equal | np.array(nearly, bool)

    @cached_property
    def change(self) -> Float64[np.ndarray, "N"]:
        """How much has changed since the picture before, of each but the first."""
        return np.array([change_between(a, b) for a, b in pairwise(self.kept)], np.float64)

    def froze(self, first: int, last: int) -> bool:
        """Whether a run of the same pictures is none of a scene that stands still, by itself."""
        usual = np.delete(self.change, last) if last < len(self.change) else self.change
        usual = usual[usual > 0]
        jumped = last < len(self.change) and len(usual) > 0 and self.change[last] > _JUMP * np.median(usual)
        return self.noisy or bool(jumped and last - first + 1 >= _RUN)

    def moved(self, first: int, last: int) -> bool:
        """Whether there is motion between two rows, noise aside."""
        if self.same[first:last].all():
            return False
        usual = np.median(self.change[~self.same])
        return not self.noisy or change_between(self.kept[first], self.kept[last]) > _OVER_NOISE * usual

    def stopped_at_once(self, first: int, last: int) -> bool:
        """Whether a run follows pictures that changed all over, as of a camera that moves, which did not slow down."""
        new = self.change[~self.same]
        beside = [*self.change[max(0, first - 1) : first], *self.change[last : last + 1]]
        if last - first + 1 < _RUN or len(new) < _FEWEST or not beside:
            return False
        differ = [(a.small != b.small).mean() >= _ALL_OVER for a, b in pairwise(self.kept)]
        moving = np.array(differ)[~self.same].mean() >= _NOISY[1]
        return bool(moving and min(beside) > _AT_ONCE * np.median(new))

    @cached_property
    def cadence(self) -> float | None:
        """Rows for each new picture, where these come steadily but more rarely than rows; None where not."""
        every = np.diff(np.flatnonzero(np.concatenate([[True], ~self.same])))
        if len(runs(self.same)) < _STEADY[1]:
            return None
        steady = every[np.isin(every, np.floor(every.mean()) + np.arange(2))]
        slower = len(steady) >= _STEADY[0] * len(every) and steady.mean() >= _SLOWER
        return float(steady.mean()) if slower else None

    def name(self, row: int) -> str:
        """Of the picture of a row."""
        return self.stream.names[int(self.index[row])]


def find_repeats(
    streams: Streams,
    color: Mapping[int, PictureDigest],
    depth: Mapping[int, PictureDigest],
    rows: Int64[np.ndarray, "T 2"],
    state: Num[np.ndarray, "T S"],
    *,
    rendered: bool = False,
) -> tuple[dict[int, str], Check]:
    """Rows whose picture is that of a row before, while time went on, and what to say of it.

    A scene that stands still may give equal pictures where they have no noise, as from a renderer or a video. So a run
    of them froze only on proof: other pictures of the stream differ everywhere by noise, the other stream or the
    robot moved, or there is a jump after it.

    Args:
        streams: The recording.
        color: What is kept of color pictures, by index.
        depth: Likewise of depth pictures.
        rows: Indices of the color and depth picture of every row that is good otherwise.
        state: What the robot was at each.
        rendered: Whether pictures are said to be rendered; that is believed of streams without noise.

    Returns:
        The reason of every row that is bad, by its place in ``rows``; and the check.
    """
    if len(rows) < 2:
        return {}, Check("repeats", Verdict.OK, "no picture froze")
    seen = (
        _Pictures(streams.color, rows[:, 0], tuple(color[int(c)] for c in rows[:, 0])),
        _Pictures(streams.depth, rows[:, 1], tuple(depth[int(d)] for d in rows[:, 1])),
    )
    bad: dict[int, str] = {}
    named: dict[int, str] = {}
    still: set[int] = set()
    at_once: set[int] = set()
    for one, other in (seen, seen[::-1]):
        for first, last in runs(one.same):
            if rendered and not one.noisy:
                still.update(range(first + 1, last + 1))
                continue
            proven = one.froze(first, last) or other.moved(first, last) or _robot_moved(state, first, last)
            again = range(first + 1, last + 1)
            if proven and (last - first + 1 >= _RUN or one.cadence is not None):
                whose = "" if one is seen[0] else "its depth picture "
                bad.update(dict.fromkeys(again, whose + _why(one, first, last)))
            elif proven:
                named.update({k: one.name(k) for k in again})
            else:
                (at_once if one.stopped_at_once(first, last) else still).update(again)
    doubts: list[str] = []
    for name, one, other in zip(("color", "depth"), seen, seen[::-1], strict=True):
        older = older_pictures(one.kept, one.noisy, one.change)
        whose = "" if one is seen[0] else "its depth picture "
        bad |= {k: f"{whose}equals {one.name(k0)} bit by bit, and others lie between: an older picture came again"
                for k, k0 in older.items() if k not in bad}  # fmt: skip
        doubts += _stale(name, one, other, {*older, *(np.flatnonzero(one.same) + 1).tolist()})
    return bad, _check(
        bad, {k: n for k, n in named.items() if k not in bad}, still - {*bad, *named, *at_once}, at_once - {*bad},
        doubts, seen, rendered=rendered,
    )  # fmt: skip


def _stale(name: str, pictures: _Pictures, other: _Pictures, told: set[int]) -> Iterator[str]:
    """What is doubtful of the pictures of a stream that have noise, and are not the same as a whole."""
    skip = np.isin(np.arange(len(pictures.kept)), list(told))
    parts = repeated_parts(pictures.kept, skip) if pictures.noisy else {}
    if parts:
        share = float(np.median(list(parts.values())))
        yield (f"in {len(parts)} {name} pictures, from {pictures.name(min(parts))} on, {share:.0%} of each is "
               "that of an earlier one bit by bit, though it has noise: a part froze, or buffers tore")  # fmt: skip
        return
    again = [
        run for run in encoded_anew(pictures.kept, other.kept) if not told.issuperset(range(run[0] + 1, run[1] + 1))
    ]
    if again:
        first, last = pictures.name(again[0][0]), pictures.name(again[-1][1])
        yield (f"{name} changes from {first} to {last} by far less than the noise of the other pictures: one may have "
               "been encoded again and again")  # fmt: skip


def _check(
    bad: Mapping[int, str],
    named: Mapping[int, str],
    still: set[int],
    at_once: set[int],
    doubts: Sequence[str],
    seen: tuple[_Pictures, _Pictures],
    *,
    rendered: bool,
) -> Check:
    """What came of looking for repeats."""
    rows = len(seen[0].kept)
    says = f"{len(bad)} rows are of a picture that froze or came again" if bad else "no picture froze"
    if named:
        says += f"; {len(named)} pictures equal the one before: {', '.join(list(named.values())[:3])}"
    if still:
        why = ", and have no noise, as rendered ones do" if rendered else (
            " while nothing else moved, as in a scene that stands still")  # fmt: skip
        says += f"; {len(still)} equal the one before{why}"
    if at_once:
        says += (
            f"; {len(at_once)} equal the one before, from {seen[0].name(min(at_once))} on, and next to them everything "
        )
        says += "moves: the camera froze, or stopped at once"
    slow = [p for p in seen if p.cadence is not None]
    for name, p in zip(("color", "depth"), seen, strict=True):
        says += f"; {name}: {_slower(p)}" if p.cadence is not None else ""
    says = "; ".join([says, *doubts])
    many = bool(bad) or bool(slow) or bool(at_once) or bool(doubts) or len(named) > _MANY * rows
    return Check("repeats", Verdict.DOUBTFUL if many else Verdict.ASSUMED if still or named else Verdict.OK, says)


def _why(pictures: _Pictures, first: int, last: int) -> str:
    """Why a row is bad."""
    exactly = "equals" if pictures.equal[first:last].all() else "but for a few pixels equals"
    same = f"{exactly} {pictures.name(first)} bit by bit"
    if pictures.cadence is not None:
        return f"{same}: {_slower(pictures)}"
    return f"{same}, as {last - first + 1} in a row do: it froze"


def _slower(pictures: _Pictures) -> str:
    """That the camera is slower than its recorder, and what to do."""
    every = pictures.cadence or 1.0
    step_s = float(np.median(np.diff(pictures.stream.time_s[pictures.index])))
    rate = f"a new picture comes every {every:.3g} rows, about {1 / (every * step_s):.3g} a second" if step_s else ""
    if abs(every - round(every)) < 1 / len(pictures.kept):
        return f"{rate}; '--set recording.every={round(every)}' takes each once"
    return f"{rate}; '--set recording.max_bad_share={1 - 1 / every + 0.05:.2f}' leaves out those that come again"


def _robot_moved(state: Num[np.ndarray, "T S"], first: int, last: int) -> bool:
    """Whether the state changed while the picture did not."""
    reach = np.ptp(state, axis=0) if state.shape[1] else np.zeros(0)
    return bool((np.ptp(state[first : last + 1], axis=0)[reach > 0] > _MOVED * reach[reach > 0]).any())
