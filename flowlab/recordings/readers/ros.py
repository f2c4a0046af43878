"""ROS 1 bags and ROS 2 recordings (mcap, db3), through the ``rosbags`` package."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from flowlab.errors import DataError
from flowlab.recordings.base import ImageStream, SampleStream, Streams
from flowlab.recordings.intrinsics import Intrinsics
from flowlab.recordings.metadata import FILE_NAME, Metadata, Topics
from flowlab.recordings.poses import pose_stream
from flowlab.recordings.readers.joint_states import JointGroup, join_by_name
from flowlab.recordings.readers.realsense import is_sdk_bag
from flowlab.recordings.readers.ros_bag import BagIndex, RosBag
from flowlab.recordings.readers.ros_messages import (
    decode_image,
    depth_unit_of,
    intrinsics_of,
    is_color,
    is_depth,
    message_numbers,
    relative_pose,
)
from flowlab.recordings.readers.ros_poses import read_pose_topic
from flowlab.recordings.sample_files import to_float32
from flowlab.recordings.stamps import Timing
from flowlab.recordings.verdicts import Check, Verdict
from flowlab.text import cut, shown

IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
INFO = "sensor_msgs/msg/CameraInfo"
JOINTS = "sensor_msgs/msg/JointState"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
REGISTERED = ("aligned_depth", "depth_registered", "depth_to_rgb", "depth_to_color")
"""What the topics of depth that is seen from the color camera are called."""
COMPRESSED = ("compressed", "compressedDepth")
SDK_UNIT = "/option/Depth_Units/value"
_ALIKE = 0.01
"""Intrinsics are the same where they differ by less than this, of the focal length."""


class ROSReader:
    """Reads one RGB-D camera, and the robot, from a recording of ROS."""

    name = "ros"
    expects = "a ROS .bag, .mcap or .db3 file (the RealSense SDK's .db3 too), or the folder of a ROS 2 recording"
    fallback = False

    def probe(self, path: Path) -> bool:
        """Whether it is a recording of ROS, and none of the RealSense SDK."""
        if path.is_dir():
            return (path / "metadata.yaml").is_file() and any(
                f.name.endswith((".mcap", ".db3", ".mcap.zstd", ".db3.zstd")) for f in path.iterdir()
            )
        known = path.suffix in (".mcap", ".db3") or (path.suffix == ".bag" and not is_sdk_bag(path))
        return known and path.is_file()

    def read(self, path: Path, given: Metadata) -> Streams:
        """The streams. Topics are found by type, encoding and name, or as ``topics`` says."""
        bag = RosBag(path)
        topics = choose_topics(bag, given)
        indices = {topic: bag.index(topic) for topic in dict.fromkeys(topics.all())}
        streams = {t: _Topic(bag, t, i) for t, i in indices.items()}
        registered, known, told = _calibration(bag, topics, given)
        checks = [Check("topics", Verdict.OK, f"read are {', '.join(topics.all())}"), *told]
        robot: dict[str, tuple[SampleStream, ...]] = {}
        for what, topic in (("state", topics.state), ("action", topics.action)):
            robot[what], told = ((), []) if topic is None else streams[topic].samples(what)
            checks += told
        checks += _unchosen(bag, topics)
        poses = None
        if topics.T_world_cam is not None:
            of = streams[topics.T_world_cam]
            T, check = read_pose_topic(bag, of.name, bag.first(topics.color).header.frame_id, _static(bag))
            poses = pose_stream(of.name, of.index.measured_s, T, of.timing())
            checks.append(check)
        return Streams(
            streams[topics.color].pictures(),
            streams[topics.depth].pictures(),
            state=robot["state"],
            action=robot["action"],
            known=(*known, _unit(bag, topics.depth)),
            registered=registered,
            checks=tuple(checks),
            poses=poses,
            used=bag.files(),
        )


def _static(bag: RosBag) -> list[Any]:
    """The transforms that never change."""
    return [t for topic in bag.topics(TRANSFORMS) if topic.endswith("tf_static")
            for _, message in bag.messages(topic) for t in message.transforms]  # fmt: skip


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
    first = {topic: bag.first(topic) for topic in images if topic not in (asked.color, asked.depth)}
    colors = [t for t in first if is_color(first[t]) and "infra" not in t]
    depths = [t for t in first if is_depth(first[t])]
    color = asked.color or _one(bag, "color", _prefer(colors, ("color", "rgb")), images)
    beside = [t for t in depths if _camera(t) == _camera(color)]
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
        if topic not in types:
            raise DataError(f"{bag.path}: has no topic '{topic}' ({what}); it has {', '.join(sorted(types)) or 'none'}")
        expected = {"color": IMAGES, "depth": IMAGES, "color_info": (INFO,), "depth_info": (INFO,)}.get(what)
        if expected is not None and types[topic] not in expected:
            raise DataError(f"{bag.path}: the topic {topic} ({what}) holds {types[topic]}, expected {expected[0]}")
        bag.first(topic)


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
        raise DataError(f"{bag.path}: no topic is known as {what}; it has {every}; name one in {where}: "
                        f"'topics: {{{what}: ...}}'")  # fmt: skip
    some = ", ".join(f"{t} ({counts[t]} pictures)" for t in topics)
    raise DataError(
        f"{bag.path}: {len(topics)} topics may be {what}: {some}; choose one in {where}: "
        f"'topics: {{{what}: {topics[0]}}}'"
    )


def _camera(topic: str) -> str:
    """The namespace of a camera's topics."""
    return topic.strip("/").partition("/")[0]


