"""Pairs of pictures that a camera took from different places, and the points that both show, found by flow."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import cv2
import numpy as np
from jaxtyping import Float, Float64

from flowlab.errors import DataError
from flowlab.geometry.transforms import apply, inverse
from flowlab.recordings.base import BadImage
from flowlab.recordings.frame_processing import FrameProcessor
from flowlab.recordings.small_rows import SmallRow

if TYPE_CHECKING:
    from flowlab.recordings.parsing import ParsedRecording

_STARTS = 8
"""So many rows, evenly spread, are compared with later ones."""
_SOON_S, _LATEST_S = 0.1, 6.0
"""How much later those are at least and at most [s]."""
_FAR_PX = 0.04
"""Share of the width that the picture moves by in between."""
_WIDTH = 214
_LEAST_SIDE = 24
_ENOUGH = 0.05
"""Share of the pixels that two rows must both show."""
_POINTS = 2000
"""About so many points of two rows are compared, at most twice as many: enough for a median."""
_THERE_AND_BACK_PX = 0.7
"""Flow that does not come back to within this is not believed, in pixels of small pictures."""
_TEXTURE = 2.0
"""Gray levels that differ by this from pixel to pixel, in the mean, are a texture."""
_EDGE = 0.05
"""Depth that differs by this share beside a pixel has an edge there."""
_FLOOR = (0.004, 0.01)
"""What sensors and flow err by: a length [m], and a share of the distance."""
_OF_PIXEL = 0.3
"""And a share of a pixel of the small pictures that are compared."""
_STAYS_PX, _MOVES_PX, _LEFT = 0.5, 2.0, 0.15
"""What moves by less in the picture, where poses move it by more, goes along with the camera, if so much is left."""
_REFITS = 4
"""Times that a rigid motion is fitted to the half of the points that fit best."""


@dataclass(frozen=True, slots=True)
class RigidFit:
    """How a camera sees a scene move from one row to another."""

    R: Float64[np.ndarray, "3 3"]
    t: Float64[np.ndarray, "3"]
    left_m: float
    """How far points are from it, in the median; far where they were not found again."""


def rotation_between(
    first: Float64[np.ndarray, "*batch N 3"], second: Float64[np.ndarray, "*batch N 3"]
) -> Float64[np.ndarray, "*batch 3 3"]:
    """The rotations that take vectors to others as well as one can (Kabsch)."""
    U, _, Vt = np.linalg.svd(np.swapaxes(first, -1, -2) @ second)
    V = np.swapaxes(Vt, -1, -2).copy()
    V[..., 2] *= np.sign(np.linalg.det(U @ Vt))[..., None]
    return np.asarray(V @ np.swapaxes(U, -1, -2))


@dataclass(frozen=True, slots=True)
class FlowPair:
    """Points that two rows show, each in the camera frame of its row [m]."""

    rows: tuple[int, int]
    first: Float64[np.ndarray, "N 3"]
    second: Float64[np.ndarray, "N 3"]
    px: float
    """How far those that move do in the picture, in the median [px]."""
    pixel_rad: float
    """What a pixel of the small pictures spans [rad]."""
    width: int
    """Of the picture [px]."""

    @property
    def pixel_m(self) -> Float64[np.ndarray, "N"]:
        """How wide a pixel is at every point, by how far apart points are that are as far apart in the picture [m]."""
        return self.first[:, 2] * self.pixel_rad

    def fit(self) -> "RigidFit":
        """The rigid motion that takes most points of the first row to the second."""
        inside = np.ones(len(self.first), bool)
        for _ in range(_REFITS):
            a, b = self.first[inside], self.second[inside]
            R = rotation_between(a - a.mean(0), b - b.mean(0))
            t = b.mean(0) - R @ a.mean(0)
            left = np.linalg.norm(self.first @ R.T + t - self.second, axis=1)
            inside = left <= np.median(left)
        return RigidFit(R, t, float(np.median(left)))

    def moved_m(self) -> Float64[np.ndarray, "N"]:
        """How far they move before the camera [m]."""
        return np.asarray(np.linalg.norm(self.first - self.second, axis=1))

    def apart_m(self, T: Float[np.ndarray, "T 4 4"]) -> Float64[np.ndarray, "N"]:
        """How far apart they are in the world under poses [m]."""
        a, b = (apply(T[r], p) for r, p in zip(self.rows, (self.first, self.second), strict=True))
        return np.asarray(np.linalg.norm(a - b, axis=1))

    def off_m(self, T: Float[np.ndarray, "T 4 4"], share: float = 0.5) -> float:
        """How far apart they are in the world: so many of them by less."""
        return float(np.quantile(self.apart_m(T), share))

    def without_carried(self, T: Float[np.ndarray, "T 4 4"]) -> "FlowPair":
        """The pair without what stays where it is in the picture though poses move the camera, as a gripper does before
        a camera at the wrist; all of it where little else is left."""
        first, second = self.rows
        places = [
            p[:, :2] / np.maximum(p[:, 2:], 1e-3)
            for p in (self.first, self.second, apply(inverse(T[second]) @ T[first], self.first))
        ]
        seen, said = (np.linalg.norm(there - places[0], axis=1) / self.pixel_rad for there in places[1:])
        rest = ~((seen < _STAYS_PX) & (said > _MOVES_PX))
        return self if rest.mean() < _LEFT else replace(self, first=self.first[rest], second=self.second[rest])


def floor_m(pairs: list[FlowPair]) -> float:
    """What sensors and flow err by [m]."""
    far, pixel = (float(np.median([np.median(x) for x in of])) for of in
                  ([p.first[:, 2] for p in pairs], [p.pixel_m for p in pairs]))  # fmt: skip
    return _FLOOR[0] + _FLOOR[1] * far + _OF_PIXEL * pixel


def flow_pairs(source: "ParsedRecording") -> Iterator[FlowPair]:
    """Points that pairs of rows both show, by flow of color and by depth; none where cameras are not known."""
    try:
        processor = source.frame_processor()
    except DataError:  # which is told elsewhere
        return
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    clock = source.streams.color.time_s[source.frame_check.color]
    for start in np.unique(np.linspace(0, len(clock) - 1, _STARTS + 1).astype(int))[:-1].tolist():
        try:
            pair = _farthest(source, processor, flow, start, clock)
        except BadImage:
            continue
        if pair is not None:
            yield pair


def _farthest(
    source: "ParsedRecording", processor: FrameProcessor, flow: "cv2.DISOpticalFlow", start: int, clock: np.ndarray
) -> FlowPair | None:
    """A row with one so much later that the picture has moved as far as flow can follow, by its speed at the row."""
    one = _taken(source, processor, start)
    soon = _row_at(clock, start, _SOON_S)
    near = _matched(flow, (start, soon), one, _taken(source, processor, soon))
    if near is None:
        return None
    lag = (clock[soon] - clock[start]) * _FAR_PX * near.width / max(near.px, 1e-6)
    row = _row_at(clock, start, min(lag, _LATEST_S))
    far = _matched(flow, (start, row), one, _taken(source, processor, row)) if row > soon else None
    return far or near


def _row_at(clock: Float64[np.ndarray, "T"], start: int, lag_s: float) -> int:
    """The last row up to so much later, but the next at least."""
    row = int(np.searchsorted(clock, clock[start] + lag_s + 1e-6, side="right")) - 1
    return min(max(row, start + 1), len(clock) - 1)


_Taken = tuple[np.ndarray, np.ndarray]
"""A small gray picture, and the point in the camera frame [m] that each of its pixels shows; nan without depth."""


def _taken(source: "ParsedRecording", processor: FrameProcessor, row: int) -> _Taken:
    """What a row shows."""
    small = SmallRow.read(source, processor, row, _WIDTH)
    points = small.unproject(small.depth, (small.factor - 1) // 2)
    points[small.depth <= 0] = np.nan
    return small.gray, points


def _matched(flow: "cv2.DISOpticalFlow", rows: tuple[int, int], one: _Taken, other: _Taken) -> FlowPair | None:
    """Points of two rows that are one by flow there and back; None where there are too few."""
    (a, points_a), (b, points_b) = one, other
    if min(a.shape) < _LEAST_SIDE:
        return None
    there, back = (flow.calc(x, y, np.zeros((*a.shape, 2), np.float32)) for x, y in ((a, b), (b, a)))
    v, u = np.mgrid[: a.shape[0], : a.shape[1]].astype(np.float32)
    to_u, to_v = u + there[..., 0], v + there[..., 1]
    returned = there + cv2.remap(back, to_u, to_v, cv2.INTER_LINEAR, borderValue=(1e3, 1e3))
    good = (np.linalg.norm(returned, axis=-1) < _THERE_AND_BACK_PX) & (_texture(a) > _TEXTURE)
    near = points_b.astype(np.float32)
    second = cv2.remap(near, to_u, to_v, cv2.INTER_LINEAR, borderValue=(np.nan,) * 3).astype(float)
    edges = [np.ptp(_around(p[..., 2]), axis=0) > _EDGE * p[..., 2] for p in (points_a, points_b)]
    beside = cv2.remap(edges[1].astype(np.uint8), to_u, to_v, cv2.INTER_NEAREST, borderValue=1)
    good &= ~edges[0] & (beside == 0) & np.isfinite(points_a).all(-1) & np.isfinite(second).all(-1)
    if good.sum() < _ENOUGH * good.size:
        return None
    px = np.linalg.norm(there[good], axis=-1)
    if (px > _STAYS_PX).mean() >= _LEFT:
        px = px[px > _STAYS_PX]
    some = slice(None, None, max(1, int(good.sum()) // _POINTS))
    return FlowPair(
        rows, points_a[good][some], second[good][some], float(np.median(px)), _pixel_rad(points_a), a.shape[1]
    )


def _pixel_rad(points: np.ndarray) -> float:
    """What a pixel spans in the middle of a picture, by the rays of its points [rad]."""
    across = np.diff(points[..., 0] / points[..., 2], axis=1)
    return float(np.nanmedian(across))


def _around(z: np.ndarray) -> np.ndarray:
    """The greatest and the least depth beside each pixel."""
    z = np.nan_to_num(z, nan=1e3).astype(np.float32)
    return np.stack([cv2.dilate(z, np.ones((3, 3))), cv2.erode(z, np.ones((3, 3)))])


def _texture(gray: np.ndarray) -> np.ndarray:
    """How much gray levels differ from pixel to pixel, in the mean around each."""
    change = np.abs(cv2.Sobel(gray, cv2.CV_32F, 1, 0)) + np.abs(cv2.Sobel(gray, cv2.CV_32F, 0, 1))
    mean: np.ndarray = cv2.blur(change, (7, 7)) / 8
    return mean
