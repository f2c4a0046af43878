"""What explains how things move while a robot does: calibration as it is said, or with an error of a certain kind."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from flowlab.recordings.robot_fit import refined
from flowlab.recordings.robot_motion import SeenMotion, SeenSteps, Support
from flowlab.recordings.robot_search import search, search_scales


@dataclass(frozen=True, slots=True)
class Explanation:
    """A motion that goes with the robot, of a kind of calibration."""

    motion: SeenMotion
    support: Support
    turned: bool
    """Whether the camera is turned otherwise than is said, or nothing is said of that."""
    scaled: bool
    """Whether focal length or unit of depth is another."""


def explanations(seen: SeenSteps, R_cam_base: Float64[np.ndarray, "3 3"] | None) -> list[Explanation]:
    """The best motion of each kind, the simplest kind first: of the calibration as it is said, with another scale, with
    the camera turned otherwise, with both.

    Args:
        seen: What moves.
        R_cam_base: How the camera is turned against the frame of the robot's position, where that is said.
    """
    found = []
    if R_cam_base is not None:
        found.append(_best(seen, [SeenMotion(R_cam_base)], turned=False, scaled=False))
        found.append(_best(seen, search_scales(seen, R_cam_base), turned=False, scaled=True))
    found += [_best(seen, search(seen, scaled=scaled), turned=True, scaled=scaled) for scaled in (False, True)]
    return [e for e in found if e is not None]


def as_said(seen: SeenSteps, R_cam_base: Float64[np.ndarray, "3 3"] | None) -> Explanation | None:
    """The best motion of the calibration as it is said; with any rotation where nothing is said of that."""
    motions = search(seen, scaled=False) if R_cam_base is None else [SeenMotion(R_cam_base)]
    return _best(seen, motions, turned=R_cam_base is None, scaled=False)


def _best(seen: SeenSteps, motions: Iterable[SeenMotion], *, turned: bool, scaled: bool) -> Explanation | None:
    """The motion that most goes along with, once it is fitted."""
    fits = [refined(seen, m, turns=turned, scales=scaled) for m in motions]
    if not fits:
        return None
    motion, support = max(fits, key=lambda fit: fit[1].score)
    return Explanation(motion, support, turned, scaled)
