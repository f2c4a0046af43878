"""Joint states: what a joint was is told by its name, whoever publishes it, in whatever order."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float32, Int64

from flowlab.errors import DataError
from flowlab.recordings.sample_files import to_float32
from flowlab.recordings.verdicts import Check, Verdict
from flowlab.text import cut

_UNNAMED = "\0"
"""Begins what joints without names are called here, by how many there are and their place."""


@dataclass(frozen=True, slots=True)
class JointGroup:
    """Joints whose positions come in the same messages."""

    names: tuple[str, ...]
    """Empty where the messages name no joints."""
    messages: Int64[np.ndarray, "N"]
    """Which messages of the topic have them."""
    positions: Float32[np.ndarray, "N D"]


def join_by_name(
    place: str, messages: Sequence[Any], publishers: Sequence[str] = ()
) -> tuple[list[JointGroup], list[Check]]:
    """The positions of joints by name: those that always come together are a group, with samples of its own.

    Two arms that publish in turn are two groups; a joint that only some messages have is one, too.

    Args:
        place: The recording and the topic, for messages.
        messages: The JointStates, in the order of recording.
        publishers: Who sent each, where several send in turn: joints that more than one has are then called by both.

    Returns:
        The groups, in the order of their first message; and what is to be said of them.

    Raises:
        DataError: Names and positions of a message do not fit together, or a joint has no position at all.
    """
    rows = _of_publishers([_named(place, k, message) for k, message in enumerate(messages)], publishers)
    seen: dict[str, list[int]] = defaultdict(list)
    for k, row in enumerate(rows):
        for name in row:
            seen[name].append(k)
    by_presence: dict[tuple[int, ...], list[str]] = defaultdict(list)
    for name, where in seen.items():
        by_presence[tuple(where)].append(name)
    groups, checks = [], []
    for places, together in by_presence.items():
        names = list(together)
        values = to_float32(np.array([[rows[k][name] for name in names] for k in places]))
        finite = np.isfinite(values)
        if lost := [name for name, known in zip(names, finite.T, strict=True) if not known.any()]:
            raise DataError(f"{place}: no message has a number for {cut(', '.join(lost))}; record these joints, or choose "  # noqa: E501
                            "another topic, or none, with 'topics: {state: ...}'")  # fmt: skip
        whole = finite.all(1)
        if not whole.all():
            says = f"{(~whole).sum()} of {len(whole)} messages hold no number for {_worst(names, finite)}: not used"
            checks.append(Check("state", Verdict.DOUBTFUL, says))
        names = [] if names[0].startswith(_UNNAMED) else names
        groups.append(JointGroup(tuple(names), np.array(places)[whole], values[whole]))
    if len(groups) > 1:
        listed = "; ".join(f"{cut(', '.join(g.names))} in {len(g.messages)}" for g in groups)
        says = f"the messages do not all have the same joints, so they are joined by name: {listed} messages"
        checks.append(Check("state", Verdict.ASSUMED, says))
    elif len({tuple(row) for row in rows}) > 1:
        checks.append(Check("state", Verdict.OK, "the order of joints differs between messages: joined by name"))
    return groups, checks


def _of_publishers(rows: list[dict[str, float]], publishers: Sequence[str]) -> list[dict[str, float]]:
    """The same positions; names that several publishers have get the publisher's before them."""
    owners: dict[str, set[str]] = defaultdict(set)
    for row, publisher in zip(rows, publishers, strict=False):
        for name in row:
            owners[name].add(publisher)
    if all(len(owner) < 2 for owner in owners.values()):
        return rows

    def called(name: str, publisher: str) -> str:
        plain = name.rpartition(" ")[2] if name.startswith(_UNNAMED) else name
        return f"{publisher}/{plain}" if len(owners[name]) > 1 else name

    return [{called(name, who): x for name, x in row.items()} for row, who in zip(rows, publishers, strict=True)]


def _worst(names: Sequence[str], finite: np.ndarray) -> str:
    return cut(names[int(finite.sum(0).argmin())])


def _named(place: str, k: int, message: Any) -> dict[str, float]:
    """The positions of a message by name; without names, by their place among as many."""
    positions, names = np.asarray(message.position, float).ravel().tolist(), [str(n) for n in message.name]
    if not names:
        names = [f"{_UNNAMED}{len(positions)} {i}" for i in range(len(positions))]
    if len(names) != len(positions) or len(set(names)) != len(names):
        raise DataError(
            f"{place}: message {k + 1} has {len(positions)} positions for the joints {cut(', '.join(names))}, expected "
            "one for each, and each once; choose another topic, or none, with 'topics: {state: ...}'"
        )
    return dict(zip(names, positions, strict=True))
