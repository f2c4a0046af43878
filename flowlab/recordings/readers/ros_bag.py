"""A ROS recording opened for reading message by message."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float64, Int64

from flowlab.errors import DataError, MissingLibraryError, first_line
from flowlab.limits import MAX_ARRAY_BYTES
from flowlab.recordings.readers.publishers import Who, who_sent
from flowlab.recordings.readers.ros_limits import limit_decompression, limited_memory
from flowlab.recordings.readers.ros_messages import stamp_s
from flowlab.recordings.readers.ros_types import open_reader
from flowlab.text import cut
from flowlab.untrusted import check_regular, parse_yaml, read_text

if TYPE_CHECKING:
    from rosbags.interfaces import Connection

_MAX_METADATA_BYTES = 4 << 20
"""Of a ``metadata.yaml``, which grows with the number of topics."""


@dataclass(frozen=True, slots=True)
class BagIndex:
    """When the messages of a topic were measured and recorded, in the order of recording."""

    recorded_ns: Int64[np.ndarray, "N"]
    nth: Int64[np.ndarray, "N"]
    """How many messages of the topic with the same time of recording came before."""
    measured_s: Float64[np.ndarray, "N"]
    """As the messages say; nan where they do not."""
    sent: tuple[Who, ...]
    """By whom."""


class RosBag:
    """A bag, opened; it stays open as long as somebody reads pictures from it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            import rosbags.highlevel  # noqa: F401
        except ImportError as error:
            raise MissingLibraryError(
                f"{path}: reading ROS recordings needs the rosbags package ({error}); 'pip install flowlab[ros]'"
            ) from error
        _check_files(path)
        limit_decompression()
        try:
            with limited_memory():
                self._reader, self.unread = open_reader(path)
                self._counts = {topic: int(about.msgcount) for topic, about in self._reader.topics.items()}
        except Exception as error:  # rosbags lets through what its parsers raise
            raise DataError(f"{path}: is no readable ROS recording ({_words(error)})") from error

    def files(self) -> tuple[str, ...]:
        """The files of a folder that are read: those that its ``metadata.yaml`` names, and this."""
        if not self.path.is_dir():
            return (self.path.name,)
        return ("metadata.yaml", *_listed(self.path))

    def topics(self, *types: str) -> dict[str, int]:
        """Topics that hold messages of these types, with how many."""
        found: dict[str, int] = {}
        for c in self._reader.connections:
            if c.msgtype in types and c.topic not in self.unread and self._counts.get(c.topic):
                found[c.topic] = self._counts[c.topic]
        return dict(sorted(found.items()))

    def types(self) -> dict[str, str]:
        """The type of every topic that can be read."""
        return {c.topic: c.msgtype for c in self._reader.connections if c.topic not in self.unread}

    def first(self, topic: str) -> Any:
        """The first message of a topic."""
        if topic in self.unread:
            raise DataError(f"{self.path}: {cut(topic)} cannot be read ({cut(self.unread[topic])})")
        message = next((message for _, message in self.messages(topic)), None)
        if message is None:
            raise DataError(f"{self.path}: the topic {topic} holds no messages; choose another with 'topics'")
        return message

    def encoding(self, topic: str) -> str:
        """How the pictures of a topic are encoded."""
        message = self.first(topic)
        return cut(str(getattr(message, "encoding", getattr(message, "format", ""))))

    def messages(
        self, topic: str, start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[tuple[int, Any]]:
        """Time of recording [ns] and content of the messages of a topic."""
        for time_ns, message, _ in self._all(topic, start_ns, stop_ns):
            yield time_ns, message

    def _all(
        self, topic: str, start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[tuple[int, Any, str]]:
        """Time of recording [ns] and content of the messages of a topic, and through which connection each came."""
        messages = self._reader.messages(self._connections(topic), start_ns, stop_ns)
        while (message := self._next(topic, messages)) is not None:
            yield message

    def _next(self, topic: str, messages: Iterator[tuple[Any, int, bytes]]) -> tuple[int, Any, str] | None:
        """The next message, as :meth:`_all` gives it; None after the last."""
        try:
            with limited_memory():
                found = next(messages, None)
                if found is None:
                    return None
                node = getattr(found[0].ext, "callerid", None) or f"connection {found[0].id}"
                return found[1], self._reader.deserialize(found[2], found[0].msgtype), node
        except DataError:
            raise
        except Exception as error:
            raise DataError(f"{self.path}: {cut(topic)} cannot be read ({_words(error)})") from error

    def index(self, topic: str) -> BagIndex:
        """When every message of a topic is from."""
        recorded, measured, sent = [], [], []
        for time_ns, message, connection in self._all(topic):
            recorded.append(time_ns)
            measured.append(stamp_s(message))
            sent.append(who_sent(message, connection))
        times = np.array(recorded, np.int64)
        fresh = np.append(True, times[1:] != times[:-1])
        nth = np.arange(len(times)) - np.flatnonzero(fresh)[np.cumsum(fresh) - 1]
        return BagIndex(times, nth, np.array([np.nan if m is None else m for m in measured]), tuple(sent))

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


def _words(error: BaseException) -> str:
    """What an error says, on one line."""
    return cut(" ".join(str(error).split())) or type(error).__name__


def _check_files(path: Path) -> None:
    """Refuse devices and pipes, and a ``metadata.yaml`` that stands for more than anybody writes."""
    if not path.is_dir():
        check_regular(path, MAX_ARRAY_BYTES)
        return
    for name in _listed(path):
        if (path / name).exists():
            check_regular(path / name, MAX_ARRAY_BYTES)


def _listed(folder: Path) -> list[str]:
    """The files that ``metadata.yaml`` names, of which rosbags reads nothing but those beside it."""
    try:
        about = parse_yaml(read_text(folder / "metadata.yaml", _MAX_METADATA_BYTES))
        return [PurePath(name).name for name in about["rosbag2_bagfile_information"]["relative_file_paths"]]
    except ValueError as error:
        raise DataError(f"{folder / 'metadata.yaml'}: not valid YAML ({first_line(error)})") from error
    except (KeyError, TypeError):
        return []
