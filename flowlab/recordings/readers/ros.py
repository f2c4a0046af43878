"""ROS 1 bags and ROS 2 recordings (mcap, db3), through the ``rosbags`` package."""

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from flowlab.errors import DataError
from flowlab.recordings.base import ImageStream, SampleStream, Streams
from flowlab.recordings.poses import pose_stream
from flowlab.recordings.readers.publishers import counted, tell_apart
from flowlab.recordings.readers.realsense import is_sdk_bag
from flowlab.recordings.readers.ros_bag import BagIndex, RosBag
from flowlab.recordings.readers.ros_cameras import find_calibration, find_unit, static_transforms
from flowlab.recordings.readers.ros_messages import decode_image
from flowlab.recordings.readers.ros_poses import TYPES as POSES
from flowlab.recordings.readers.ros_poses import read_pose_topic
from flowlab.recordings.readers.ros_samples import group_samples
from flowlab.recordings.readers.ros_topics import IMAGES, JOINTS, ChosenTopics, choose_topics
from flowlab.recordings.recording_yaml import Metadata
from flowlab.recordings.stamps import Timing
from flowlab.recordings.verdicts import Check, Verdict
from flowlab.text import cut


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
        registered, known, told = find_calibration(bag, topics, given)
        checks = [Check("topics", Verdict.OK, f"read are {', '.join(topics.all())}"), *told]
        robot: dict[str, tuple[SampleStream, ...]] = {}
        for what, topic in (("state", topics.state), ("action", topics.action)):
            robot[what], told = ((), []) if topic is None else streams[topic].samples(what)
            checks += told
        checks += [*_unchosen(bag, topics), *_unread(bag), *_unused(bag, topics)]
        poses = None
        if topics.T_world_cam is not None:
            of = streams[topics.T_world_cam]
            T, check = read_pose_topic(bag, of.name, bag.first(topics.color).header.frame_id, static_transforms(bag))
            poses = pose_stream(of.name, of.index.measured_s, T, of.timing())
            checks.append(check)
        return Streams(
            streams[topics.color].pictures(),
            streams[topics.depth].pictures(),
            state=robot["state"],
            action=robot["action"],
            known=(*known, find_unit(bag, topics.depth)),
            registered=registered,
            checks=tuple(checks),
            used=bag.files(),
            poses=poses,
        )


def _unread(bag: RosBag) -> list[Check]:
    """The topics whose messages cannot be read, with the reason; a doubt where one could have been chosen."""
    if not bag.unread:
        return []
    says = "; ".join(f"{cut(topic)} ({cut(why)})" for topic, why in sorted(bag.unread.items()))
    wanted = any(kind in why for why in bag.unread.values() for kind in (*IMAGES, JOINTS))
    says = f"{says}: not used, for the messages cannot be read"
    return [Check("unread topics", Verdict.DOUBTFUL if wanted else Verdict.OK, says)]


def _unused(bag: RosBag, topics: ChosenTopics) -> list[Check]:
    """The topics that nothing uses; a doubt where they hold poses, and there are no others."""
    used = {*topics.all(), topics.color_info, topics.depth_info}
    kinds = {topic: kind for topic, kind in sorted(bag.types().items()) if topic not in used}
    says = ", ".join(f"{topic} ({kind.rpartition('/')[2]})" for topic, kind in kinds.items())
    poses = [topic for topic, kind in kinds.items() if kind in POSES]
    if poses and topics.state is None and topics.T_world_cam is None:
        says = (f"{cut(', '.join(poses))} hold poses and are not used; if one is the state, or the pose of a camera "
                f"that moves, write 'topics: {{state: {poses[0]}}}' or "
                f"'topics: {{T_world_cam: {poses[0]}}}'")  # fmt: skip
        return [Check("unused topics", Verdict.DOUBTFUL, says)]
    return [Check("unused topics", Verdict.OK, cut(says, 600) or "every topic is used")]


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
        """Its messages as pictures. Raises :class:`DataError` where they are of several cameras."""
        apart = tell_apart(self.index.sent)
        if apart is not None:
            says = f"told apart by {apart[1]} ({counted(apart[0])} pictures), expected one"
            raise DataError(f"{self.bag.path}: several cameras publish on {self.name} in turn, {says}; record each on "
                            "a topic of its own")  # fmt: skip
        names = tuple(f"{self.name}[{i}]" for i in range(len(self.index.measured_s)))
        return ImageStream(names, self.index.measured_s, partial(_picture, self), self.timing())

    def samples(self, what: str) -> tuple[tuple[SampleStream, ...], list[Check]]:
        """Its messages as rows of numbers, and what is to be said of them; joints by their names."""
        messages = [message for _, message in self.bag.messages(self.name)]
        joints = self.bag.types()[self.name] == JOINTS
        groups, checks = group_samples(f"{self.bag.path}: {self.name}", what, messages, self.index.sent, joints)
        streams = []
        for k, group in enumerate(groups):
            name, timing = what if k == 0 else f"{what} {k + 1}", self.timing()
            assert timing.recorded_s is not None
            timing = replace(timing, recorded_s=timing.recorded_s[group.messages])
            stamps = self.index.measured_s[group.messages]
            streams.append(SampleStream(name, stamps, group.positions, timing, columns=group.names))
        return tuple(streams), checks


def _picture(topic: _Topic, i: int) -> np.ndarray:
    """Decode the i-th picture of a topic in the order of recording."""
    return decode_image(topic.bag.message(topic.name, topic.index, i))
