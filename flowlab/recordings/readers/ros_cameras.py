"""The cameras of a ROS recording: what they are, and whether depth is seen from the color camera."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from flowlab.recordings.intrinsics import Intrinsics
from flowlab.recordings.readers.ros_bag import RosBag
from flowlab.recordings.readers.ros_camera_info import intrinsics_over_time
from flowlab.recordings.readers.ros_messages import depth_unit_of, relative_pose
from flowlab.recordings.readers.ros_topics import REGISTERED, ChosenTopics, camera_of, of_two_cameras
from flowlab.recordings.recording_yaml import Metadata
from flowlab.recordings.verdicts import Check, Verdict
from flowlab.text import shown

TRANSFORMS = "tf2_msgs/msg/TFMessage"
SDK_UNIT = "/option/Depth_Units/value"
_ALIKE = 0.01
"""Intrinsics are the same where they differ by less than this, of the focal length."""


def find_calibration(
    bag: RosBag, topics: ChosenTopics, given: Metadata
) -> tuple[bool | None, list[tuple[str, Metadata]], list[Check]]:
    """Whether depth is registered, what CameraInfo and static transforms tell, and what was looked at.

    What the user gives is not asked of the recording, so that it may be wrong there.
    """
    frames = [bag.first(t).header.frame_id for t in (topics.color, topics.depth)]
    known: dict[str, Intrinsics | None] = {}
    checks: list[Check] = []
    for what, info, topic, own, about in (
        ("color", topics.color_info, topics.color, given.intrinsics, "intrinsics"),
        ("depth", topics.depth_info, topics.depth, given.depth_intrinsics, "depth_intrinsics"),
    ):
        known[what], told = (None, []) if info is None else intrinsics_over_time(bag, info, topic, own, about)
        checks += told
    registered, check = _registered(topics, frames, known["color"], known["depth"])
    if registered is not False and of_two_cameras(topics.color, topics.depth):
        check = _of_two(topics, check, given.topics.color is not None and given.topics.depth is not None)
    found: list[tuple[str | None, dict[str, Any]]] = [(topics.color_info, {"intrinsics": known["color"]})]
    if registered is False:
        found.append((topics.depth_info, {"depth_intrinsics": known["depth"]}))
        # Cameras that see differently and yet are said to be one and the same are not where that says.
        T_color_depth = None if frames[0] == frames[1] else relative_pose(static_transforms(bag), *frames)
        found.append(("/tf_static", {"T_color_depth": None if T_color_depth is None else T_color_depth.tolist()}))
    return registered, [(name, Metadata(**values)) for name, values in found if name is not None], [check, *checks]


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
    if name is not None and camera_of(topics.color) != camera_of(topics.depth) and frames[0] != frames[1]:
        says = (f"{topics.depth} is called {name}, but is of frame {shown(frames[1])} and {topics.color} of frame "
                f"{shown(frames[0])}: of two cameras, it seems; choose the topics of one with 'topics'")  # fmt: skip
        return True, Check("camera_info", Verdict.DOUBTFUL, says)
    if name is not None:
        return True, Check("camera_info", Verdict.OK, f"{topics.depth} is registered to color, as its name says")
    if not frames[0] == frames[1] != "":
        says = f"color is seen from frame {shown(frames[0])}, depth from {shown(frames[1])}"
        return False, Check("camera_info", Verdict.OK, says)
    where = f"color and depth are both in frame {shown(frames[0])}"
    if differ:
        says = f"{where}, but seen by different cameras: {_words(depth)} and {_words(color)}; not taken as registered"
        return False, Check("camera_info", Verdict.OK, says)
    if depth is None or color is None:
        return None, Check("camera_info", Verdict.ASSUMED, f"{where}; whether by the same camera is not told")
    return True, Check("camera_info", Verdict.OK, f"{where}, with the same intrinsics")


def _of_two(topics: ChosenTopics, found: Check, stated: bool) -> Check:
    """What is said of topics whose names tell two cameras, though depth is taken as seen from the color camera."""
    says = f"{found.says}; but {topics.color} and {topics.depth} are of two cameras, by their names"
    if found.verdict.severity >= Verdict.DOUBTFUL.severity:
        return found
    if stated:
        return Check("camera_info", Verdict.ASSUMED, f"{says}, and chosen with 'topics'")
    says += "; choose those of one, or say so of these, with 'topics: {color: ..., depth: ...}'"
    return Check("camera_info", Verdict.DOUBTFUL, says)


def _alike(a: Intrinsics, b: Intrinsics) -> bool:
    """Whether two cameras see the same, up to the size of their pictures."""
    scale = (a.width or b.width or 1) / (b.width or a.width or 1)
    at = np.array([[c.fx, c.fy, c.cx, c.cy] for c in (a, b)]) * [[1], [scale]]
    return bool(np.abs(at[0] - at[1]).max() < _ALIKE * at[0, 0])


def _words(camera: Intrinsics | None) -> str:
    return "" if camera is None else f"fx {camera.fx:.5g}, cx {camera.cx:.5g}, cy {camera.cy:.5g}"


def find_unit(bag: RosBag, depth: str) -> tuple[str, Metadata]:
    """The unit of depth: what the RealSense SDK's ``.db3`` files say of the device, else the custom of ROS."""
    for topic in bag.topics("std_msgs/msg/String", "std_msgs/msg/Float32"):
        if topic.endswith(SDK_UNIT) and camera_of(topic) == camera_of(depth):
            return topic, Metadata(depth_unit_m=float(bag.first(topic).data))
    return "the custom of ROS (REP 118)", Metadata(depth_unit_m=depth_unit_of(bag.first(depth)))


def static_transforms(bag: RosBag) -> list[Any]:
    """The transforms that never change."""
    return [t for topic in bag.topics(TRANSFORMS) if topic.endswith("tf_static")
            for _, message in bag.messages(topic) for t in message.transforms]  # fmt: skip
