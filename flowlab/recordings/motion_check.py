"""Whether the camera moves: whether most of what has texture is found elsewhere in the next picture."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import cv2
import numpy as np
from jaxtyping import UInt8

from flowlab.recordings.picture_samples import PictureSample
from flowlab.recordings.verdicts import Check, Verdict

if TYPE_CHECKING:
    from flowlab.recordings.parsing import ParsedRecording

_CELLS = 6
"""The picture is looked at in as many cells along each axis."""
_REACH = 6
"""A cell is looked for so many pixels around where it was."""
_MIN_SIDE = 48
_TEXTURE = 3.0
"""A cell whose gray levels deviate by less has no texture."""
_ENOUGH = 9
"""Cells that tell whether the camera moves."""
_ALIKE = (0.3, 0.5)
"""A cell correlates by this much with where it was, and elsewhere, or it is not found there."""
_STANDS = 0.03
"""It stood still where it correlates by so much more at its place than at any other, or that is not told."""
_MOVES = 0.06
"""It moved where it correlates by so much more at another place, and all around that."""
_MOST = 0.75
"""The camera moves where, of the cells that tell, so many moved."""
_FEW, _MORE = 0.25, 1.5
"""It stands where so many of the textured cells stood, and so many times those that moved: things and robots."""
_HALF = 0.5
"""Where, in the median, fewer stood, that may be a gripper before a camera on a wrist."""
_FIFTH = 5
_PASSING = 0.2
"""What passes before a camera that stands fills at most this share of the pairs."""


@dataclass(frozen=True, slots=True)
class CameraMotion:
    """What is seen of the camera's motion between two samples."""

    textured: int
    """Cells that have texture."""
    stand: int
    """Of these, those that are found where they were, and nowhere else."""
    move: int
    """Of these, those that are found elsewhere."""
    px: float
    """How far, in the median, in pixels of small pictures."""

    @property
    def camera_moves(self) -> bool | None:
        """Whether the camera does; None where that is not told."""
        told = self.stand + self.move
        if told >= _ENOUGH and self.move >= _MOST * told and self.stand <= (1 - _MOST) * self.textured:
            return True
        known = self.textured >= _ENOUGH and self.stand >= max(_FEW * self.textured, _MORE * self.move)
        return False if known else None


def motion_between(a: PictureSample, b: PictureSample) -> CameraMotion:
    """How many parts of a picture stand still, and how many move, by where they are found in the other."""
    none = CameraMotion(0, 0, 0, 0.0)
    if a.gray.shape != b.gray.shape or min(a.gray.shape) < _MIN_SIDE:
        return none
    found = [_found(*cell) for cell in _cells(a.gray, b.gray) if cell[0].std() >= _TEXTURE]
    far = [px for px in found if px]
    return CameraMotion(len(found), found.count(0.0), len(far), float(np.median(far)) if far else 0.0)


