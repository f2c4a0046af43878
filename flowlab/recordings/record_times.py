"""Stamps against the times of recording: whether streams are from one clock, and which clock is taken."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float64

from flowlab.recordings.recording_yaml import Metadata
from flowlab.recordings.stamps import Timing
from flowlab.recordings.verdicts import Check, Verdict

DOUBTFUL_S = 0.05
"""Streams this far apart, by their stamps against the times of recording, may be from two clocks."""
REFUSED_S = 0.15
"""Streams this far apart are: no transport takes so long for one of them."""
OTHER_CLOCK_S = 10.0
"""Stamps this far from the others count from another instant, such as that in which a camera was switched on."""
_AROUND = 20
"""A clock that is set changes the lag of all messages after it, of which so many are looked at, and before it."""
_FEWEST = 3
_EVEN = 0.25
"""They lag alike: within this share of the change."""
_RATE = 0.02
"""A lag that changes by this share of the time is that of a clock which runs at another rate."""
Stamped = Mapping[str, tuple[Float64[np.ndarray, "N"], Timing, str]]
"""Stamps of every stream [s], what is known of them, and the key with which the user says how it belongs to color."""


@dataclass(frozen=True, slots=True)
class _Fault:
    """What speaks against the stamps, or for two clocks."""

    size_s: float
    says: str
    write: str = ""
    """What to write, beside ``clock``."""
    stated: bool = False
    """Whether the user says of this stream how it belongs to color."""


def choose_clock(streams: Stamped, known: Metadata) -> tuple[bool, tuple[Check, ...]]:
    """Whether the times of recording are to be taken, and what came of comparing the stamps with them.

    Args:
        streams: The streams, color first, in the order of recording; what the user says to add to them is added.
        known: What the user says.
    """
    lags = {name: lag for name, (stamps, timing, _) in streams.items() if (lag := _lag(stamps, timing)) is not None}
    if not lags:
        return False, ()
    if known.clock == "recorded":
        return True, (Check("record times", Verdict.OK, "the times of recording are taken, as 'clock: recorded' says"),)
    middle = {name: _typical(lag) for name, lag in lags.items()}
    says = f"recorded after their stamps by {', '.join(f'{_ms(m)} ({name})' for name, m in middle.items())}"
    if known.clock == "stamps":
        return False, (Check("record times", Verdict.OK, f"{says}; the stamps are right, as 'clock: stamps' says"),)
    if max(middle.values()) - min(middle.values()) > OTHER_CLOCK_S:
        return True, (Check("record times", Verdict.ASSUMED, f"stamps are from another clock ({says}), so the times "
                            "of recording are taken"),)  # fmt: skip
    faults = [*_set(streams, lags), *_offsets(streams, middle, known), *_drifts(streams, lags)]
    if not faults and min(middle.values()) < -DOUBTFUL_S:
        says += "; nothing is recorded before it is taken, so their clock is ahead of the recorder's"
        return False, (Check("record times", Verdict.ASSUMED, says),)
    return False, (_judge(says, faults),)


def was_set_back(stamps: Float64[np.ndarray, "N"], recorded_s: Float64[np.ndarray, "N"]) -> bool:
    """Whether stamps that step back are of a clock that was set back, and not of messages that overtake others.

    A message that was overtaken is late, and those after it are not; a clock that was set back makes all late.

    Args:
        stamps: In the order of recording [s].
        recorded_s: When each was recorded.
    """
    lag = recorded_s - stamps
    back = np.flatnonzero(np.diff(stamps) < 0)
    usual = float(np.median(np.diff(np.sort(stamps))))
    least = 0.5 * max(usual, 1e-9)
    for_good = any(_shift(lag, int(i)) > least and len(lag) - i > 2 for i in back)
    return for_good or any(abs(size) > least for size, _, _ in _set_and_reset(lag, recorded_s, least))


def _set_and_reset(
    lag: Float64[np.ndarray, "N"], recorded_s: Float64[np.ndarray, "N"], least_s: float
) -> Iterator[tuple[float, int, int]]:
    """By how much a clock was set for a while, and the last message before, and the last of these.

    Messages that are overtaken, or wait in a queue, are not late by the same amount one after the other.
    """
    usual = float(np.median(np.diff(recorded_s))) if len(lag) > 1 else 0.0
    even = np.abs(np.diff(recorded_s) - usual) < 0.5 * np.maximum(np.abs(np.diff(lag)), 1e-9)
    jumps = np.flatnonzero((np.abs(np.diff(lag)) > least_s) & even)
    varies = float(np.subtract(*np.quantile(lag, (0.75, 0.25)))) if len(lag) else 0.0
    for i, j in pairwise(jumps.tolist()):
        there, back, meanwhile = lag[i + 1] - lag[i], lag[j + 1] - lag[j], lag[i + 1 : j + 1]
        unusual = len(meanwhile) > 1 and abs(np.median(meanwhile) - np.median(lag)) > abs(there) / 2
        if unusual and max(abs(there + back), np.ptp(meanwhile), varies) < _EVEN * abs(there):
            yield float(there), i, j


def _lag(stamps: Float64[np.ndarray, "N"], timing: Timing) -> Float64[np.ndarray, "N"] | None:
    """How long after its stamp each was recorded [s], 0 without stamps; None where times of recording are missing."""
    if timing.recorded_s is None:
        return None
    return timing.recorded_s - stamps if np.isfinite(stamps).all() else np.zeros(len(stamps))


def _typical(lag: Float64[np.ndarray, "N"]) -> float:
    """How long it took without waiting: transport only adds."""
    return float(np.quantile(lag, 0.1)) if len(lag) else 0.0


def _around(lag: Float64[np.ndarray, "N"], at: int) -> tuple[Float64[np.ndarray, "_"], Float64[np.ndarray, "_"]]:
    """The lags up to an index, and those after it."""
    return lag[max(0, at + 1 - _AROUND) : at + 1], lag[at + 1 : at + 1 + _AROUND]


def _shift(lag: Float64[np.ndarray, "N"], at: int) -> float:
    """By how much the lag is another one after an index than before it [s]."""
    before, after = _around(lag, at)
    return float(np.median(after) - np.median(before))


def _set(streams: Stamped, lags: Mapping[str, Float64[np.ndarray, "N"]]) -> Iterator[_Fault]:
    """Clocks that were set while recording: the stamps jump where the times of recording do not, and stay there."""
    for name, lag in lags.items():
        recorded_s = streams[name][1].recorded_s
        if recorded_s is None or len(lag) < 2 * _FEWEST:
            continue
        jumped = np.flatnonzero(_stamps_jump(lag, recorded_s))
        sizes = [(abs(_shift(lag, int(i))), int(i)) for i in jumped if _is_steady(lag, int(i))]
        size, at = max(sizes, default=(0.0, 0))
        for_a_while = [found for found in _set_and_reset(lag, recorded_s, DOUBTFUL_S) if abs(found[0]) > size]
        if for_a_while:
            by, start, stop = max(for_a_while, key=lambda found: abs(found[0]))
            way = "back" if by > 0 else "forward"
            yield _Fault(abs(by), f"the clock of {name} was set {way} by {_ms(abs(by))} for the entries {start + 2} to "
                         f"{stop + 1}: the stamps jump there, the times of recording do not")  # fmt: skip
        elif size > DOUBTFUL_S:
            way = "back" if _shift(lag, at) > 0 else "forward"
            yield _Fault(size, f"the clock of {name} was set {way} by {_ms(size)} at entry {at + 2}: the stamps jump "
                         "there, the times of recording do not")  # fmt: skip


def _stamps_jump(lag: Float64[np.ndarray, "N"], recorded_s: Float64[np.ndarray, "N"]) -> Bool[np.ndarray, "_"]:
    """Where the lag changes, and not because nothing was recorded for a while."""
    steps, change = np.diff(recorded_s), np.diff(lag)
    usual = float(np.median(steps))
    return (np.abs(change) > DOUBTFUL_S) & (np.abs(steps - usual) < 0.5 * np.abs(change))


def _is_steady(lag: Float64[np.ndarray, "N"], at: int) -> bool:
    """Whether messages lag alike before an index, and after it, so that it is no queue that grows or is emptied."""
    size, parts = abs(_shift(lag, at)), _around(lag, at)
    return all(len(p) >= _FEWEST and np.subtract(*np.quantile(p, (0.75, 0.25))) < _EVEN * size for p in parts)


def _offsets(streams: Stamped, middle: Mapping[str, float], known: Metadata) -> Iterator[_Fault]:
    """Streams whose clock is not that of color."""
    first = middle.get("color", 0.0)
    for name, lag in middle.items():
        off = lag - first
        if abs(off) > DOUBTFUL_S:
            key = streams[name][2]
            # One offset is for state and actions: it cannot be right for both where these differ.
            of_key = [lag for other, lag in middle.items() if streams[other][2] == key]
            one = max(of_key) - min(of_key) <= DOUBTFUL_S
            stated = one and key in known.model_fields_set
            total = off + (getattr(known, key) or 0.0)
            says = f"the clock of {name} is {_ms(abs(off))} {'behind' if off > 0 else 'ahead of'} that of color"
            says += f", with '{key}: {getattr(known, key):g}' added" if stated else ""
            yield _Fault(abs(off), says, f"'{key}: {total:.3g}'" if one else "", stated)


def _drifts(streams: Stamped, lags: Mapping[str, Float64[np.ndarray, "N"]]) -> Iterator[_Fault]:
    """Streams whose lag changes from their first quarter to their last, and others' does not; or any, by much."""
    changes = {name: _change(lag) for name, lag in lags.items()}
    least = min(changes.values(), key=abs)
    for name, change in changes.items():
        recorded_s = streams[name][1].recorded_s
        took_s = float(np.ptp(recorded_s)) if recorded_s is not None and len(recorded_s) else 0.0
        # Where the recorder's clock is set, or a queue fills at once, the lag of all changes in one step.
        steadily = np.abs(np.diff(lags[name])).max(initial=0.0) < abs(change) / 2
        by_itself = steadily and abs(change) > max(REFUSED_S, _RATE * took_s)
        size = max(abs(change - least), REFUSED_S if by_itself else 0.0)
        if size > DOUBTFUL_S and not any(_set({name: streams[name]}, {name: lags[name]})):
            yield _Fault(
                size, f"the stamps of {name} drift or jump by {_ms(abs(change))} against the times of recording"
            )


