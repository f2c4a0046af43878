"""What is seen to move while a robot does: points of pairs of rows, followed by flow and lifted by depth."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
from jaxtyping import Bool, Float64, UInt8
from scipy.spatial.transform import Rotation

from flowlab.errors import DataError
from flowlab.geometry.transforms import apply, inverse
from flowlab.recordings.base import BadImage, SampleStream
from flowlab.recordings.frame_processing import FrameProcessor
from flowlab.recordings.small_rows import SmallRow

if TYPE_CHECKING:
    from flowlab.recordings.parsing import ParsedRecording

_PAIRS = 32
"""So many pairs of rows are looked at, spread over the way that the robot goes."""
_STEP, _LEAST_STEP = 0.04, 0.015
"""The robot goes so far between the rows of a pair, at least so far, in the unit of its state."""
_LATEST_S = 1.5
"""The second row is at most so much later [s]."""
_TURN_ARM_M, _TURNED = 0.08, 0.3
"""What a gripper's turn moves a point so far away by should be at most this share of its step."""
_WIDTH = 320
"""Pictures are shrunk to about this [px]."""
_CHANGED = 8
"""Gray levels by which what moves changes."""
_CORNERS, _CORNER_QUALITY, _APART_PX = 250, 0.005, 4
_WINDOW_PX, _LEVELS = 13, 3
_THERE_AND_BACK_PX = 0.5
_EDGE, _EDGE_PX = 0.04, 7
"""Depth that differs by this share within so many pixels has an edge there, where flow mixes both sides."""
_MOVED_PX, _MOVED_SHARE = 1.0, 0.02
"""What moves by less in the picture and by less of its distance does not move, as far as is seen."""
_BEFORE_CAMERA = 0.7
"""Before a camera that moves, points must go at least this share of their step: the rest its poses say, whatever
calibration is, and all of it of a gripper whose wrist the camera is on."""


@dataclass(frozen=True, slots=True)
class MovingPoints:
    """What moves between two rows, in the camera frame of the first [m]."""

    time_s: tuple[float, float]
    """Of the rows, on the clock of the recording."""
    start: Float64[np.ndarray, "N 3"]
    step: Float64[np.ndarray, "N 3"]
    """How far each goes."""


def moving_points(source: "ParsedRecording", state: SampleStream) -> Iterator[MovingPoints]:
    """What is seen to move in pairs of rows between which the robot's state does; none where cameras are not known.

    Args:
        source: A recording whose camera stands still, or has poses.
        state: Of the robot; its first three numbers are taken for a position.
    """
    try:
        processor = source.frame_processor()
    except DataError:  # which is told elsewhere
        return
    clock = source.streams.color.time_s[source.frame_check.color]
    taken: dict[int, _Taken] = {}
    for first, second in choose_pairs(clock, state):
        taken = {row: seen for row, seen in taken.items() if row >= first}
        try:
            for row in (first, second):
                if row not in taken:
                    taken[row] = _taken(source, processor, row)
        except BadImage:
            continue
        points = _followed(taken[first], taken[second], source.frame_check.T_world_cam is None)
        if points is not None:
            start, step = _before_first_camera(source, (first, second), *points)
            yield MovingPoints((float(clock[first]), float(clock[second])), start, step)


def choose_pairs(clock: Float64[np.ndarray, "T"], state: SampleStream) -> list[tuple[int, int]]:
    """Rows between which the robot goes far enough, spread evenly over its way."""
    at = positions_at(state, clock)
    later = np.full(len(at), -1)
    for row in range(len(at) - 1):
        last = int(np.searchsorted(clock, clock[row] + _LATEST_S, side="right"))
        far = np.linalg.norm(at[row + 1 : last] - at[row], axis=1)
        if not len(far) or far.max() < _LEAST_STEP:
            continue
        enough = np.flatnonzero(far >= _STEP)
        later[row] = row + 1 + (int(enough[0]) if len(enough) else int(far.argmax()))
    rows = np.flatnonzero(later > 0)
    if not len(rows):
        return []
    turned = _turned(clock, state, rows, later[rows])
    if (~turned).sum() >= _PAIRS // 2:
        rows = rows[~turned]
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(at, axis=0), axis=1))])[rows]
    chosen = np.unique(np.searchsorted(way, np.linspace(way[0], way[-1], _PAIRS)).clip(0, len(rows) - 1))
    return [(int(r), int(later[r])) for r in rows[chosen]]


def positions_at(state: SampleStream, time_s: Float64[np.ndarray, "N"]) -> Float64[np.ndarray, "N 3"]:
    """The first three numbers of a state at some times."""
    return np.stack([np.interp(time_s, state.time_s, state.values[:, k].astype(float)) for k in range(3)], -1)


def _turned(clock: np.ndarray, state: SampleStream, first: np.ndarray, second: np.ndarray) -> Bool[np.ndarray, "N"]:
    """Whether the gripper turns much between rows, where the four numbers after its position are a quaternion."""
    if state.values.shape[1] < 7:
        return np.zeros(len(first), bool)
    numbers = state.values[:, 3:7].astype(float)
    if np.abs(np.linalg.norm(numbers, axis=1) - 1).max() > 0.01:
        return np.zeros(len(first), bool)
    near = np.searchsorted(state.time_s, clock).clip(0, len(state.time_s) - 1)
    turns = Rotation.from_quat(numbers[near])  # the angle between two is the same, whichever number is w
    angle = (turns[first].inv() * turns[second]).magnitude()
    at = state.values[near, :3].astype(float)
    return np.asarray(_TURN_ARM_M * angle > _TURNED * np.linalg.norm(at[second] - at[first], axis=1))


