"""Whether the numbers of a robot can be what they are taken for, whichever reader they are from."""

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from flowlab.recordings.base import SampleStream
from flowlab.recordings.clock_numbers import ClockColumn, find_clocks
from flowlab.recordings.odd_rows import frozen_rows, no_readings
from flowlab.recordings.turns import find_turns
from flowlab.recordings.verdicts import Check, Verdict
from flowlab.text import cut

if TYPE_CHECKING:
    from flowlab.recordings.parsing import ParsedRecording


def check_numbers(source: "ParsedRecording") -> Iterator[Check]:
    """Whether state and actions hold times, or are of two robots in turn; one check for each that there is."""
    for what in ("state", "action"):
        streams: Sequence[SampleStream] = getattr(source.streams, what)
        if not streams:
            continue
        chosen = getattr(source.metadata, f"{what}_columns") is not None
        found = [c for s in streams for c in _looked_at(s, what, chosen, source)]
        width = sum(s.values.shape[1] for s in streams)
        says = f"none of {width} numbers goes as a clock does, leaps as those of two robots in turn, or froze"
        yield from found or [Check(f"{what} numbers", Verdict.OK, says)]


def _looked_at(stream: SampleStream, what: str, chosen: bool, source: "ParsedRecording") -> Iterator[Check]:
    """What is found in one stream; what the user chose by name is no clock to ask about."""
    if not chosen:
        yield from _times(stream, what, source.write_to)
    yield from _turns(stream, source.metadata.one_robot, source.write_to)
    if what == "state":  # an action may be none for long
        yield from _odd_rows(stream)


def _odd_rows(stream: SampleStream) -> Iterator[Check]:
    """Doubts about rows that are no readings."""
    values = stream.values[np.argsort(stream.time_s, kind="stable")].astype(np.float64)
    for says in filter(None, (no_readings(values, stream.columns), frozen_rows(values))):
        yield Check(f"{stream.name} numbers", Verdict.DOUBTFUL, f"{says}; take such rows out of the recording: frames "
                    "without a row near them are left out")  # fmt: skip


def _times(stream: SampleStream, what: str, write_to: str) -> Iterator[Check]:
    """Refusals, or doubts, about columns that are times."""
    clocks = find_clocks(stream.values, stream.columns, stream.time_s)
    if clocks:
        says = f"{describe_clock(clocks[0], stream.columns)}; {_advice(stream, what, clocks)}, in {write_to}"
        yield Check(f"{what} numbers", Verdict.REFUSED if clocks[0].certain else Verdict.DOUBTFUL, says)


def describe_clock(found: ClockColumn, names: Sequence[str]) -> str:
    """Which column it is, and why it is taken for times."""
    return f"column {cut(repr(names[found.place])) if names else found.place + 1} {found.why}"


def _advice(stream: SampleStream, what: str, clocks: Sequence[ClockColumn]) -> str:
    """What to write."""
    if stream.columns:
        rest = [n for k, n in enumerate(stream.columns) if k not in {c.place for c in clocks}]
        return f"name the numbers of the {what}, in order: '{what}_columns: [{cut(', '.join(map(repr, rest)), 400)}]'"
    return (f"write the {what} as a table with a line of names, its times in a column 'time [s]', and name it with "
            f"'{what}: {what}.csv'")  # fmt: skip


def _turns(stream: SampleStream, one_robot: bool, write_to: str) -> Iterator[Check]:
    """A refusal of numbers that leap back and forth between robots, unless the user says that it is one."""
    values = stream.values[np.argsort(stream.time_s, kind="stable")].astype(np.float64)
    found = find_turns(values)
    if found is None:
        return
    k, count = found
    name = cut(repr(stream.columns[k])) if stream.columns else str(k + 1)
    says = (f"{stream.name} leaps between smooth tracks {count} times in {len(values)} rows, most in column {name}, "
            "as of two robots that publish in turn")  # fmt: skip
    if one_robot:
        yield Check(f"{stream.name} numbers", Verdict.ASSUMED, f"{says}; it is one, as 'one_robot: true' says")
        return
    yield Check(f"{stream.name} numbers", Verdict.REFUSED, f"{says}, and nothing tells which is which; record each by "
                "itself, or under names of its own; if it is one robot that moves so, write 'one_robot: true' in "
                f"{write_to}")  # fmt: skip
