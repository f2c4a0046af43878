"""What CameraInfo messages say of a camera: its intrinsics, for raw or rectified pictures, and whether these stay."""

import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from flowlab.config import SettingsError
from flowlab.recordings.intrinsics import Intrinsics, distortion_of
from flowlab.recordings.readers.ros_bag import RosBag
from flowlab.recordings.verdicts import Check, Verdict

_OTHER = (0.001, 0.01)
"""Intrinsics that change by these shares of the focal length are doubtful, and refused."""
_RECTIFIED = re.compile(r"(^|[/_])rect(ified)?([/_]|$)")
"""As ``image_proc`` and drivers call rectified pictures."""
_STRAIGHT = re.compile(r"undist|unwarp|dewarp|de_?fish|rectif|(?<![a-z])rect(?!ang)|corrected")
_BENT = re.compile(r"(?<![a-z])(un|non|not)_?rect|(?<!un)distorted|(?<![a-z])raw(?![a-z])")


def intrinsics_over_time(
    bag: RosBag, info: str, topic: str, given: Intrinsics | None, about: str
) -> tuple[Intrinsics | None, list[Check]]:
    """The intrinsics that all messages of a CameraInfo tell, where the user does not, and what is to be said of them.

    Args:
        bag: The recording.
        info: The topic of the CameraInfo.
        topic: That of the pictures.
        given: The intrinsics that the user says.
        about: The key of ``recording.yaml`` that they are.
    """
    told = {_key(message): message for _, message in bag.messages(info)}
    try:
        found = [camera for message in told.values() if (camera := intrinsics_of(message, topic)) is not None]
    except (SettingsError, ValueError):
        if given is None:
            raise
        return given, []
    checks = _constant(info, found, given, about)
    bent = next((message for message in told.values() if np.any(_field(message, "D"))), None)
    if given is None and found and bent is not None:
        checks.append(_rectification(topic, about))
    if given is None and not found:
        bag.first(info)  # an empty topic that was chosen is refused
    return given if given is not None else next(iter(found), None), checks


def _constant(info: str, found: Sequence[Intrinsics], given: Intrinsics | None, about: str) -> list[Check]:
    """Whether a camera stays as it is; nothing where no message says how it is."""
    if not found:
        return []
    first = found[0]
    other = max(found, key=lambda camera: _apart(first, camera))
    apart = _apart(first, other)
    if apart <= _OTHER[0]:
        return [Check(f"{about} over time", Verdict.OK, f"all messages of {info} say the same")]
    seen = [_words(camera) for camera in (first, other)]
    says = (f"{info} changes in the recording, from {seen[0]} to {seen[1]}, as of a camera that zooms or "
            f"was started anew, or of two; cut it there, or write '{about}' if one holds for all pictures")  # fmt: skip
    refused = apart > _OTHER[1] and given is None
    return [Check(f"{about} over time", Verdict.REFUSED if refused else Verdict.DOUBTFUL, says)]


def _words(camera: Intrinsics) -> str:
    """A camera in a few numbers."""
    lens = (
        "no distortion" if not camera.distortion else f"distortion {', '.join(f'{d:.3g}' for d in camera.distortion)}"
    )
    return f"{camera.width}x{camera.height}, fx {camera.fx:.5g}, cx {camera.cx:.5g}, cy {camera.cy:.5g}, {lens}"


def _apart(a: Intrinsics, b: Intrinsics) -> float:
    """How far two cameras are apart, as a share of the focal length; infinite for other pictures or lenses."""
    if (a.width, a.height, a.distortion_model) != (b.width, b.height, b.distortion_model):
        return np.inf
    bend = [np.pad(np.array(c.distortion, float), (0, 14 - len(c.distortion))) for c in (a, b)]
    at = np.array([[c.fx, c.fy, c.cx, c.cy] for c in (a, b)])
    return float(max(np.abs(at[0] - at[1]).max() / a.fx, np.abs(bend[0] - bend[1]).max() / 10))


