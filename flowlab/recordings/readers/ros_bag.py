"""A ROS recording opened for reading message by message."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float64, Int64

from flowlab.errors import DataError, MissingLibraryError
from flowlab.recordings.readers.ros_messages import stamp_s

if TYPE_CHECKING:
    from rosbags.interfaces import Connection


@dataclass(frozen=True, slots=True)
class BagIndex:
    """When the messages of a topic were measured and recorded, in the order of recording."""

    recorded_ns: Int64[np.ndarray, "N"]
    nth: Int64[np.ndarray, "N"]
    """How many messages of the topic with the same time of recording came before."""
    measured_s: Float64[np.ndarray, "N"]
    """As the messages say; nan where they do not."""


class RosBag:
    """A bag, opened; it stays open as long as somebody reads pictures from it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            from rosbags.highlevel import AnyReader
            from rosbags.typesys import Stores, get_typestore
        except ImportError as error:
            raise MissingLibraryError(
                f"{path}: reading ROS recordings needs the rosbags package ({error}); 'pip install flowlab[ros]'"
            ) from error
        try:
            # Before 2023, ROS 2 recordings did not say what their messages look like.
            self._reader: AnyReader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
            self._reader.open()
        except Exception as error:  # rosbags lets through what its parsers raise
            raise DataError(f"{path}: is no readable ROS recording ({_words(error)})") from error

    def topics(self, *types: str) -> dict[str, int]:
        """Topics that hold messages of these types, with how many."""
        found: dict[str, int] = {}
        for c in self._reader.connections:
            if c.msgtype in types and self._count(c.topic):
                found[c.topic] = self._count(c.topic)
        return dict(sorted(found.items()))

    def types(self) -> dict[str, str]:
        """The type of every topic."""
        return {c.topic: c.msgtype for c in self._reader.connections}

    def first(self, topic: str) -> Any:
        """The first message of a topic."""
        message = next((message for _, message in self.messages(topic)), None)
        if message is None:
            raise DataError(f"{self.path}: the topic {topic} holds no messages; choose another with 'topics'")
        return message

    def messages(
        self, topic: str, start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[tuple[int, Any]]:
        """Time of recording [ns] and content of the messages of a topic."""
        try:
            for connection, time_ns, raw in self._reader.messages(self._connections(topic), start_ns, stop_ns):
                yield time_ns, self._reader.deserialize(raw, connection.msgtype)
        except DataError:
            raise
        except Exception as error:
            raise DataError(f"{self.path}: {topic} cannot be read ({_words(error)})") from error

    def index(self, topic: str) -> BagIndex:
        """When every message of a topic is from."""
        recorded, measured = [], []
        for time_ns, message in self.messages(topic):
            recorded.append(time_ns)
            measured.append(stamp_s(message))
        times = np.array(recorded, np.int64)
        fresh = np.append(True, times[1:] != times[:-1])
        nth = np.arange(len(times)) - np.flatnonzero(fresh)[np.cumsum(fresh) - 1]
        return BagIndex(times, nth, np.array([np.nan if m is None else m for m in measured]))

    def message(self, topic: str, index: BagIndex, i: int) -> Any:
        """One message."""
        time_ns, nth = int(index.recorded_ns[i]), int(index.nth[i])
        for k, (_, message) in enumerate(self.messages(topic, time_ns, time_ns + 1)):
            if k == nth:
                return message
        raise DataError(f"{self.path}: {topic} has lost its message {i} since it was opened")

    def _connections(self, topic: str) -> "list[Connection]":
        """The connections of a topic."""
        return [c for c in self._reader.connections if c.topic == topic]

    def _count(self, topic: str) -> int:
        """How many messages a topic has."""
        return self._reader.topics[topic].msgcount


def _words(error: BaseException) -> str:
    """What an error says, on one line."""
    return " ".join(str(error).split()) or type(error).__name__
