"""Which topics of a ROS recording are read: those of one camera and of the robot, by type, encoding and name."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from flowlab.errors import DataError
from flowlab.recordings.readers.ros_bag import RosBag
from flowlab.recordings.readers.ros_messages import CONVERT, is_color, is_depth, is_read
from flowlab.recordings.recording_yaml import FILE_NAME, Metadata, Topics
from flowlab.text import counted

IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
INFO = "sensor_msgs/msg/CameraInfo"
JOINTS = "sensor_msgs/msg/JointState"
REGISTERED = ("aligned_depth", "depth_registered", "depth_to_rgb", "depth_to_color")
"""What the topics of depth that is seen from the color camera are called."""
_OF_STREAMS = re.compile(
    r"(rgb|colou?r|depth|ir|infra\d*|mono|gray|image|img|video|stereo|aligned|registered|registration|to|sw|hw|raw|rect|"
    r"rectified|undistorted|compressed|compresseddepth|preview|isp|node|\d)"
)
"""Words that tell the pictures of one camera apart."""
COMPRESSED = ("compressed", "compressedDepth")


@dataclass(frozen=True, slots=True)
class ChosenTopics:
    """The topics that are read."""

    color: str
    depth: str
    state: str | None
    action: str | None
    color_info: str | None
    depth_info: str | None
    T_world_cam: str | None

    def all(self) -> list[str]:
        """Those with a message per instant."""
        return [t for t in (self.color, self.depth, self.state, self.action, self.T_world_cam) if t is not None]


def choose_topics(bag: RosBag, given: Metadata) -> ChosenTopics:
    """The topics of one camera and of the robot. Raises :class:`DataError` with the choices where several fit."""
    asked = given.topics
    _check_asked(bag, asked)
    images = bag.topics(*IMAGES)
    first = _first_of(bag, [topic for topic in images if topic not in (asked.color, asked.depth)])
    colors = [t for t in first if is_color(first[t]) and "infra" not in t]
    depths = [t for t in first if is_depth(first[t])]
    color = asked.color or _one(bag, "color", _prefer(colors, ("color", "rgb")), images)
    beside = [t for t in depths if camera_of(t) == camera_of(color)]
    depth = asked.depth or _one(bag, "depth", _prefer(beside or depths, REGISTERED), images)
    joints = list(bag.topics(JOINTS))
    infos = bag.topics(INFO)
    return ChosenTopics(
        color,
        depth,
        asked.state or (joints[0] if len(joints) == 1 else None),
        asked.action,
        asked.color_info or _info_of(color, infos),
        asked.depth_info or _info_of(depth, infos),
        asked.T_world_cam,
    )


def _check_asked(bag: RosBag, asked: Topics) -> None:
    """Refuse topics that do not exist, hold something else, or are empty."""
    types = bag.types()
    for what, topic in asked.model_dump(exclude_none=True).items():
        if topic not in types and topic not in bag.unread:
            raise DataError(f"{bag.path}: has no topic '{topic}' ({what}); it has {', '.join(sorted(types)) or 'none'}")
        expected = {"color": IMAGES, "depth": IMAGES, "color_info": (INFO,), "depth_info": (INFO,)}.get(what)
        if expected is not None and types.get(topic, expected[0]) not in expected:
            raise DataError(f"{bag.path}: the topic {topic} ({what}) holds {types[topic]}, expected {expected[0]}")
        bag.first(topic)


def _first_of(bag: RosBag, topics: Sequence[str]) -> dict[str, Any]:
    """The first message of each of some topics; one that cannot be read is no choice."""
    found = {}
    for topic in topics:
        try:
            found[topic] = bag.first(topic)
        except DataError as error:
            bag.unread[topic] = str(error)
    return found


def _prefer(topics: Sequence[str], names: Sequence[str]) -> list[str]:
    """Those with one of the names, where there are any; of a picture sent twice, the one not compressed."""
    named = [t for t in topics if any(n in t.lower() for n in names)] or list(topics)
    return [t for t in named if not (t.rpartition("/")[2] in COMPRESSED and t.rpartition("/")[0] in named)]


def _one(bag: RosBag, what: str, topics: Sequence[str], counts: Mapping[str, int]) -> str:
    """The only topic; several, or none, are refused with the choices."""
    if len(topics) == 1:
        return topics[0]
    where = f"{bag.path.with_suffix('.yaml').name if bag.path.is_file() else FILE_NAME} or the calibration file"
    if not topics:
        kinds = bag.types() | {t: f"{bag.encoding(t)} pictures" for t in counts}
        every = ", ".join(f"{t} ({kind})" for t, kind in sorted(kinds.items())) or "no topic"
        unread = [t for t in counts if not is_read(bag.first(t))]
        encodings = ", ".join(sorted({bag.encoding(t) for t in unread}))
        advice = f"{encodings} is not read: {CONVERT}; else " if unread else ""
        raise DataError(f"{bag.path}: no topic is known as {what}; it has {every}; {advice}name one in {where}: "
                        f"'topics: {{{what}: ...}}'")  # fmt: skip
    some = ", ".join(f"{t} ({counted(counts[t], 'picture')})" for t in topics)
    raise DataError(
        f"{bag.path}: {len(topics)} topics may be {what}: {some}; choose one in {where}: "
        f"'topics: {{{what}: {topics[0]}}}'"
    )


def camera_of(topic: str) -> str:
    """The namespace of a camera's topics."""
    return topic.strip("/").partition("/")[0]


def of_two_cameras(color: str, depth: str) -> bool:
    """Whether two topics are of two cameras by their names: each has a word before the last that the other lacks."""
    a, b = (_words_of(topic.rpartition("/")[0]) for topic in (color, depth))
    return bool(a - b and b - a)


def _words_of(path: str) -> set[str]:
    """The words of a topic's path that do not say which picture of a camera it is."""
    words = re.split(r"[_\W]+", re.sub(r"/sensor_\d+", "", path.lower()))
    return {word for word in words if word and not _OF_STREAMS.fullmatch(word)}


def _info_of(topic: str, infos: Mapping[str, int]) -> str | None:
    """The CameraInfo that is published beside a topic."""
    last = topic.rpartition("/")[2]
    beside = (topic.rpartition("/")[0] if last in COMPRESSED else topic).rpartition("/")[0] + "/camera_info"
    return beside if beside in infos else None
