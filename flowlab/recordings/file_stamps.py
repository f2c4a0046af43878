"""What the names of files say of time: the number in each that is not the same in all."""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from flowlab.errors import DataError
from flowlab.recordings.dates import dates_in_names
from flowlab.recordings.stamps import EPOCH_S, SECONDS, Timing, UnclearStamps
from flowlab.text import shown

_NUMBER = re.compile(r"\d+(?:\.\d+)?")
_LONGEST = 19
"""Digits of nanoseconds since 1970."""
_FRACTION = (3, 6, 9)
"""Digits of a fraction of a second that stands as a number of its own."""


def read_names(files: Sequence[Path], source: str) -> tuple[list[Path], Float64[np.ndarray, "N"], Timing]:
    """Files of a folder in the order of the number in their names, which a folder itself does not have.

    Args:
        files: The files.
        source: What messages call their names.

    Returns:
        The files, their numbers, and what is known of these: whether they number frames is decided elsewhere.

    Raises:
        UnclearStamps: There is no such number, or several that change.
    """
    _check_twins(files, source)
    dates = dates_in_names([f.stem for f in files])
    texts = dates or _changing(files, source)
    _check_fractions(texts, source)
    values = np.array([float(t) for t in texts])
    order = np.argsort(values, kind="stable")
    integers = not any("." in t for t in texts)
    if dates is not None:
        return [files[i] for i in order], values[order], Timing(f"the dates and times in {source}", "s", names=True)
    return [files[i] for i in order], values[order], Timing(source, unit=None, integers=integers, names=True)


def _check_twins(files: Sequence[Path], source: str) -> None:
    """Refuse two pictures of one name, as a folder has that was converted: which is meant is not said."""
    known: dict[str, Path] = {}
    for file in files:
        if (twin := known.setdefault(file.stem, file)) is not file:
            raise DataError(
                f"{source}: {shown(twin.name)} and {shown(file.name)} are two pictures of one name; keep one of each"
            )


def _changing(files: Sequence[Path], source: str) -> list[str]:
    """The number of each name that changes from one to the next, as it is written."""
    found = [_NUMBER.findall(f.stem) for f in files]
    if not all(found):
        name = files[[bool(f) for f in found].index(False)].name
        raise UnclearStamps(f"{source} have no number to tell time by, as {shown(name)}; {WRITE_TIMES}")
    if len({len(f) for f in found}) > 1:
        raise UnclearStamps(
            f"{source} hold different counts of numbers, so it is not clear which is meant; {WRITE_TIMES}"
        )
    columns = list(zip(*found, strict=True))
    changing = [c for c in columns if len(set(c)) > 1] or columns[-1:]
    if any(len(t.replace(".", "")) > _LONGEST for c in changing for t in c):
        raise UnclearStamps(f"{source} hold numbers of more than {_LONGEST} digits; {WRITE_TIMES}")
    since_1970 = [c for c in changing if _is_since_1970(c)]
    if len(changing) == 1:
        return list(changing[0])
    if len(since_1970) == 1 and changing[-1] is since_1970[0]:
        return list(since_1970[0])
    if len(changing) == 2 and since_1970 == [changing[0]] and _is_fraction(changing[1]):
        return [f"{s}.{fraction}" for s, fraction in zip(*changing, strict=True)]
    raise UnclearStamps(f"{source} hold {len(changing)} numbers that change, as {shown(files[0].name)}; {WRITE_TIMES}")


WRITE_TIMES = (
    "write 'times: times.txt' and 'depth_times: depth_times.txt', files with the time of every picture, one a line"
)


def _is_since_1970(texts: Sequence[str]) -> bool:
    """Whether all count from 1970, in some unit."""
    return any(all(EPOCH_S[0] <= float(t) * s <= EPOCH_S[1] for t in texts) for s in SECONDS.values())


def _is_fraction(texts: Sequence[str]) -> bool:
    """Whether all are fractions of a second, padded to the same digits."""
    return len({len(t) for t in texts}) == 1 and len(texts[0]) in _FRACTION


def _check_fractions(texts: Sequence[str], source: str) -> None:
    """Refuse fractions that may be nanoseconds without their leading zeros, as ``1305031102.5000`` may be."""
    digits = {len(t.partition(".")[2]) for t in texts if "." in t}
    if len(digits) > 1 and max(digits) > 7:
        raise UnclearStamps(f"{source} have fractions of {min(digits)} to {max(digits)} digits, which may be "
                            f"nanoseconds without leading zeros; {WRITE_TIMES}")  # fmt: skip
