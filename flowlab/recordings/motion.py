"""Offsets between streams as their motion tells: when pictures change, and when the robot moves."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from flowlab.recordings.sync import common_clock
from flowlab.recordings.verdicts import Check, Verdict

FEWEST = 20
"""So many instants are needed to tell an offset."""
_UNEVEN = 0.3
"""Motion tells where it varies by this share of its mean."""
_LIKE = 0.8
"""Correlation of two motions that are one."""
_MARGIN = 0.2
"""By so much the correlation at an offset exceeds that without it, or the offset is none."""
_SURE = (0.9, 0.4)
"""Correlation and margin beyond which there is no doubt."""
FARTHEST_S = 3.0
"""Greatest offset that is tried."""


@dataclass(frozen=True, slots=True)
class Motion:
    """How much changed from one instant to the next."""

    name: str
    time_s: Float64[np.ndarray, "N"]
    """Halfway between the two."""
    speed: Float64[np.ndarray, "N"]

    @classmethod
    def make(cls, name: str, time_s: Float64[np.ndarray, "T"], change: Float64[np.ndarray, "N"]) -> "Motion":
        """Of the change between consecutive instants, N = T - 1."""
        step = np.diff(time_s)
        return cls(name, time_s[1:] - step / 2, change / np.maximum(step, 1e-6))


@dataclass(frozen=True, slots=True)
class Offset:
    """How much later one stream moves than another."""

    later_s: float
    """0 where they go together."""
    correlation: float
    """Correlation of the two motions at that offset."""
    without: float
    """The same without it."""
    told: bool
    """Whether the two are one motion; else nothing is known."""
    sure: bool
    """Whether there is no doubt that it is not 0."""
    periodic: bool = False
    """Whether others fit about as well, as of what goes on periodically."""


def find_offset(pictures: Motion, other: Motion) -> Offset | None:
    """How much later another stream moves than the color pictures, by how much each does at a time; None where too
    little moves to tell."""
    if min(len(pictures.time_s), len(other.time_s)) < FEWEST:
        return None
    step = float(np.median(np.diff(pictures.time_s)))
    clock = common_clock([pictures.time_s, other.time_s], step, FARTHEST_S)
    if len(clock) < FEWEST:
        return None
    series = [_on(clock, m) for m in (pictures, other)]
    if any(np.std(s) < _UNEVEN * np.mean(s) or not np.std(s) for s in series):
        return None
    farthest = int(min(FARTHEST_S / step, len(clock) / 3))
    lags = np.arange(-farthest, farthest + 1)
    like = np.array([_correlation(series[0], series[1], int(lag)) for lag in lags])
    best = int(np.argmax(like))
    most, margin = float(like[best]), float(like[best] - like[farthest])
    is_one = margin >= _MARGIN
    sure = is_one and most >= _SURE[0] and margin >= _SURE[1]
    return Offset(float(lags[best] * step) if is_one else 0.0, most, most - margin, most >= _LIKE, sure)


def check_offset(name: str, offset: Offset | None, key: str, stated: float | None, *, refusable: bool = False) -> Check:
    """Whether another stream moves when the color pictures do. The offset is only reported, never applied.

    Args:
        name: Of the other stream.
        offset: How much later it moves; None where too little does to tell.
        key: What the user writes to add to its times.
        stated: What the user has written there [s]; None where nothing was said.
        refusable: Whether an offset without doubt is refused.
    """
    about = f"motion of {name}"
    if offset is None:
        return Check(about, Verdict.ASSUMED, "too little motion to tell an offset from color, so it is taken as none")
    if not offset.told:
        like = f"correlation {offset.correlation:.2f}, {offset.without:.2f} without one"
        return Check(about, Verdict.ASSUMED, f"tells no offset from color ({like}), so it is taken as none")
    if not offset.later_s:
        return Check(about, Verdict.OK, f"goes with that of color (correlation {offset.correlation:.2f})")
    when = "after" if offset.later_s > 0 else "before"
    says = (f"{abs(offset.later_s):.2f} s {when} that of color (correlation {offset.correlation:.2f}, "
            f"{offset.without:.2f} without it)")  # fmt: skip
    if offset.periodic:
        says += "; what moves does so periodically, and other offsets fit about as well"
    if stated is not None:
        says += f", with '{key}: {stated:g}' added, which is taken as it is written"
        verdict = Verdict.DOUBTFUL if stated else Verdict.ASSUMED  # 0 is the answer to what is asked below
        return Check(about, verdict, f"{says}; '{key}: {stated - offset.later_s:.3g}' would make them go together")
    write = f"if their clocks differ, write '{key}: {-offset.later_s:.3g}', else '{key}: 0'"
    return Check(about, Verdict.REFUSED if offset.sure and refusable else Verdict.DOUBTFUL, f"{says}; {write}")


def _on(clock: Float64[np.ndarray, "T"], motion: Motion) -> Float64[np.ndarray, "T"]:
    """A motion at every instant; what flickers more than the rest counts no more than it."""
    speed = np.interp(clock, motion.time_s, motion.speed)
    return np.minimum(speed, np.quantile(speed, 0.95))


def _correlation(one: Float64[np.ndarray, "T"], other: Float64[np.ndarray, "T"], lag: int) -> float:
    """Of one with the other ``lag`` steps later."""
    a = one[max(0, -lag) : len(one) - max(0, lag)]
    b = other[max(0, lag) : len(other) - max(0, -lag)]
    return float(np.corrcoef(a, b)[0, 1]) if np.std(a) > 0 and np.std(b) > 0 else 0.0