def _info_of(topic: str, infos: Mapping[str, int]) -> str | None:
    """The CameraInfo that is published beside a topic."""
    last = topic.rpartition("/")[2]
    beside = (topic.rpartition("/")[0] if last in COMPRESSED else topic).rpartition("/")[0] + "/camera_info"
    return beside if beside in infos else None


def _calibration(
    bag: RosBag, topics: ChosenTopics, given: Metadata
) -> tuple[bool | None, list[tuple[str, Metadata]], list[Check]]:
    """Whether depth is registered, what CameraInfo and static transforms tell, and what was looked at.

    What the user gives is not asked of the recording, so that it may be wrong there.
    """
    frames = [bag.first(t).header.frame_id for t in (topics.color, topics.depth)]
    known: dict[str, Intrinsics | None] = {}
    for what, info, topic in (("color", topics.color_info, topics.color), ("depth", topics.depth_info, topics.depth)):
        known[what] = None if info is None else _asked(bag, info, topic, given, what)
    registered, check = _registered(topics, frames, known["color"], known["depth"])
    found: list[tuple[str | None, dict[str, Any]]] = [(topics.color_info, {"intrinsics": known["color"]})]
    if registered is False:
        found.append((topics.depth_info, {"depth_intrinsics": known["depth"]}))
        # Cameras that see differently and yet are said to be one and the same are not where that says.
        T_color_depth = None if frames[0] == frames[1] else relative_pose(_static(bag), *frames)
        found.append(("/tf_static", {"T_color_depth": None if T_color_depth is None else T_color_depth.tolist()}))
    return registered, [(name, Metadata(**values)) for name, values in found if name is not None], [check]


def _asked(bag: RosBag, info: str, topic: str, given: Metadata, what: str) -> Intrinsics | None:
    """The intrinsics that a CameraInfo tells, where the user does not."""
    own = given.intrinsics if what == "color" else given.depth_intrinsics
    return own if own is not None else intrinsics_of(bag.first(info), topic)


def _registered(
    topics: ChosenTopics, frames: Sequence[str], color: Intrinsics | None, depth: Intrinsics | None
) -> tuple[bool | None, Check]:
    """Whether depth is seen from the color camera, by the names of topic and frames and by what both cameras are."""
    differ = color is not None and depth is not None and not _alike(color, depth)
    name = next((name for name in REGISTERED if name in topics.depth), None)
    if name is not None and differ:
        says = (f"{topics.depth} is called {name}, but {topics.depth_info} tells of another camera "
                f"({_words(depth)}) than {topics.color_info} ({_words(color)}); choose another topic with "
                "'topics: {depth: ...}', or give 'depth_intrinsics' and 'T_color_depth'")  # fmt: skip
        return True, Check("camera_info", Verdict.REFUSED, says)
    if name is not None:
        return True, Check("camera_info", Verdict.OK, f"{topics.depth} is registered to color, as its name says")
    if not frames[0] == frames[1] != "":
        says = f"color is seen from frame '{shown(frames[0])}', depth from '{shown(frames[1])}'"
        return False, Check("camera_info", Verdict.OK, says)
    where = f"color and depth are both in frame '{shown(frames[0])}'"
    if differ:
        says = f"{where}, but seen by different cameras: {_words(depth)} and {_words(color)}; not taken as registered"
        return False, Check("camera_info", Verdict.OK, says)
    if depth is None or color is None:
        return None, Check("camera_info", Verdict.ASSUMED, f"{where}; whether by the same camera is not told")
    return True, Check("camera_info", Verdict.OK, f"{where}, with the same intrinsics")


