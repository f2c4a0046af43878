"""Who sent the messages of a topic: several that send in turn are told apart, by what the messages and the bag say."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from flowlab.text import cut, shown

_SAYS_WHO = ("child_frame_id", "name", "ns", "id", "robot", "arm", "side", "source", "device", "serial")
"""Fields of words that tell, beside the frame of the header, of whom a message is."""
_MOST = 8
"""More than so many differences are no publishers but what the messages have to say."""


@dataclass(frozen=True, slots=True)
class Who:
    """Who sent a message, as far as that is known."""

    frame: str = ""
    """Of its header."""
    named: str = ""
    """What its own fields say."""
    connection: str = ""
    """The node, or the number of the connection through which it was recorded."""


def who_sent(message: Any, connection: str) -> Who:
    """Who sent a message that came through a connection."""
    named = (getattr(message, field, None) for field in _SAYS_WHO)
    frame = getattr(getattr(message, "header", None), "frame_id", "")
    return Who(str(frame), "/".join(x for x in named if isinstance(x, str) and x), connection)


def tell_apart(sent: Sequence[Who]) -> tuple[list[str], str] | None:
    """What each message's publisher is called, and by what they are told; None where one alone sends.

    Publishers that send one after the other, as where one was started anew, are one.
    """
    for field, words in (("frame", "frame_id"), ("named", "their names"), ("connection", "connection")):
        names = [getattr(who, field) for who in sent]
        if 1 < len(set(names)) <= _MOST and in_turn(names):
            return [name or "unnamed" for name in names], words
    return None


def in_turn(names: Sequence[str]) -> bool:
    """Whether somebody sends again after another did."""
    changes = sum(a != b for a, b in pairwise(names))
    return changes >= len(set(names)) > 1


def counted(names: Sequence[str]) -> str:
    """How many messages each sent."""
    return cut(", ".join(f"{shown(name)} {names.count(name)}" for name in dict.fromkeys(names)))
