"""What files that nothing uses state of rate, unit, size and camera, against what is used."""

import re
from typing import TYPE_CHECKING, Any

import numpy as np

from flowlab.recordings.camera_numbers import camera_numbers
from flowlab.recordings.file_contents import Contents
from flowlab.recordings.sync import sampling_rate

if TYPE_CHECKING:
    from flowlab.recordings.parsing import ParsedRecording

_RATE = re.compile(r"(^|[._])(\w*_)?(fps|hz|frame_?rate|rate|frequency)$")
_UNIT = re.compile(r"(^|[._])\w*(depth\w*_?(scale|unit|factor)(_m)?|unit_m)$")
_WIDTH = re.compile(r"(^|[._])(image_?|color_?)?(width|height|w|h)$")
_COUNT = re.compile(
    r"(^|[._])((num|n|nr|number_of|total)_?(frames?|images?|pictures?|steps?|samples?)|(frames?|steps?)_?(count|num)|length)$"
)
_LABEL = re.compile(
    r"(^|[._])(\w*_)?(episode|trial|take|demo|task|seed|version|serial|user|operator|subject|session|id|index)"
    r"(_?(id|ids|index|idx|number|num|no|nr))?$"
)
_STEP = re.compile(r"(^|_)(time)?(step|frame)s?(_?(index|id|idx|number|no))?$")
"""What a number with such a name counts is neither a place nor a time."""
_TELLS = re.compile(r"fps|rate|hz|unit|scale|time|stamp|frame|pose|cam|convention|axes|model|lens|dist|matrix|coord")
"""What has one of these in its name may matter, though it is a text."""
_SAME = 0.02


def states_what_is_used(source: "ParsedRecording", name: str, contents: Contents) -> bool:
    """Whether all that a file states is what is used, or says nothing of where and when things were."""
    if contents.leaves:
        return all(_is_used(source, key, value) for key, value in contents.leaves)
    values = contents.values
    if values is not None and values.ndim == 1 and values.dtype.kind in "iu" and len(np.unique(np.diff(values))) == 1:
        return _LABEL.search(name.lower()) is not None or _STEP.search(name.lower()) is not None
    return values is not None and values.size > 0 and values.ndim <= 3 and _is_used_array(source, name, values)


def contradictions(source: "ParsedRecording", contents: Contents) -> list[str]:
    """What a file states of the rate or the unit of depth that is not what is used."""
    found = []
    for key, value in contents.leaves:
        used = _stated(source, key, value)
        if used is not None and not _alike(value, used):
            found.append(f"it says {key.rpartition('.')[2]} {value:g}, and {used:g} is used")
    return found


def _stated(source: "ParsedRecording", key: str, value: Any) -> float | None:
    """What is used of what a number is called as; None where it is called otherwise, or nothing is known of it."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value) or value <= 0:
        return None
    if _RATE.search(key.lower()):
        return sampling_rate(source.streams.color.time_s)
    if _COUNT.search(key.lower()):
        return float(len(source.streams.color))
    unit = source.metadata.depth_unit_m
    if _UNIT.search(key.lower()) and unit is not None:
        return 1 / unit if value > 1 else unit
    found = _WIDTH.search(key.lower())
    size = source.frame_check.color_size
    return None if found is None or not size else float(size[found[3][0] == "h"])


def _is_used(source: "ParsedRecording", key: str, value: Any) -> bool:
    """Whether a number is the one that is used, or a text has no name that may matter."""
    if isinstance(value, int) and _LABEL.search(key.lower()):
        return True
    used = _stated(source, key, value)
    if used is not None:
        return _alike(value, used)
    if isinstance(value, str | bool) or value is None:
        return _TELLS.search(key.lower()) is None
    try:
        values = np.array(value, np.float64)
    except (ValueError, TypeError):
        return False
    return values.ndim > 0 and _is_used_array(source, key.rpartition(".")[2], values)


def _is_used_array(source: "ParsedRecording", name: str, values: np.ndarray) -> bool:
    """Whether numbers are the camera's that is used."""
    if values.dtype.kind not in "iuf" or not values.size:
        return False
    known, posed = source.metadata, source.streams.poses is not None
    blank = known.model_copy(update={"intrinsics": None, "depth_unit_m": None, "T_world_cam": None})
    shape = values.shape[-2:]
    rigid = shape in ((4, 4), (3, 4)) and values.ndim == 2 and _is_the_pose(known.T_world_cam, values)
    return rigid or (camera_numbers(name, values, blank, posed) is not None
                     and camera_numbers(name, values, known, posed) is None)  # fmt: skip


def _is_the_pose(used: Any, values: np.ndarray) -> bool:
    pose = np.eye(4) if used is None else np.array(used)
    return any(np.allclose(values, T[: len(values)], rtol=0, atol=1e-3) for T in (pose, np.eye(4)))


def _alike(value: float, used: float) -> bool:
    return abs(value / used - 1) < _SAME
