"""What is asked of windows: taken where it can be meant, refused in a sentence where it cannot."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from jaxtyping import Num

from flowlab.errors import UsageError

_SHOWN = 80
"""So many characters of what was given are shown."""


def one_of(
    offsets: Mapping[str, Sequence[int]] | None, delta_timestamps: Mapping[str, Sequence[float]] | None
) -> Mapping[str, Sequence[Any]]:
    """Whichever of the two was given."""
    form = "as in {'state': [-1, 0], 'action': range(8)}"
    if (offsets is None) == (delta_timestamps is None):
        raise UsageError(f"Windows: give either offsets or delta_timestamps, {form}")
    name, asked = ("offsets", offsets) if offsets is not None else ("delta_timestamps", delta_timestamps)
    if not isinstance(asked, Mapping) or not asked:
        raise UsageError(f"Windows: {name} must say which rows are wanted of every key, {form}; found {shown(asked)}")
    return asked


def finite_numbers(key: str, values: Any, kinds: str, what: str) -> Num[np.ndarray, "T"]:
    """Finite numbers of some kinds, as NumPy's letters name them."""
    try:
        found = np.asarray(values)
    except ValueError:  # lists of different lengths
        found = np.empty(0)
    if found.ndim != 1 or not len(found) or found.dtype.kind not in kinds or not np.isfinite(found).all():
        form = "whole numbers of rows, as in [-1, 0]" if what == "offsets" else "finite seconds, as in [-0.1, 0.0]"
        raise UsageError(f"Windows: {what} of '{key}' must be {form}; found {shown(values)}")
    return found


def choose_episodes(episodes: Sequence[int] | None, among: Sequence[int], path: Path) -> tuple[int, ...]:
    """Positions in the dataset of some of the episodes that were given."""
    if episodes is None:
        wanted = list(range(len(among)))
    elif isinstance(episodes, Iterable):
        wanted = list(episodes)
    else:
        _refused(episodes, path)
    for k in wanted:
        if not isinstance(k, int | np.integer) or isinstance(k, bool):
            _refused(episodes, path)
        if not 0 <= k < len(among):
            raise UsageError(f"{path}: no episode {k}; there are {len(among)}, counted from 0")
    if not wanted:
        raise UsageError(
            f"{path}: episodes is empty; leave it out for all {len(among)} of them"
            if len(among)
            else f"{path}: none of its episodes was given, expected one or more"
        )
    return tuple(among[k] for k in wanted)


def _refused(episodes: Any, path: Path) -> NoReturn:
    raise UsageError(
        f"{path}: episodes must be positions of episodes, as in [0, 2]; found {shown(episodes)}; those of one task "
        'are flowlab.open_dataset(...).task("push")'
    )


def shown(value: Any) -> str:
    """A value, not longer than a line."""
    text = repr(value).replace("\n", " ")
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}..."
