"""The unit of stamps: stated by a standard or by the user, else decided by evidence, else asked for."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float64

from flowlab.errors import DataError

Unit = Literal["s", "ms", "us", "ns"]
StatedUnit = Literal["s", "ms", "us", "ns", "frames"]
"""What the user may say: also that numbers are those of frames."""
SECONDS: dict[str, float] = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
EPOCH_S = (1e9, 4e9)
"""Stamps that count from 1970 lie between these, the years 2001 and 2096 [s]."""
PICTURE_STEP_S = (1 / 240, 10.0)
"""What may lie between two pictures of a camera [s]."""
_USUAL_STEP_S = {"s": 0.26, "ms": 0.26, "us": 0.105, "ns": 0.105}
"""Longer steps are asked about where nothing but the step tells the unit: stamps may count ticks, of 100 ns or of
90 kHz, which would be slow pictures in the next unit."""
_LONGEST_S = EPOCH_S[1]
"""Stamps that count more, from whatever instant, are in another unit."""
_SAME = 0.02
"""Steps that are all whole multiples of one may be numbers of kept frames, unless a unit gives the rate as exactly."""
SAMPLE_STEP_S = (1 / 4000, 10.0)
"""What may lie between two samples of a robot [s]."""
_HUNDREDTHS = 100
"""A second has so many of them, which some write; at 60 pictures they step by 1 and 2, as a counter may."""
LARGEST_COUNT = 10
"""Numbers of frames of which at most every so many-th was kept; what steps farther counts something else."""
RATE_TOLERANCE = 0.25
"""A rate this share off another one contradicts it."""


class UnclearStamps(DataError):
    """Raised where a unit is not known or cannot be; the message says what was found and what to write."""


@dataclass(frozen=True, slots=True)
class Timing:
    """What a reader knows of the stamps of a stream, which it gives in the order in which the recording has them."""

    source: str = "the times"
    """What messages call the stamps, such as the file that they are from."""
    unit: Unit | None = "s"
    """None where neither a standard nor the layout says it: then it is decided by evidence."""
    custom: Unit | None = None
    """The unit that is the custom of the layout, where ``unit`` is None: taken unless the evidence is against it."""
    integers: bool = False
    """Whether they are written without a fraction, so that they may number frames."""
    names: bool = False
    """Whether they are numbers in the names of files, of which most number frames."""
    overtaking: bool = False
    """Whether parts may be recorded in another order than they were taken in, as messages may that overtake others."""
    recorded_s: Float64[np.ndarray, "N"] | None = None
    """When each was recorded, by the clock of the recorder [s]; stamps that are not finite are taken from here."""


IN_SECONDS = Timing()


def decide_unit(
    stamps: Float64[np.ndarray, "N"], timing: Timing, *, fps: float | None, stated: StatedUnit | None
) -> Unit | Literal["frames"]:
    """The unit of the stamps of pictures, or that they number frames.

    Args:
        stamps: They rise.
        timing: What the reader knows of them.
        fps: Pictures per second, where that is said.
        stated: The unit as the user says it.

    Raises:
        UnclearStamps: They may be several things, or are not what is said of them.
    """
    step = _step(stamps)
    if timing.unit is not None or stated is not None:
        unit: Unit | Literal["frames"] = timing.unit or stated or "s"
        if unit == "frames" and (fps is None or not timing.integers):
            why = "'fps' is not" if fps is None else f"{timing.source} are no whole numbers"
            raise UnclearStamps(f"'time_unit: frames' is said, but {why}; {_write(fps, False)}")
    else:
        unit = epoch_unit(stamps) or _by_step(stamps, timing, fps)
    if unit != "frames":
        _check_step(stamps, unit, timing)
        _check_rate(step, unit, timing, fps)
    return unit


def epoch_unit(stamps: Float64[np.ndarray, "N"]) -> Unit | None:
    """The unit in which stamps count from 1970; None where they do not."""
    for unit, seconds in SECONDS.items():
        if EPOCH_S[0] <= float(np.median(stamps)) * seconds <= EPOCH_S[1]:
            return unit  # type: ignore[return-value]
    return None


def rough_seconds(stamps: Float64[np.ndarray, "N"], timing: Timing, fps: float | None) -> Float64[np.ndarray, "_"]:
    """About when pictures were taken [s], to compare with before the unit is decided; nothing where that is open."""
    unit = timing.unit or epoch_unit(stamps)
    if unit is not None:
        return stamps * SECONDS[unit]
    return stamps / fps if fps is not None and timing.integers else np.empty(0)


def _step(stamps: Float64[np.ndarray, "N"]) -> float:
    """The usual step; nan for fewer than two stamps."""
    steps = np.diff(stamps)
    steps = steps[steps > 0]
    return float(np.median(steps)) if len(steps) else np.nan


def _units(step: float, bounds: tuple[float, float]) -> list[Unit]:
    """The units in which a step is plausible."""
    return [unit for unit, s in SECONDS.items() if bounds[0] * 0.999 <= step * s <= bounds[1]]  # type: ignore[misc]


def _by_step(stamps: Float64[np.ndarray, "N"], timing: Timing, fps: float | None) -> Unit | Literal["frames"]:
    """The unit in which a step is plausible, and agrees with ``fps``."""
    step = _step(stamps)
    numbers = timing.integers and not step > LARGEST_COUNT and _count_frames(stamps, fps)
    units: list[Unit | Literal["frames"]] = [
        u for u in _units(step, PICTURE_STEP_S) if np.max(np.abs(stamps)) * SECONDS[u] <= _LONGEST_S
    ]
    if fps is not None:
        kept = timing.integers and step > LARGEST_COUNT and _is_even(stamps, step)
        within = _SAME if kept else RATE_TOLERANCE
        units = [u for u in units if _agree(1 / (step * SECONDS[u]), fps, within)]
        # Where frame numbers over fps and a unit come to the same, it does not matter which they are.
        units = ["frames", *(u for u in units if not _agree(SECONDS[u], 1 / fps))] if numbers else units
    elif numbers or (timing.names and timing.integers and timing.custom is None):
        units = ["frames", *units]
    elif timing.custom in units:
        units = [timing.custom]
    sure = fps is not None or (units != ["frames"] and all(_is_usual(step, u) for u in units))
    if len(units) == 1 and sure:
        return units[0]
    raise UnclearStamps(_unclear(stamps, timing, fps, units))


def _count_frames(stamps: Float64[np.ndarray, "N"], fps: float | None) -> bool:
    """Whether steps are those of a counter: from one to the next, or all multiples of the least.

    Hundredths of a second step by 3, 3, 4 at 30 pictures a second; where every third is kept no step is 4.
    """
    steps = np.diff(stamps)
    least = steps[steps > 0].min(initial=np.inf)
    hundredths = fps is not None and steps.mean() > 1 + _SAME and _agree(_HUNDREDTHS / steps.mean(), fps, _SAME)
    even = bool(np.all(steps % least == 0))
    return even if least > 1 else not (hundredths and steps.max() <= least + 1)


def kept_every(stamps: Float64[np.ndarray, "N"]) -> int:
    """Of how many numbers of frames one was kept, by the usual step; 1 where they go on one by one."""
    steps = np.diff(stamps)
    steps = steps[steps > 0]
    return int(steps.min()) if len(steps) else 1


def _is_usual(step: float, unit: str) -> bool:
    """Whether pictures are taken so often that nothing but the unit is needed to believe it."""
    return unit in _USUAL_STEP_S and step * SECONDS[unit] <= _USUAL_STEP_S[unit]


def _is_even(stamps: Float64[np.ndarray, "N"], step: float) -> bool:
    """Whether all steps are whole multiples of the usual one."""
    return bool(np.all(np.diff(stamps) % step == 0))


def _unclear(stamps: Float64[np.ndarray, "N"], timing: Timing, fps: float | None, units: Sequence[str]) -> str:
    """Why the unit of stamps is not clear, and what to write."""
    step = _step(stamps)
    found = f"{timing.source} step by {step:g}{'' if fps is None else f' where fps is {fps:g}'}"
    rates = ["numbers of frames"] if "frames" in units else []
    steps = np.diff(stamps)
    if fps is not None and timing.integers and not rates and step <= LARGEST_COUNT:
        rates = [f"times in ticks, as steps from {steps.min():g} to {steps.max():g} are no whole number of frames"]
    elif fps is not None and timing.integers and not rates and step <= PICTURE_STEP_S[1] * fps:
        rates = [f"numbers of frames, of which every {step:g}th was kept ({fps / step:.3g} pictures a second)"]
    kept = bool(rates) and fps is not None
    rates += [f"{u} ({1 / (step * SECONDS[u]):.3g} pictures a second)" for u in units if u != "frames"]
    write = _write(fps, kept)
    if not rates:
        none = f"no plausible time in {_or(SECONDS)}, and no numbers of frames"
        return f"{found}: {none}; they may count ticks; {write}"
    ticks = "" if fps is not None or "frames" in units or len(units) > 1 else ", or ticks of another length"
    return f"when the pictures were taken is not known: {found} and may be {' or '.join(rates)}{ticks}; {write}"


def _check_step(stamps: Float64[np.ndarray, "N"], unit: str, timing: Timing) -> None:
    """Refuse a step that no camera has."""
    step, least, most = _step(stamps), *PICTURE_STEP_S
    took = step * SECONDS[unit]
    if np.isfinite(took) and not least * 0.999 <= took <= most:
        likely = [u for u in _units(step, PICTURE_STEP_S) if u != unit and _is_usual(step, u)]
        likely = [u for u in likely if np.max(np.abs(stamps)) * SECONDS[u] <= _LONGEST_S]
        write = "they may be digits of a date, or ticks: give 'times', a file with the seconds of every picture"
        if likely:
            write = f"'time_unit: {likely[0]}' would make that {step * SECONDS[likely[0]]:.3g} s"
        raise UnclearStamps(
            f"{timing.source} step by {took:.3g} s if they are in {unit}, expected {least:.2g} to {most:g} s "
            f"between pictures; {write}"
        )


def _check_rate(step: float, unit: str, timing: Timing, fps: float | None) -> None:
    """Refuse a rate that is not as said."""
    rate = 1 / (step * SECONDS[unit])
    if fps is not None and np.isfinite(rate) and not _agree(rate, fps):
        raise UnclearStamps(
            f"{timing.source} are times in {unit}, {rate:.3g} pictures a second, and 'fps: {fps:g}' contradicts them; "
            "leave fps out, or correct it"
        )


def decide_sample_unit(
    stamps: Float64[np.ndarray, "N"], timing: Timing, pictures_s: Float64[np.ndarray, "F"], stated: StatedUnit | None
) -> Unit:
    """The unit of the stamps of samples: the one in which they lie where the pictures do.

    Raises:
        UnclearStamps: None does, or several do.
    """
    if timing.unit is not None:
        return timing.unit
    if stated is not None and stated != "frames":
        return stated
    if (epoch := epoch_unit(stamps)) is not None:
        return epoch
    step = _step(stamps)
    units = _units(step, SAMPLE_STEP_S) or [timing.custom or "s"]
    fitting = [u for u in units if _covered(stamps * SECONDS[u], pictures_s) >= 0.5]
    if len(fitting or units) != 1:
        raise UnclearStamps(f"{timing.source} step by {step:g} and may be {_or(units)}; write 'time_unit: ms', say")
    return (fitting or units)[0]


def _covered(time_s: Float64[np.ndarray, "N"], pictures_s: Float64[np.ndarray, "F"]) -> float:
    """The share of the longer of two spans in which both lie."""
    both = min(time_s[-1], pictures_s[-1]) - max(time_s[0], pictures_s[0])
    return float(both / max(np.ptp(time_s), np.ptp(pictures_s), 1e-9))


def _agree(rate: float, fps: float, within: float = RATE_TOLERANCE) -> bool:
    """Whether two rates are the same, roughly."""
    return abs(rate / fps - 1) <= within


def _or(units: Iterable[str]) -> str:
    """Units in words."""
    return " or ".join("numbers of frames" if u == "frames" else u for u in units)


def _write(fps: float | None, kept: bool) -> str:
    """What to write where it is not clear."""
    frames = "'fps: 30' where they number frames, or " if fps is None else ""
    frames = "'time_unit: frames' where they number frames, or " if kept else frames
    return f"write {frames}'time_unit: ms' for their unit (s, ms, us or ns), or give 'times', a file with them"