_Taken = tuple[np.ndarray, np.ndarray]
"""A gray picture, and the point in the camera frame [m] that its pixels show; nan at edges and without depth."""


def _taken(source: "ParsedRecording", processor: FrameProcessor, row: int) -> _Taken:
    """What a row shows."""
    small = SmallRow.read(source, processor, row, _WIDTH)
    smooth = cv2.medianBlur(np.ascontiguousarray(small.depth, np.float32), 5)
    around = np.ones((_EDGE_PX, _EDGE_PX))
    far, near = cv2.dilate(smooth, around), cv2.erode(np.where(smooth > 0, smooth, np.float32(1e3)), around)
    points = small.unproject(smooth, (small.factor - 1) / 2)
    points[(smooth <= 0) | (far - near > _EDGE * smooth)] = np.nan
    return small.gray, points


def _followed(one: _Taken, other: _Taken, still: bool) -> tuple[np.ndarray, np.ndarray] | None:
    """Where points are in two rows that move between them [m]; None where there are none."""
    (a, points_a), (b, points_b) = one, other
    mask = _changed(a, b) if still else np.full(a.shape, 255, np.uint8)
    mask[~np.isfinite(points_a[..., 2])] = 0
    corners: np.ndarray | None = cv2.goodFeaturesToTrack(
        a, _CORNERS, _CORNER_QUALITY, _APART_PX, mask=mask, blockSize=5
    )
    if corners is None:
        return None
    window = (_WINDOW_PX, _WINDOW_PX)
    unknown = np.zeros_like(corners)
    there, found, _ = cv2.calcOpticalFlowPyrLK(a, b, corners, unknown.copy(), winSize=window, maxLevel=_LEVELS)
    back, returned, _ = cv2.calcOpticalFlowPyrLK(b, a, there, unknown.copy(), winSize=window, maxLevel=_LEVELS)
    first, second = corners[:, 0], there[:, 0]
    good = (found[:, 0] > 0) & (returned[:, 0] > 0) & (np.linalg.norm(back[:, 0] - first, axis=1) < _THERE_AND_BACK_PX)
    start, end = (_at(points, px) for points, px in ((points_a, first), (points_b, second)))
    good &= np.isfinite(start).all(1) & np.isfinite(end).all(1)
    px = np.linalg.norm(second - first, axis=1)
    if still:
        good &= (px > _MOVED_PX) | (np.abs(end[:, 2] - start[:, 2]) > _MOVED_SHARE * start[:, 2])
    return (start[good], end[good]) if good.any() else None


def _changed(a: UInt8[np.ndarray, "H W"], b: UInt8[np.ndarray, "H W"]) -> UInt8[np.ndarray, "H W"]:
    """Where two pictures differ by more than noise, and around there."""
    apart = cv2.absdiff(cv2.GaussianBlur(a, (0, 0), 1.0), cv2.GaussianBlur(b, (0, 0), 1.0))
    return cv2.dilate((apart > _CHANGED).astype(np.uint8) * 255, np.ones((9, 9)))


def _at(points: np.ndarray, px: np.ndarray) -> Float64[np.ndarray, "N 3"]:
    """The points that are seen at places of a picture: their rays there, their depth at the nearest pixel."""
    height, width = points.shape[:2]
    u, v = px.T
    column, row = np.rint(u).astype(int), np.rint(v).astype(int)
    inside = (column > 0) & (column < width - 1) & (row > 0) & (row < height - 1)
    found = np.full((len(px), 3), np.nan)
    c, r = column[inside], row[inside]
    z = points[r, c, 2]
    across = points[r, c] / z[:, None]
    beside_x, beside_y = points[r, c + 1] / points[r, c + 1, 2:], points[r + 1, c] / points[r + 1, c, 2:]
    rays = across + (u[inside] - c)[:, None] * (beside_x - across) + (v[inside] - r)[:, None] * (beside_y - across)
    found[inside] = rays * z[:, None]
    return found


def _before_first_camera(
    source: "ParsedRecording", rows: tuple[int, int], start: np.ndarray, end: np.ndarray
) -> tuple[Float64[np.ndarray, "N 3"], Float64[np.ndarray, "N 3"]]:
    """Start and step of what moves, before the camera of the first row of all, where the camera's poses are known."""
    T = source.frame_check.T_world_cam
    if T is None:
        return start, end - start
    back = inverse(T[0])
    first, second = (apply(back @ T[row], xyz) for row, xyz in zip(rows, (start, end), strict=True))
    step = second - first
    far = np.linalg.norm(step, axis=1)
    moves = (far > _MOVED_SHARE * start[:, 2]) & (np.linalg.norm(end - start, axis=1) > _BEFORE_CAMERA * far)
    return first[moves], step[moves]