def _alike(a: Intrinsics, b: Intrinsics) -> bool:
    """Whether two cameras see the same, up to the size of their pictures."""
    scale = (a.width or b.width or 1) / (b.width or a.width or 1)
    at = np.array([[c.fx, c.fy, c.cx, c.cy] for c in (a, b)]) * [[1], [scale]]
    return bool(np.abs(at[0] - at[1]).max() < _ALIKE * at[0, 0])


def _words(camera: Intrinsics | None) -> str:
    return "" if camera is None else f"fx {camera.fx:.5g}, cx {camera.cx:.5g}, cy {camera.cy:.5g}"


def _unit(bag: RosBag, depth: str) -> tuple[str, Metadata]:
    """The unit of depth: what the RealSense SDK's ``.db3`` files say of the device, else the custom of ROS."""
    for topic in bag.topics("std_msgs/msg/String", "std_msgs/msg/Float32"):
        if topic.endswith(SDK_UNIT) and _camera(topic) == _camera(depth):
            return topic, Metadata(depth_unit_m=float(bag.first(topic).data))
    return "the custom of ROS (REP 118)", Metadata(depth_unit_m=depth_unit_of(bag.first(depth)))


def _unchosen(bag: RosBag, topics: ChosenTopics) -> list[Check]:
    """A doubt where several topics may be the state, and none of them is taken."""
    joints = list(bag.topics(JOINTS))
    if topics.state is not None or not joints:
        return []
    says = f"none is taken, for several topics may be it: {cut(', '.join(joints))}; choose one with 'topics: {{state: ...}}'"  # noqa: E501
    return [Check("state", Verdict.DOUBTFUL, says)]


@dataclass(frozen=True, slots=True)
class _Topic:
    """A topic in the order of recording."""

    bag: RosBag
    name: str
    index: BagIndex

    def timing(self) -> Timing:
        """What is known of its stamps, which ROS has in seconds."""
        return Timing(f"the stamps of {self.name}", overtaking=True, recorded_s=self.index.recorded_ns * 1e-9)

    def pictures(self) -> ImageStream:
        """Its messages as pictures."""
        names = tuple(f"{self.name}[{i}]" for i in range(len(self.index.measured_s)))
        return ImageStream(names, self.index.measured_s, partial(_picture, self), self.timing())

    def samples(self, what: str) -> tuple[tuple[SampleStream, ...], list[Check]]:
        """Its messages as rows of numbers, and what is to be said of them; joints by their names."""
        messages = [message for _, message in self.bag.messages(self.name)]
        place = f"{self.bag.path}: {self.name}"
        if self.bag.types()[self.name] == JOINTS and any(len(m.position) for m in messages):
            groups, checks = join_by_name(place, messages)
            _check_unnamed(place, what, groups)
        else:
            groups, checks = [_unnamed(place, what, messages)], []
        streams = []
        for k, group in enumerate(groups):
            name, timing = what if k == 0 else f"{what} {k + 1}", self.timing()
            assert timing.recorded_s is not None
            timing = replace(timing, recorded_s=timing.recorded_s[group.messages])
            stamps = self.index.measured_s[group.messages]
            streams.append(SampleStream(name, stamps, group.positions, timing, columns=group.names))
        return tuple(streams), checks


def _unnamed(place: str, what: str, messages: Sequence[Any]) -> JointGroup:
    """Numbers that have no names, in their order in the messages; those that are not finite are left out."""
    rows = [message_numbers(message) for message in messages]
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
    return JointGroup((), np.flatnonzero(whole), values)


def _check_unnamed(place: str, what: str, groups: Sequence[JointGroup]) -> None:
    """Refuse joints without names beside others: nothing tells which they are."""
    if len(groups) > 1 and not all(g.names for g in groups):
        widths = " or ".join(str(g.positions.shape[1]) for g in groups)
        raise DataError(
            f"{place}: the messages hold {widths} numbers, and not all name their joints, expected the same number of "
            f"each; choose another topic, or none, with 'topics: {{{what}: ...}}'"
        )


def _picture(topic: _Topic, i: int) -> np.ndarray:
    """Decode the i-th picture of a topic in the order of recording."""
    return decode_image(topic.bag.message(topic.name, topic.index, i))
