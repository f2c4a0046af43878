"""Offsets between streams as their motion tells: when pictures change, and when the robot moves."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from flowlab.recordings.verdicts import Check, Verdict

_FEWEST = 20
"""So many instants are needed to tell an offset."""
_UNEVEN = 0.3
"""Motion tells where it varies by this share of its mean."""
_LIKE = 0.8
"""Correlation of two motions that are one."""
_MARGIN = 0.2
"""By so much the correlation at an offset exceeds that without it, or the offset is none."""
_SURE = (0.9, 0.4)
"""Correlation and margin beyond which there is no doubt."""
_FARTHEST_S = 3.0


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


def check_motion(pictures: Motion, other: Motion, stated: float | None) -> Check:
    """Whether another stream moves when the color pictures do. The offset is only reported, never applied.

    Args:
        pictures: Of the color pictures.
        other: Of the depth pictures, or of the robot.
        stated: What the user has added to the times of the other [s]; None where nothing was said.
    """
    about = f"motion of {other.name}"
    found = _offset(pictures, other)
    if found is None:
        return Check(about, Verdict.ASSUMED, "too little motion to tell an offset from color, so it is taken as none")
    offset_s, like, margin, step_s = found
    if like < _LIKE:
        says = f"not like that of color (correlation {like:.2f}), so it tells no offset, which is taken as none"
        return Check(about, Verdict.ASSUMED, says)
    if margin < _MARGIN or abs(offset_s) < 0.75 * step_s:
        return Check(about, Verdict.OK, f"goes with that of color (correlation {like:.2f})")
    when = "after" if offset_s > 0 else "before"
    says = f"{abs(offset_s):.2f} s {when} that of color (correlation {like:.2f}, {like - margin:.2f} without it)"
    key = "depth_offset_s" if other.name == "depth" else "state_offset_s"
    if stated is not None:
        says += f", with '{key}: {stated:g}' added, which is taken as it is written"
        verdict = Verdict.DOUBTFUL if stated else Verdict.ASSUMED  # 0 is the answer to what is asked below
        return Check(about, verdict, f"{says}; '{key}: {stated - offset_s:.3g}' would make them go together")
    sure = like >= _SURE[0] and margin >= _SURE[1] and other.name == "depth"
    write = f"if their clocks differ, write '{key}: {-offset_s:.3g}', else '{key}: 0'"
    return Check(about, Verdict.REFUSED if sure else Verdict.DOUBTFUL, f"{says}; {write}")


def _offset(one: Motion, other: Motion) -> tuple[float, float, float, float] | None:
    """How much later the other moves [s], the correlation there, its margin over none, and the step of the search."""
    if min(len(one.time_s), len(other.time_s)) < _FEWEST:
        return None
    step = float(np.median(np.diff(one.time_s)))
    start, stop = max(one.time_s[0], other.time_s[0]), min(one.time_s[-1], other.time_s[-1])
    clock = np.arange(start, stop, step)
    if len(clock) < _FEWEST or step <= 0:
        return None
    series = [_on(clock, m) for m in (one, other)]
    if any(np.std(s) < _UNEVEN * np.mean(s) or not np.std(s) for s in series):
        return None
    farthest = int(min(_FARTHEST_S / step, len(clock) / 3))
    lags = np.arange(-farthest, farthest + 1)
    like = np.array([_correlation(series[0], series[1], int(lag)) for lag in lags])
    best = int(np.argmax(like))
    return float(lags[best] * step), float(like[best]), float(like[best] - like[farthest]), step


def _on(clock: Float64[np.ndarray, "T"], motion: Motion) -> Float64[np.ndarray, "T"]:
    """A motion at every instant; what flickers more than the rest counts no more than it."""
    speed = np.interp(clock, motion.time_s, motion.speed)
    return np.minimum(speed, np.quantile(speed, 0.95))


def _correlation(one: Float64[np.ndarray, "T"], other: Float64[np.ndarray, "T"], lag: int) -> float:
    """Of one with the other ``lag`` steps later."""
    a = one[max(0, -lag) : len(one) - max(0, lag)]
    b = other[max(0, lag) : len(other) - max(0, -lag)]
    return float(np.corrcoef(a, b)[0, 1]) if np.std(a) > 0 and np.std(b) > 0 else 0.0