def _change(lag: Float64[np.ndarray, "N"]) -> float:
    """By how much a lag changes from its first quarter to its last [s]."""
    part = max(len(lag) // 4, 1)
    return _typical(lag[-part:]) - _typical(lag[:part])


def _judge(says: str, faults: list[_Fault]) -> Check:
    """The verdict on what was found."""
    if not faults:
        return Check("record times", Verdict.OK, says)
    says = "; ".join([says, *(f.says for f in faults)])
    open_ = [f for f in faults if not f.stated]
    if not open_:
        verdict = Verdict.DOUBTFUL if max(f.size_s for f in faults) > REFUSED_S else Verdict.ASSUMED
        return Check("record times", verdict, f"{says}, which is taken as it is written")
    write = "write 'clock: recorded' to take the times of recording"
    wanted = dict.fromkeys(f.write for f in open_ if f.write)
    only_offsets = all(f.write for f in open_)
    write += f", or {' and '.join(wanted)}, the seconds to add to the stamps" if wanted and only_offsets else ""
    verdict = Verdict.REFUSED if max(f.size_s for f in open_) > REFUSED_S else Verdict.DOUBTFUL
    return Check("record times", verdict, f"{says}; {write}; 'clock: stamps' if the stamps are right")


def _ms(seconds: float) -> str:
    """Seconds in words."""
    return f"{1000 * seconds:.0f} ms" if abs(seconds) < 10 else f"{seconds:.4g} s"
