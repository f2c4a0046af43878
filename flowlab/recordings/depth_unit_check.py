"""Whether depth is in the unit that is said, by what it makes of the scene."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from flowlab.recordings.verdicts import Check, Verdict

if TYPE_CHECKING:
    from flowlab.recordings.parsing import ParsedRecording

CUSTOM = "the custom of "
"""Begins the origin of what no file says."""
_UNITS = (1.0, 0.001, 0.0001, 0.00025, 0.0002)
"""Of depth pictures, the most usual first [m]."""
_POSSIBLE_M = (0.02, 100.0)
"""The median depth of a recording lies between these [m]."""
_WORKSPACE_M = (0.15, 5.0)
"""A camera that sees a robot at work has its median depth between these [m]."""
_FAR_M = 3.0
"""Beyond this [m] it is unusual that far."""
_SENSED_M = (0.15, 10.0)
"""Where depth cameras measure [m]."""
_MOST = 0.9
"""So many of the readings must lie there."""
_SATURATED = 65535
_VARIED = 8
"""So many different readings tell the step between them."""
_COARSE_M = 0.02
"""No depth camera has steps as wide as that at all distances [m]."""


def likely_unit(median_counts: float) -> str:
    """The unit that would put readings into a workspace, as what to write."""
    likely = next((u for u in _UNITS if _WORKSPACE_M[0] < median_counts * u < _FAR_M), None)
    if likely is None:
        return "no unit that is usual would make that a robot's workspace"
    return f"'depth_unit_m: {likely:g}' would make that {median_counts * likely:.3g} m"


@dataclass(frozen=True, slots=True)
class _Readings:
    """Readings of all sampled frames."""

    median: float
    low: float
    high: float
    """The 5th and the 95th of a hundred."""
    step: float
    """What all are multiples of; 0 where that cannot be told."""
    counts: np.ndarray

    @classmethod
    def of(cls, source: "ParsedRecording") -> "_Readings | None":
        """None without any."""
        found = [s.depth[np.isfinite(s.depth) & (s.depth > 0)].ravel() for s in source.frame_check.samples]
        readings = np.concatenate(found) if found else np.empty(0)
        saturated = (readings == _SATURATED) if readings.dtype.kind in "iu" else np.zeros(len(readings), bool)
        readings = readings[~saturated]
        if not readings.size:
            return None
        low, median, high = np.percentile(readings, (5, 50, 95))
        varied = np.unique(readings) if readings.dtype.kind in "iu" else np.empty(0)
        step = float(np.gcd.reduce(varied.astype(np.int64))) if len(varied) >= _VARIED else 0.0
        return cls(float(median), float(low), float(high), step, readings)


def check_depth_unit(source: "ParsedRecording") -> Iterator[Check]:
    """What the unit makes of the readings; one check, or none where there is no unit or no reading."""
    unit, readings = source.metadata.depth_unit_m, _Readings.of(source)
    if unit is None or readings is None:
        return
    origin = source.origin.get("depth_unit_m", "")
    verdict, why = _judged(unit, readings, origin.startswith(CUSTOM))
    if verdict in (Verdict.OK, Verdict.ASSUMED):
        verdict, why = _contradicted(source, unit, readings) or _beyond(unit, readings) or (verdict, why)
    says = f"{unit:g} m a count, from {origin}{_scene(unit, readings)}{why}"
    if verdict in (Verdict.REFUSED, Verdict.DOUBTFUL):
        says += f"; write 'depth_unit_m' into {source.write_to}"
        if not _WORKSPACE_M[0] < unit * readings.median < _FAR_M:
            says += f" ({likely_unit(readings.median)})"
    yield Check("depth unit", verdict, says)


def _scene(unit: float, readings: _Readings) -> str:
    """The scene in numbers."""
    inside = _sensed(unit, readings)
    step = f", in steps of {1000 * unit * readings.step:.3g} mm" if readings.step else ""
    return (f": a median of {readings.median:g} counts is {unit * readings.median:.3g} m, nine tenths lie from "
            f"{unit * readings.low:.3g} to {unit * readings.high:.3g} m, {inside:.0%} within "
            f"{_SENSED_M[0]} to {_SENSED_M[1]:g} m{step}")  # fmt: skip


def _sensed(unit: float, readings: _Readings) -> float:
    """The share of the readings that depth cameras measure."""
    return float(np.mean((readings.counts * unit > _SENSED_M[0]) & (readings.counts * unit < _SENSED_M[1])))


def _beyond(unit: float, readings: _Readings) -> tuple[Verdict, str] | None:
    """Where many readings are nearer or farther than depth cameras measure, whatever the unit's origin."""
    if _sensed(unit, readings) >= _MOST:
        return None
    return Verdict.DOUBTFUL, (
        ": either the unit is another, or readings stand for none, as where a sensor is blinded, and should be 0"
    )


def _judged(unit: float, readings: _Readings, custom: bool) -> tuple[Verdict, str]:
    """A unit that somebody wrote is refused where it is impossible; one of custom where it is not likely."""
    median, high = unit * readings.median, unit * readings.high
    if not _POSSIBLE_M[0] < median < _POSSIBLE_M[1]:
        return Verdict.REFUSED, ", which cannot be"
    likely = _WORKSPACE_M[0] < median < _WORKSPACE_M[1]
    if not custom:
        if not _SENSED_M[0] < median < _SENSED_M[1]:
            return Verdict.DOUBTFUL, f", {'near' if median < 1 else 'far'} for a depth camera"
        if unit * readings.step >= _COARSE_M:
            return Verdict.DOUBTFUL, ", coarser than depth cameras are: depth was rounded, or the unit is smaller"
        return Verdict.OK, ""
    if not likely or high > 2 * _SENSED_M[1]:
        return Verdict.REFUSED, ", which is not a robot's workspace, and no file says that unit"
    if median > _FAR_M:
        smaller = unit / 10 * readings.median
        return Verdict.DOUBTFUL, (f", far for a robot's workspace, and no file says that unit: a tenth of it, as some "
                                  f"cameras have, would make the median {smaller:.3g} m")  # fmt: skip
    if readings.step >= 5 and unit * readings.step > 0.004:
        return Verdict.DOUBTFUL, ", coarser than depth cameras are: the counts may be of a smaller unit"
    return Verdict.ASSUMED, ""


def _contradicted(source: "ParsedRecording", unit: float, readings: _Readings) -> tuple[Verdict, str] | None:
    """Where another source says another unit; the user's word holds unless the scene speaks for the other."""
    for name, known in source.streams.known:
        other = known.depth_unit_m
        if other is None or name.startswith(CUSTOM) or abs(other / unit - 1) < 0.01:
            continue
        mine, theirs = (_WORKSPACE_M[0] < u * readings.median < _WORKSPACE_M[1] for u in (unit, other))
        verdict = Verdict.REFUSED if theirs and not mine else Verdict.DOUBTFUL
        return verdict, f", but {name} says {other:g} m, which would make the median {other * readings.median:.3g} m"
    return None
