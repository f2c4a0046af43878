"""What ROS messages mean, whichever of ROS 1 and 2 they come from."""

from collections.abc import Iterable
from typing import Any

import cv2
import numpy as np

from flowlab.geometry.transforms import inverse, rigid
from flowlab.limits import MAX_PIXELS
from flowlab.recordings.base import BadImage
from flowlab.recordings.image_files import check_depth, decode_color, decode_depth
from flowlab.text import shown

_CHANNELS = {
    "rgb8": (np.uint8, 3), "bgr8": (np.uint8, 3), "rgba8": (np.uint8, 4), "bgra8": (np.uint8, 4),
    "8UC3": (np.uint8, 3), "mono8": (np.uint8, 1), "8UC1": (np.uint8, 1),
    "mono16": (np.uint16, 1), "16UC1": (np.uint16, 1), "32FC1": (np.float32, 1),
}  # fmt: skip
"""Type and channels of the encodings that are read."""
CONVERT = "convert color to rgb8 (image_proc does), depth to 16UC1 or 32FC1"
_TO_RGB = {
    "bgr8": cv2.COLOR_BGR2RGB, "8UC3": cv2.COLOR_BGR2RGB, "bgra8": cv2.COLOR_BGRA2RGB,
    "rgba8": cv2.COLOR_RGBA2RGB, "mono8": cv2.COLOR_GRAY2RGB, "8UC1": cv2.COLOR_GRAY2RGB,
}  # fmt: skip
_PNG = b"\x89PNG\r\n\x1a\n"


def is_depth(message: Any) -> bool:
    """Whether a picture is depth, by its encoding."""
    if hasattr(message, "format"):
        return "compressedDepth" in message.format or message.format.startswith(("16UC1", "32FC1"))
    return message.encoding in ("16UC1", "mono16", "32FC1")


def is_read(message: Any) -> bool:
    """Whether a picture is of an encoding that is read."""
    return hasattr(message, "format") or message.encoding in _CHANNELS


def is_color(message: Any) -> bool:
    """Whether a picture has color, by its encoding."""
    if hasattr(message, "format"):
        return not is_depth(message)
    return message.encoding in ("rgb8", "bgr8", "rgba8", "bgra8", "8UC3")


def depth_unit_of(message: Any) -> float:
    """Meters per count of a depth picture: REP 118 says meters for floats, else millimeters."""
    encoding = message.format if hasattr(message, "format") else message.encoding
    return 1.0 if encoding.startswith("32FC1") else 0.001


def decode_image(message: Any) -> np.ndarray:
    """RGB (H, W, 3) or depth counts (H, W) of an Image or a CompressedImage."""
    if hasattr(message, "format"):
        return _decode_compressed(message)
    encoding = message.encoding
    if encoding not in _CHANNELS:
        raise BadImage(f"has the encoding {shown(encoding)}, which is not read; {CONVERT}")
    dtype, channels = _CHANNELS[encoding]
    row = message.width * channels * np.dtype(dtype).itemsize
    data = np.asarray(message.data, np.uint8)
    if not 0 < message.width * message.height <= MAX_PIXELS:
        raise BadImage(f"says it has {message.width} x {message.height} pixels, expected 1 to {MAX_PIXELS:,}")
    if message.step < row or data.size < message.height * message.step:
        raise BadImage(f"is truncated: {data.size} bytes for {message.height} rows of {message.step}")
    rows = data[: message.height * message.step].reshape(message.height, message.step)[:, :row]
    values = np.ascontiguousarray(rows).view(np.dtype(dtype).newbyteorder(">" if message.is_bigendian else "<"))
    picture = values.astype(dtype).reshape(message.height, message.width, channels)
    if is_depth(message):
        return check_depth(picture[..., 0])
    return picture if encoding == "rgb8" else cv2.cvtColor(picture, _TO_RGB[encoding])


def _decode_compressed(message: Any) -> np.ndarray:
    """RGB or depth counts of a CompressedImage."""
    content = np.asarray(message.data, np.uint8).tobytes()
    if "rvl" in message.format.lower():
        raise BadImage("is depth compressed as RVL, which is not read; record the raw topic, or with format 'png'")
    if not is_depth(message):
        return decode_color(content)
    if message.format.startswith("32FC1"):
        raise BadImage("is compressed float depth, which is not read; record the raw topic")
    begins = content.find(_PNG, 0, 64)  # a header of compressed_depth_image_transport comes first
    return decode_depth(content[max(begins, 0) :])


def stamp_s(message: Any) -> float | None:
    """When a message says it was measured [s]; None where it does not say."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    time_s = None if stamp is None else stamp.sec + stamp.nanosec * 1e-9
    return time_s or None


def message_numbers(message: Any) -> list[float]:
    """The numbers of a message in their order, its header left out; of a JointState the positions."""
    if hasattr(message, "position") and hasattr(message, "effort"):
        return list(np.asarray(message.position, float))
    numbers: list[float] = []
    for name in getattr(message, "__dataclass_fields__", ()):
        value = getattr(message, name)
        if name in ("header", "layout") or name.startswith("__"):
            continue
        if isinstance(value, bool | int | float | np.number):
            numbers.append(float(value))
        elif isinstance(value, np.ndarray) and value.dtype.kind in "fiub":
            numbers.extend(value.astype(float).ravel().tolist())
        elif hasattr(value, "__dataclass_fields__"):
            numbers.extend(message_numbers(value))
    return numbers


def relative_pose(transforms: Iterable[Any], to: str, frm: str) -> np.ndarray | None:
    """``T_to_frm`` (4, 4) through a tree of TransformStamped; None where they are not connected."""
    edges: dict[str, list[tuple[str, np.ndarray]]] = {}
    for t in transforms:
        T_parent_child = _matrix(t.transform)
        parent, child = t.header.frame_id.lstrip("/"), t.child_frame_id.lstrip("/")
        edges.setdefault(parent, []).append((child, T_parent_child))
        edges.setdefault(child, []).append((parent, inverse(T_parent_child)))
    reached = {to.lstrip("/"): np.eye(4)}
    queue = list(reached)
    while queue:
        at = queue.pop(0)
        for frame, T_at_frame in edges.get(at, ()):
            if frame not in reached:
                reached[frame] = reached[at] @ T_at_frame
                queue.append(frame)
    return reached.get(frm.lstrip("/"))


def pose_of(message: Any) -> tuple[np.ndarray, str, str]:
    """The pose (4, 4) that a message tells, the frame in which, and of which where it says so.

    Raises:
        ValueError: The message tells none.
    """
    world = message.header.frame_id if hasattr(message, "header") else ""
    child = getattr(message, "child_frame_id", "")
    if hasattr(message, "transform"):
        return _matrix(message.transform), world, child
    pose = getattr(message, "pose", message)
    pose = getattr(pose, "pose", pose)  # with covariance
    if not hasattr(pose, "orientation"):
        raise ValueError("it holds no pose")
    return _matrix(pose), world, child


def _matrix(transform: Any) -> np.ndarray:
    """A Transform or a Pose as a matrix (4, 4)."""
    q, t = (transform.orientation, transform.position) if hasattr(transform, "orientation") else (
        transform.rotation, transform.translation
    )  # fmt: skip
    length = np.linalg.norm([q.x, q.y, q.z, q.w])
    if not 1e-6 < length < 1e6:
        raise ValueError(f"the rotation {[q.x, q.y, q.z, q.w]} of a transform is none")
    x, y, z, w = np.array([q.x, q.y, q.z, q.w]) / length
    R = np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip
    return rigid(R, np.array([t.x, t.y, t.z]))
