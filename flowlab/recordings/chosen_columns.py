"""The numbers of a robot that the user chooses by name, whichever reader they are from; else the choice is refused."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from typing import Any

from flowlab.errors import DataError
from flowlab.recordings.base import SampleStream, Streams
from flowlab.recordings.recording_yaml import Metadata
from flowlab.text import cut, shown


def with_chosen_columns(path: Path, streams: Streams, known: Metadata) -> Streams:
    """The streams, of whose state and actions the columns are left that ``recording.yaml`` names, in its order.

    Args:
        path: The recording, for messages.
        streams: As the reader gives them; what is from a file that the user names was chosen when that was read.
        known: What the user says.

    Raises:
        DataError: Columns are named of numbers that have no names, or other ones; or times of what is no file.
    """
    changed: dict[str, Any] = {}
    for what in ("state", "action"):
        if getattr(known, what) is not None:
            continue
        if getattr(known, f"{what}_times") is not None:
            raise DataError(f"{path}: '{what}_times' is said, but no file that they are the times of; name it with "
                            f"'{what}: ...'")  # fmt: skip
        chosen = getattr(known, f"{what}_columns")
        if chosen is not None:
            changed[what] = _choose(f"{path}: '{what}_columns'", what, getattr(streams, what), chosen)
    return replace(streams, **changed)


def _choose(place: str, what: str, streams: Sequence[SampleStream], chosen: Sequence[str]) -> tuple[SampleStream, ...]:
    """The columns of these names, those that follow each other in one stream as one."""
    if not streams:
        raise DataError(f"{place} is said, but there is no {what}")
    if any(len(s.columns) != s.values.shape[1] for s in streams):
        raise DataError(f"{place} is said, but the numbers of the {what} have no names here; name a table of them that "
                        f"does with '{what}: {what}.csv', or leave it out")  # fmt: skip
    at = {name: (i, k) for i, s in enumerate(streams) for k, name in enumerate(s.columns)}
    have = cut(", ".join(repr(name) for s in streams for name in s.columns), 600)
    for name in chosen:
        if name not in at:
            raise DataError(f"{place} names {shown(name)}, and the {what} has {have}")
    if len(set(chosen)) < len(chosen):
        raise DataError(f"{place} names a column twice; the {what} has {have}")
    found: list[SampleStream] = []
    for i, run in groupby(chosen, key=lambda name: at[name][0]):
        names = tuple(run)
        values = streams[i].values[:, [at[name][1] for name in names]]
        label = what if not found else f"{what} {len(found) + 1}"
        found.append(replace(streams[i], name=label, values=values, columns=names))
    return tuple(found)