def _key(info: Any) -> tuple[Any, ...]:
    """What tells one CameraInfo from another."""
    roi = info.roi
    numbers = (_field(info, name).tobytes() for name in "KDP")
    sizes = (info.width, info.height, info.binning_x, info.binning_y, roi.x_offset, roi.y_offset, roi.width, roi.height)
    return (*numbers, *sizes, info.distortion_model)


def _field(info: Any, name: str) -> np.ndarray:
    """Numbers by their name of ROS 1, which ROS 2 writes small."""
    return np.asarray(getattr(info, name, getattr(info, name.lower(), ())), float)


def intrinsics_of(info: Any, topic: str) -> Intrinsics | None:
    """Intrinsics of a CameraInfo, for pictures of a topic; None for a camera that was not calibrated.

    Pictures that were rectified are seen as P says, without distortion; others as K and D say. Both are of the whole
    picture, of which the topic may have a part (``roi``), or every n-th pixel (``binning``).
    """
    K, D, P = (_field(info, name) for name in "KDP")
    if K.size != 9 or not K[0] > 0:
        return None
    if not (np.isfinite(K).all() and np.isfinite(D).all()):
        raise SettingsError(f"the CameraInfo of {topic} holds what is no number; write 'intrinsics' of the pictures")
    if not rectified(topic)[0]:
        return _part(Intrinsics.from_matrix(K.reshape(3, 3), **distortion_of(info.distortion_model, D.tolist())), info)
    if P.size == 12 and P[0] > 0:
        return _part(Intrinsics.from_matrix(P.reshape(3, 4)), info)
    if np.any(D):
        raise SettingsError(f"the pictures of {topic} were rectified, and its CameraInfo has no P that says how they "
                            "are seen; write 'intrinsics' of the rectified pictures")  # fmt: skip
    return _part(Intrinsics.from_matrix(K.reshape(3, 3)), info)


def rectified(topic: str) -> tuple[bool, Verdict, str]:
    """Whether a topic's pictures were rectified, by any part of its name, and how well that is known."""
    name = topic.lower()
    if _RECTIFIED.search(name):
        return True, Verdict.OK, "were rectified, as the name says: seen as P says"
    straight, bent = (pattern.search(name) is not None for pattern in (_STRAIGHT, _BENT))
    if straight and not re.search(r"(un|non|not)_?rect", name):
        says = "were rectified, by the name: seen as P says, without distortion"
        return True, Verdict.REFUSED if bent else Verdict.ASSUMED, says
    if bent:
        return False, Verdict.OK, "were not rectified, as the name says: seen as K and D say"
    return False, Verdict.ASSUMED, "are taken as not rectified, for the name says neither: seen as K and D say"


def _rectification(topic: str, about: str) -> Check:
    """What is said of pictures whose camera has distortion."""
    _, verdict, says = rectified(topic)
    if verdict is Verdict.REFUSED:
        says = "are called both raw and rectified, and its camera has distortion"
    if verdict is not Verdict.OK:
        says += f"; write '{about}' with the 'distortion' that the pictures have ([] for none) if that is not so"
    return Check("rectified", verdict, f"the pictures of {topic} {says}")


def _part(whole: Intrinsics, info: Any) -> Intrinsics:
    """Intrinsics of the part of the picture that is sent, as ``image_geometry`` has them."""
    roi, binned = info.roi, (max(1, info.binning_x), max(1, info.binning_y))
    cut = 0 < roi.width < info.width or 0 < roi.height < info.height
    size = (roi.width, roi.height) if cut else (info.width, info.height)
    x, y = (roi.x_offset, roi.y_offset) if cut else (0, 0)
    return whole.model_copy(
        update={
            "width": size[0] // binned[0] or None,
            "height": size[1] // binned[1] or None,
            "fx": whole.fx / binned[0],
            "fy": whole.fy / binned[1],
            "cx": (whole.cx - x) / binned[0],
            "cy": (whole.cy - y) / binned[1],
            "cropped": cut,
        }
    )
