"""Dates and times of day that are written as digits: in the names of files, or as if they were numbers."""

import re
from calendar import timegm
from collections.abc import Sequence
from datetime import datetime

import numpy as np
from jaxtyping import Float64

from flowlab.recordings.stamps import Timing, UnclearStamps
from flowlab.recordings.sync import GAP

_DATE = r"(?P<year>(?:19|20)\d\d)(?P<a>[-_.]?)(?P<month>0[1-9]|1[0-2])(?P=a)(?P<day>0[1-9]|[12]\d|3[01])"
_TIME = r"(?P<hour>[01]\d|2[0-3])(?P<b>[-_.:h]?)(?P<minute>[0-5]\d)(?:(?P=b)|m)(?P<second>[0-5]\d)"
_FRACTION = r"(?:(?P<c>[-_.,]?)(?P<fraction>\d+))?"
_STAMP = re.compile(rf"(?<!\d){_DATE}[-_T .]{{0,3}}{_TIME}{_FRACTION}(?!\d)")
_OF_DAY = re.compile(rf"(?<!\d){_TIME}(?P<c>[-_.,]?)(?P<fraction>\d{{3}}|\d{{6}}|\d{{9}})(?!\d)")
_WHOLE = (3, 6, 9)
"""Digits of a fraction of a second that stands as a number of its own."""
_DAY_S = 86400
_FEWER = 0.75
"""Read as times of day, numbers must leave a longest gap shorter by this factor than read as numbers."""


def dates_in_names(stems: Sequence[str]) -> list[str] | None:
    """The seconds since 1970 that names tell as a date and a time, or since midnight; None where they do not.

    ``20231114_221358.250`` is a date, whatever stands between its parts. What stands before it is no matter; a number
    after it that changes makes it unclear which is meant. A time alone, such as ``221358.250``, might be a number as
    well: it is a time of day where a minute ends in between, as numbers go on to 60.

    Raises:
        UnclearStamps: They are dates, of which part is not clear.
    """
    found = [_STAMP.search(s) for s in stems]
    if all(found) and _tells(found):
        _check_rest(stems, found)
        return _written(found)
    of_day = [_OF_DAY.search(s) for s in stems]
    if all(of_day) and len({m["minute"] for m in of_day if m}) > 1 and _go_on_better(of_day):
        _check_rest(stems, of_day)
        return _written(of_day)
    return None


def _tells(found: Sequence[re.Match[str] | None]) -> bool:
    """Whether it is the date and time that changes, and not a number behind it or one that looks like a time."""
    kept = [m for m in found if m is not None]
    if all(m["fraction"] and not m["b"] and not m["c"] for m in kept):
        return True
    changes = "second" if all(m["fraction"] for m in kept) else "minute"
    return len({m[changes] for m in kept}) > 1


def _seconds(match: re.Match[str] | None) -> int:
    """Whole seconds since 1970, or since midnight."""
    assert match is not None
    parts = match.groupdict()
    clock = 3600 * int(parts["hour"]) + 60 * int(parts["minute"]) + int(parts["second"])
    if "year" not in parts:
        return clock
    try:
        day = datetime(int(parts["year"]), int(parts["month"]), int(parts["day"]))
    except ValueError as error:
        raise UnclearStamps(f"'{match[0]}' is no date ({error}); {_WRITE}") from error
    return timegm(day.timetuple()) + clock


_WRITE = "write 'times: times.txt' and 'depth_times: depth_times.txt', files with the seconds of every picture"


def _written(found: Sequence[re.Match[str] | None]) -> list[str]:
    """Seconds with their fraction, as text that has all its digits."""
    kept = [m for m in found if m is not None]
    digits = {len(m["fraction"] or "") for m in kept}
    if any(m["c"] != "." for m in kept) and (len(digits) > 1 or max(digits) not in (0, *_WHOLE)):
        raise UnclearStamps(f"'{kept[0][0]}' ends with a number of {min(digits)} to {max(digits)} digits, which may be "
                            f"a part of a second or not; {_WRITE}")  # fmt: skip
    seconds = _over_midnight(np.array([_seconds(m) for m in kept]), dated="year" in kept[0].groupdict())
    return [f"{s}.{m['fraction'] or 0}" for s, m in zip(seconds, kept, strict=True)]


def _over_midnight(seconds: np.ndarray, dated: bool) -> list[int]:
    """Times of day, those after midnight a day later."""
    ordered = np.sort(seconds)
    steps = np.diff(ordered)
    if not dated and len(steps) and steps.max() > _DAY_S / 2:
        seconds = np.where(seconds <= ordered[np.argmax(steps)], seconds + _DAY_S, seconds)
    return [int(s) for s in seconds]


def _go_on_better(found: Sequence[re.Match[str] | None]) -> bool:
    """Whether times of day step as the same digits do as a number, but for a gap that only these have."""
    of_day = np.diff(np.sort([float(t) for t in _written(found)]))
    as_number = np.diff(np.sort([_as_number(m) for m in found if m is not None]))
    alike = abs(np.median(of_day) - np.median(as_number)) < 1e-3 * np.median(as_number)
    gap = as_number.max() > GAP * np.median(as_number)
    return bool(alike and gap and of_day.max() <= _FEWER * as_number.max())


def _as_number(match: re.Match[str]) -> float:
    """The digits of a time of day as a number whose whole part ends with the seconds."""
    return float(f"{match['hour']}{match['minute']}{match['second']}.{match['fraction'] or 0}")


def _check_rest(stems: Sequence[str], found: Sequence[re.Match[str] | None]) -> None:
    """Refuse names in which another number follows that changes, or half a day is meant."""
    rests = [s[m.end() :] for s, m in zip(stems, found, strict=True) if m is not None]
    if len({tuple(re.findall(r"\d+", r)) for r in rests}) > 1:
        raise UnclearStamps(f"the names hold a time and then another number that changes, as '{stems[0]}'; {_WRITE}")
    if any(re.match(r"[-_ .]?[ap]\.?m\b", r, re.IGNORECASE) for r in rests):
        raise UnclearStamps(f"the names hold times of half a day, as '{stems[0]}'; {_WRITE}")


def check_no_dates(stamps: Float64[np.ndarray, "N"], timing: Timing) -> None:
    """Refuse numbers that are dates, as 20231114221358.25, or times of day, as 221358.25, and not counted seconds.

    Raises:
        UnclearStamps: They are.
    """
    low, high = float(np.min(stamps, initial=np.inf)), float(np.max(stamps, initial=0.0))
    if low > 1.9e13 and high < 2.1e16:
        whole = [f"{s:.0f}" for s in np.floor(stamps)]
        if all(_STAMP.fullmatch(w) for w in whole):
            raise UnclearStamps(
                f"{timing.source} are dates (YYYYMMDDhhmmss), as {whole[0]}, and no count of time; {_WRITE}"
            )
    if not (0 <= low < high < 240_000 and len(stamps) > 2):
        return
    of_day = [_OF_DAY.fullmatch(f"{s:013.6f}") for s in stamps]
    if all(of_day) and len({m["minute"] for m in of_day if m}) > 1 and _go_on_better(of_day):
        raise UnclearStamps(f"{timing.source} are times of day (hhmmss), as {stamps[0]:.9g}, and no count of time: "
                            f"none has more than 59 seconds; {_WRITE}")  # fmt: skip
