"""How what moves in the pictures goes with a robot's position: turned as the camera is, scaled as calibration errs."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.spatial.transform import Rotation

BALL_M = 0.15
"""Points of one gripper are this near to a middle that goes with the robot's position."""
_NOISE_M, _UNLIKE = 0.003, 0.14
"""A point goes along if it is off by less than this, and this share of the way."""
FEWEST, _SHARE = 2, 0.5
"""Points of a pair that go along, and their share of what moves around them, for the pair to agree."""


@dataclass(frozen=True, slots=True)
class SeenSteps:
    """What moves in pairs of pictures, and how far the robot went in each."""

    pair: Int64[np.ndarray, "N"]
    """Of each point."""
    start: Float64[np.ndarray, "N 3"]
    """In the camera frame, as calibration has it [m]."""
    step: Float64[np.ndarray, "N 3"]
    at: Float64[np.ndarray, "K 3"]
    """Where the robot was in each pair, by its state."""
    way: Float64[np.ndarray, "K 3"]
    """How far it went."""

    def __len__(self) -> int:
        return len(self.way)


@dataclass(frozen=True, slots=True)
class SeenMotion:
    """How the camera is said to see a robot's motion: ``step = (across, across, along) * (R @ way)``."""

    R_cam_base: Float64[np.ndarray, "3 3"]
    across: float = 1.0
    """Times as far as it goes, across the view: less than 1 by a focal length that is too large."""
    along: float = 1.0
    """The same along the view: both are off alike by a wrong unit of depth."""

    @property
    def matrix(self) -> Float64[np.ndarray, "3 3"]:
        """Of ways to steps."""
        return self.scale[:, None] * self.R_cam_base

    @property
    def scale(self) -> Float64[np.ndarray, "3"]:
        """Of the camera's axes."""
        return np.array([self.across, self.across, self.along])


@dataclass(frozen=True, slots=True)
class Support:
    """What goes with the robot as a motion says."""

    inside: Bool[np.ndarray, "N"]
    """Points that do, around one middle."""
    pairs: Bool[np.ndarray, "K"]
    """Pairs in which most around that middle do."""
    telling: int
    """Pairs that have points around it."""
    middle: Float64[np.ndarray, "3"]
    """In the axes of the robot's position, from the camera to where that is 0 [m]."""
    left: float
    """How far the steps of pairs that agree are from what the motion says, as a share of the way, in the median."""
    points: int
    """Moving points around the middle."""
    score: float
    """Pairs that agree, each by how near its points are to what the motion says."""

    @property
    def count(self) -> int:
        """Pairs that agree."""
        return int(self.pairs.sum())

    @property
    def agreement(self) -> float:
        """Their share of those that tell."""
        return self.count / max(self.telling, 1)


def support_of(seen: SeenSteps, matrix: Float64[np.ndarray, "3 3"]) -> Support:
    """What goes with the robot as ``step = matrix @ way``, around the middle around which most does."""
    off, middles = steps_off(seen, matrix)
    near = off < tolerance_of(seen)
    if not near.any():
        none = np.zeros(len(seen.pair), bool)
        return Support(none, np.zeros(len(seen), bool), 0, np.zeros(3), np.inf, 0, 0.0)
    some = middles[near]
    some = some[:: max(1, len(some) // 50)]
    counts = (np.linalg.norm(middles[near][None] - some[:, None], axis=-1) < BALL_M).sum(1)
    middle = some[counts.argmax()]
    for _ in range(2):
        around = np.linalg.norm(middles - middle, axis=1) < BALL_M
        middle = np.median(middles[around & near], axis=0) if (around & near).any() else middle
    around = np.linalg.norm(middles - middle, axis=1) < BALL_M
    inside = around & near
    many, all_of = (np.bincount(seen.pair[m], minlength=len(seen)) for m in (inside, around))
    pairs = (many >= FEWEST) & (many >= _SHARE * all_of)
    inside &= pairs[seen.pair]
    left = off[inside] / np.linalg.norm(seen.way, axis=1)[seen.pair[inside]]
    near_by = np.bincount(seen.pair[inside], nearness_of(seen, off)[inside], minlength=len(seen))
    return Support(
        inside, pairs, int((all_of >= FEWEST).sum()), middle, float(np.median(left)) if len(left) else np.inf,
        int(around.sum()), float((near_by / np.maximum(all_of, 1)).sum()),
    )  # fmt: skip


def steps_off(seen: SeenSteps, matrix: Float64[np.ndarray, "3 3"]) -> tuple[np.ndarray, np.ndarray]:
    """How far each point's step is from the robot's, and where it would be where the state is 0 [m]."""
    back = np.linalg.pinv(matrix).T
    off = np.linalg.norm(seen.step @ back - seen.way[seen.pair], axis=1)
    return off, seen.start @ back - seen.at[seen.pair]


def tolerance_of(seen: SeenSteps) -> Float64[np.ndarray, "N"]:
    """How far a step may be from the robot's to go along with it [m]."""
    return np.asarray((_NOISE_M + _UNLIKE * np.linalg.norm(seen.way, axis=1))[seen.pair])


def nearness_of(seen: SeenSteps, off: np.ndarray) -> Float64[np.ndarray, "N"]:
    """From 1, of a step that is as it should be, to 0 at the limit."""
    return np.asarray(np.maximum(1 - (off / tolerance_of(seen)) ** 2, 0))


def turn_between(a: np.ndarray, b: np.ndarray) -> float:
    """The angle between two rotations [rad]."""
    return float(Rotation.from_matrix(a @ b.T).magnitude())