def _cells(a: UInt8[np.ndarray, "H W"], b: UInt8[np.ndarray, "H W"]) -> list[tuple[np.ndarray, np.ndarray]]:
    """Every cell of one picture, and where in the other it is looked for."""
    before, after = (cv2.GaussianBlur(gray.astype(np.float32), (0, 0), 0.7) for gray in (a, b))
    height, width = ((side - 2 * _REACH) // _CELLS for side in a.shape)
    return [
        (before[v : v + height, u : u + width],
         after[v - _REACH : v + height + _REACH, u - _REACH : u + width + _REACH])
        for v in _REACH + height * np.arange(_CELLS)
        for u in _REACH + width * np.arange(_CELLS)
    ]  # fmt: skip


def _found(cell: np.ndarray, around: np.ndarray) -> float | None:
    """How far from its place a cell is found [px]; None where it is found nowhere, or at several places."""
    alike = cv2.matchTemplate(around, cell, cv2.TM_CCOEFF_NORMED)
    here = float(alike[_REACH, _REACH])
    if here > _ALIKE[0] and here - float(np.delete(alike, alike.size // 2).max()) > _STANDS:
        return 0.0
    v, u = np.unravel_index(alike.argmax(), alike.shape)
    there = float(alike[v, u])
    alike[max(0, v - 1) : v + 2, max(0, u - 1) : u + 2] = -1
    if there > _ALIKE[1] and there - here > _MOVES and there - float(alike.max()) > _MOVES:
        return float(np.hypot(v - _REACH, u - _REACH))
    return None


def check_motion(source: "ParsedRecording") -> Check:
    """Whether the camera stands still, as flowlab takes it."""
    samples = source.frame_check.samples
    pairs = [(a, motion_between(a, b)) for a, b in _pairs(samples)]
    told = [(a, m) for a, m in pairs if m.camera_moves is not None]
    moving = [(a, m) for a, m in told if m.camera_moves]
    if not moving:
        return _as_fixed([m for _, m in told], len(pairs), len(samples))
    since_the_first = [m.camera_moves for _, m in pairs[len(samples) - 1 :]]
    stays = since_the_first[-1:] == [False] and True not in since_the_first
    if stays and len(moving) < _PASSING * len(told):
        return Check("camera", Verdict.ASSUMED, f"it is taken as fixed: between {len(moving)} of {len(told)} pairs of "
                     "pictures most of what is seen moves, as where something large passes, but later pictures show "
                     "it where the first has it")  # fmt: skip
    steps = [m.px * a.color_factor for a, m in moving]
    mean = np.mean([m.move / (m.move + m.stand) for _, m in moving])
    a = moving[int(np.argmax(steps))][0]
    far = f"{max(steps):.1f} px{_meters(source, a, max(steps))}"
    return Check("camera", Verdict.DOUBTFUL, f"it moves, and is taken as fixed: between {len(moving)} of {len(told)} "
                 f"pairs of pictures {mean:.0%} of the textured picture moves, by {far} or more (from row {a.row}); "
                 "tracks are then in the moving camera's frame, unless its pose in every frame is given: as "
                 f"{_where(source)} in {source.write_to}")  # fmt: skip


def _as_fixed(told: Sequence[CameraMotion], pairs: int, samples: int) -> Check:
    """What is said where no motion of the camera is seen, which is not to say that it is seen to stand."""
    stood = [m.stand / m.textured for m in told]
    if not told:
        return Check("camera", Verdict.ASSUMED, "it is taken as fixed; too little texture in the pictures to tell")
    seen = f"at least {min(stood):.0%} of the textured picture stay where they are (median {np.median(stood):.0%})"
    if len(told) == pairs and np.median(stood) >= _HALF:
        return Check("camera", Verdict.OK, f"it stands still: between any two of {samples} pictures {seen}")
    return Check("camera", Verdict.ASSUMED, f"it is taken as fixed: between {len(told)} of {pairs} pairs of pictures "
                 f"{seen}; the others do not tell, or too little stays to be sure")  # fmt: skip


def _where(source: "ParsedRecording") -> str:
    """What names poses, by the layout."""
    if source.reader.name == "ros":
        return "'topics: {T_world_cam: ...}', a topic of poses,"
    return "'T_world_cam_file: ...', a file with T_world_cam of every color picture or with times of its own,"


def _pairs(samples: Sequence[PictureSample]) -> list[tuple[PictureSample, PictureSample]]:
    """Samples one after the other, and the first with every fifth and the last: a drift is seen only in these."""
    far = sorted({*range(_FIFTH, len(samples), _FIFTH), len(samples) - 1} - {-1, 0, 1})
    return [*pairwise(samples), *((samples[0], samples[k]) for k in far)]


def _meters(source: "ParsedRecording", at: PictureSample, px: float) -> str:
    """What a motion of the picture is at the scene's distance."""
    intrinsics, unit = source.metadata.intrinsics, source.metadata.depth_unit_m
    readings = at.depth[np.isfinite(at.depth) & (at.depth > 0)]
    if intrinsics is None or unit is None or not readings.size:
        return ""
    return f" ({1000 * px * float(np.median(readings)) * unit / intrinsics.fx:.0f} mm at the scene's distance)"
