"""The poses of a camera that moves, from the topic that the user names."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float64

from flowlab.errors import DataError
from flowlab.recordings.poses import ABOUT, check_poses
from flowlab.recordings.readers.ros_bag import RosBag
from flowlab.recordings.readers.ros_messages import pose_of, relative_pose
from flowlab.recordings.verdicts import Check, Verdict
from flowlab.text import cut, shown

TYPES = (
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
    "nav_msgs/msg/Odometry",
)


def read_pose_topic(
    bag: RosBag, topic: str, camera: str, static: Sequence[Any]
) -> tuple[Float64[np.ndarray, "N 4 4"], Check]:
    """``T_world_cam`` by the messages of a topic, and what is to be said of the frames.

    Args:
        bag: The recording.
        topic: The topic.
        camera: The frame of the color camera.
        static: The transforms that never change.

    Raises:
        DataError: The topic holds no poses, or poses of several frames.
    """
    place, kind = f"{bag.path}: {topic}", bag.types()[topic]
    if kind not in TYPES:
        raise DataError(f"{place} (T_world_cam) holds {kind}, expected {' or '.join(TYPES)}")
    try:
        found = [pose_of(message) for _, message in bag.messages(topic)]
    except (ValueError, AttributeError) as error:
        raise DataError(f"{place} holds what is no pose ({cut(str(error))})") from error
    frames = {(world, child) for _, world, child in found}
    if len(frames) > 1:
        some = cut(", ".join(sorted(f"{w} to {c}" if c else w for w, c in frames)))
        raise DataError(f"{place} has poses of several frames ({some}), expected those of one; choose another topic")
    ((world, child),) = frames
    T = check_poses(place, np.stack([T for T, _, _ in found]))
    says = f"{topic} tells poses in frame {shown(world)}"
    if child.lstrip("/") == camera.lstrip("/") != "":
        return T, Check(ABOUT, Verdict.OK, f"{says} of {shown(child)}, the frame of the color pictures")
    T_child_cam = relative_pose(static, child, camera) if child and camera else None
    if T_child_cam is not None:
        says = f"{says} of {shown(child)}; static transforms lead from there to {shown(camera)}, the frame of the color pictures"  # noqa: E501
        return T @ T_child_cam, Check(ABOUT, Verdict.OK, says)
    of = f"of {shown(child)}, which nothing links to" if child else "and not of which; taken as of"
    says = f"{says} {of} {shown(camera)}, the frame of the color pictures (x right, y down, z forward)"
    return T, Check(ABOUT, Verdict.ASSUMED, says)
