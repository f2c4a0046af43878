"""Whether the camera moves: whether most of what has texture moves from one picture to another."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import cv2
import numpy as np

from flowlab.recordings.picture_samples import PictureSample
from flowlab.recordings.verdicts import Check, Verdict

if TYPE_CHECKING:
    from flowlab.recordings.parsing import ParsedRecording

_CELLS = 6
"""The picture is looked at in as many cells along each axis."""
_TEXTURE = 6.0
"""Gray levels that differ by this from pixel to pixel, in the mean, are a texture."""
_MIN_SIDE = 24
_ENOUGH = 9
"""Cells with texture that tell whether the camera moves."""
_MOVES_PX = 0.4
"""A cell that moves by less, in small pictures, stands still."""
_MOST = 0.75
"""So many of the cells must move."""
_EXPLAINED = 0.35
"""Motion must explain this much of how a cell changes, or something else changes it."""


@dataclass(frozen=True, slots=True)
class CameraMotion:
    """How far the whole picture moves between two samples."""

    share: float
    """Of the cells with texture, those that move."""
    px: float
    """How far, in the median, in pixels of small pictures."""


def motion_between(a: PictureSample, b: PictureSample) -> CameraMotion | None:
    """How much of the picture moves; None where there is too little texture to tell."""
    if a.gray.shape != b.gray.shape or min(a.gray.shape) < _MIN_SIDE:
        return None
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST).calc(
        a.gray, b.gray, np.zeros((*a.gray.shape, 2), np.float32)
    )
    before, after = a.gray.astype(np.float32), b.gray.astype(np.float32)
    v, u = np.mgrid[: before.shape[0], : before.shape[1]].astype(np.float32)
    warped = cv2.remap(after, u + flow[..., 0], v + flow[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    texture = np.abs(cv2.Sobel(before, cv2.CV_32F, 1, 0)) + np.abs(cv2.Sobel(before, cv2.CV_32F, 0, 1))
    moves, length = [], []
    for rows in np.array_split(np.arange(before.shape[0]), _CELLS):
        for columns in np.array_split(np.arange(before.shape[1]), _CELLS):
            cell = np.ix_(rows, columns)
            if texture[cell].mean() / 8 < _TEXTURE / 2:
                continue
            far = float(np.hypot(*np.median(flow[cell].reshape(-1, 2), axis=0)))
            changed, left = np.abs(after[cell] - before[cell]).mean(), np.abs(warped[cell] - before[cell]).mean()
            moves.append(far > _MOVES_PX and left < (1 - _EXPLAINED) * changed)
            length.append(far)
    if len(moves) < _ENOUGH:
        return None
    return CameraMotion(float(np.mean(moves)), float(np.median(length)))


def check_motion(source: "ParsedRecording") -> Check:
    """Whether the camera stands still, as flowlab takes it."""
    samples = source.frame_check.samples
    pairs = [(a, b, motion_between(a, b)) for a, b in _pairs(samples)]
    told = [(a, b, m) for a, b, m in pairs if m is not None]
    if not told:
        return Check("camera", Verdict.ASSUMED, "it is taken as fixed; too little texture in the pictures to tell")
    moving = [(a, b, m) for a, b, m in told if m.share >= _MOST]
    if not moving:
        share = max(m.share for _, _, m in told)
        return Check("camera", Verdict.OK, f"it stands still: between no two of {len(samples)} pictures does more than "
                     f"{share:.0%} of the textured picture move")  # fmt: skip
    steps = [m.px * a.color_factor for a, b, m in moving]
    mean = np.mean([m.share for _, _, m in moving])
    a = moving[int(np.argmax(steps))][0]
    far = f"{max(steps):.1f} px{_meters(source, a, max(steps))}"
    return Check("camera", Verdict.DOUBTFUL, f"it moves, and is taken as fixed: between {len(moving)} of {len(told)} "
                 f"pairs of pictures {mean:.0%} of the textured picture moves, by {far} at most (from row {a.row}); "
                 "tracks are then in the moving camera's frame, unless its pose in every frame is given: as "
                 f"{_where(source)} in {source.write_to}")  # fmt: skip


def _where(source: "ParsedRecording") -> str:
    """What names poses, by the layout."""
    if source.reader.name == "ros":
        return "'topics: {T_world_cam: ...}', a topic of poses,"
    return "'T_world_cam_file: ...', a file with T_world_cam of every color picture or with times of its own,"


def _pairs(samples: Sequence[PictureSample]) -> list[tuple[PictureSample, PictureSample]]:
    """Samples one after the other, and the first with the middle and the last: a drift is seen only in these."""
    far = [(samples[0], samples[k]) for k in {len(samples) // 2, len(samples) - 1} if k > 1] if samples else []
    return [*pairwise(samples), *far]


def _meters(source: "ParsedRecording", at: PictureSample, px: float) -> str:
    """What a motion of the picture is at the scene's distance."""
    intrinsics, unit = source.metadata.intrinsics, source.metadata.depth_unit_m
    readings = at.depth[np.isfinite(at.depth) & (at.depth > 0)]
    if intrinsics is None or unit is None or not readings.size:
        return ""
    return f" ({1000 * px * float(np.median(readings)) * unit / intrinsics.fx:.0f} mm at the scene's distance)"
