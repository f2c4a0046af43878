"""Messages of a topic as rows of numbers: joints by their names, publishers that send in turn told apart."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from flowlab.errors import DataError
from flowlab.recordings.readers.joint_states import JointGroup, join_by_name
from flowlab.recordings.readers.publishers import Who, counted, tell_apart
from flowlab.recordings.readers.ros_messages import message_numbers
from flowlab.recordings.sample_files import to_float32
from flowlab.recordings.verdicts import Check, Verdict
from flowlab.text import cut


def group_samples(
    place: str, what: str, messages: Sequence[Any], sent: Sequence[Who], joints: bool
) -> tuple[list[JointGroup], list[Check]]:
    """The numbers of messages, those of each publisher and set of joints as a group.

    Args:
        place: The recording and the topic, for messages.
        what: ``state`` or ``action``.
        messages: In the order of recording.
        sent: By whom each was sent.
        joints: Whether they are JointStates.

    Raises:
        DataError: The numbers are not the same from message to message.
    """
    apart = tell_apart(sent)
    names = [] if apart is None else apart[0]
    checks: list[Check] = []
    if joints and any(len(m.position) for m in messages):
        groups, checks = join_by_name(place, messages, names)
        _check_unnamed(place, what, groups)
    else:
        _check_frame(place, what, sent, apart is not None)
        each = [np.flatnonzero([name == one for name in names]) for one in dict.fromkeys(names)]
        groups = [_unnamed(place, what, messages, k, names) for k in each or [np.arange(len(messages))]]
    if apart is not None and any(name.startswith(f"{who}/") for g in groups for name in g.names for who in set(names)):
        says = (f"several publish on one topic in turn, told apart by {apart[1]} ({counted(names)} messages); their "
                "numbers stand side by side, with that before their names")  # fmt: skip
        checks = [Check(f"{what} publishers", Verdict.ASSUMED, says), *checks]
    return groups, checks


def _check_frame(place: str, what: str, sent: Sequence[Who], apart: bool) -> None:
    """Refuse numbers, such as those of poses, that are in one frame first and in another later."""
    frames = list(dict.fromkeys(who.frame for who in sent if who.frame))
    if len(frames) > 1 and not apart:
        raise DataError(f"{place}: the messages are in several frames ({cut(', '.join(frames))}), expected one; choose "
                        f"another topic, or none, with 'topics: {{{what}: ...}}'")  # fmt: skip


def _unnamed(
    place: str, what: str, messages: Sequence[Any], which: np.ndarray, publishers: Sequence[str]
) -> JointGroup:
    """Numbers that have no names, in their order in some messages; those that are not finite are left out."""
    rows = [message_numbers(messages[k]) for k in which]
    widths = sorted({len(row) for row in rows})
    if len(widths) != 1 or not widths[0]:
        raise DataError(
            f"{place}: the messages hold {' or '.join(map(str, widths))} numbers, expected the same number of each; "
            f"choose another topic, or none, with 'topics: {{{what}: ...}}'"
        )
    values = to_float32(np.array(rows, np.float64))
    whole = np.isfinite(values).all(1)
    if not whole.all():
        raise DataError(
            f"{place}: {(~whole).sum()} of {len(whole)} messages hold what is no number; choose another topic, or none, "  # noqa: E501
            f"with 'topics: {{{what}: ...}}'"
        )
    names = [f"{publishers[which[0]]}/{k}" for k in range(widths[0])] if publishers else []
    return JointGroup(tuple(names), which[whole], values)


def _check_unnamed(place: str, what: str, groups: Sequence[JointGroup]) -> None:
    """Refuse joints without names beside others: nothing tells which they are."""
    if len(groups) > 1 and not all(g.names for g in groups):
        widths = " or ".join(str(g.positions.shape[1]) for g in groups)
        raise DataError(
            f"{place}: the messages hold {widths} numbers, and not all name their joints, expected the same number of "
            f"each; choose another topic, or none, with 'topics: {{{what}: ...}}'"
        )
