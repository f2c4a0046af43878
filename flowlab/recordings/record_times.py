"""Stamps against the times of recording: whether streams are from one clock, and which clock is taken."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float64

from flowlab.recordings.metadata import Metadata
from flowlab.recordings.stamps import Timing
from flowlab.recordings.verdicts import Check, Verdict

DOUBTFUL_S = 0.05
"""Streams this far apart, by their stamps against the times of recording, may be from two clocks."""
REFUSED_S = 0.15
"""Streams this far apart are: no transport takes so long for one of them."""
OTHER_CLOCK_S = 10.0
"""Stamps this far from the others count from another instant, such as that in which a camera was switched on."""
Stamped = Mapping[str, tuple[Float64[np.ndarray, "N"], Timing]]
"""Stamps of every stream [s], and what is known of them."""


def choose_clock(streams: Stamped, known: Metadata) -> tuple[bool, tuple[Check, ...]]:
    """Whether the times of recording are to be taken, and what came of comparing the stamps with them.

    Args:
        streams: The streams; what the user says to add to them is added.
        known: What the user says.
    """
    lags = {name: lag for name, (stamps, timing) in streams.items() if (lag := _lag(stamps, timing)) is not None}
    if not lags:
        return False, ()
    if known.clock == "recorded":
        return True, (Check("record times", Verdict.OK, "the times of recording are taken, as 'clock: recorded' says"),)
    middle = {name: _typical(lag) for name, lag in lags.items()}
    apart = max(middle.values()) - min(middle.values())
    says = f"recorded after their stamps by {', '.join(f'{_ms(m)} ({name})' for name, m in middle.items())}"
    stated = known.clock == "stamps"
    if apart > OTHER_CLOCK_S and not stated:
        return True, (Check("record times", Verdict.ASSUMED, f"stamps are from another clock ({says}), so the times "
                            "of recording are taken"),)  # fmt: skip
    drift, late = _drift(lags)
    worst = max(apart, drift)
    if drift > max(apart, DOUBTFUL_S):
        says += f"; the stamps of {late} drift or jump by {_ms(drift)} against the times of recording"
    if worst <= DOUBTFUL_S or stated or "state_offset_s" in known.model_fields_set:
        verdict = Verdict.OK if worst <= DOUBTFUL_S or stated else Verdict.ASSUMED
        return False, (Check("record times", verdict, says),)
    write = "if they are from two clocks, write 'clock: recorded' to take the times of recording"
    if "state" in middle and drift <= apart:
        write += f", or 'state_offset_s: {middle['state'] - middle['color']:.3g}' for state whose clock is behind"
    verdict = Verdict.REFUSED if worst > REFUSED_S else Verdict.DOUBTFUL
    return False, (Check("record times", verdict, f"{says}; {write}; 'clock: stamps' if the stamps are right"),)


def _lag(stamps: Float64[np.ndarray, "N"], timing: Timing) -> Float64[np.ndarray, "N"] | None:
    """How long after its stamp each was recorded [s], 0 without stamps; None where times of recording are missing."""
    if timing.recorded_s is None:
        return None
    return timing.recorded_s - stamps if np.isfinite(stamps).all() else np.zeros(len(stamps))


def _typical(lag: Float64[np.ndarray, "N"]) -> float:
    """How long it took without waiting: transport only adds."""
    return float(np.quantile(lag, 0.1)) if len(lag) else 0.0


def _drift(lags: Mapping[str, Float64[np.ndarray, "N"]]) -> tuple[float, str]:
    """By how much the lag of a stream changes from its first quarter to its last, others' less, and that stream."""
    changes: dict[str, float] = {}
    for name, lag in lags.items():
        part = max(len(lag) // 4, 1)
        changes[name] = _typical(lag[-part:]) - _typical(lag[:part])
    usual = float(np.median(list(changes.values())))
    late = max(changes, key=lambda name: abs(changes[name] - usual))
    return max(changes.values()) - min(changes.values()), late


def _ms(seconds: float) -> str:
    """Seconds in words."""
    return f"{1000 * seconds:.0f} ms" if abs(seconds) < 10 else f"{seconds:.4g} s"
