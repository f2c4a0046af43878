"""Whether poses of a camera have the scale of what it sees: how far it moves by them, and by its pictures."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64

from flowlab.geometry.transforms import inverse
from flowlab.recordings.pose_pairs import FlowPair
from flowlab.recordings.verdicts import Verdict

_LEAST_M, _LEAST_PAIRS = 0.015, 3
"""Pairs between which the camera moves by less tell nothing, nor do fewer pairs."""
_DOUBTED, _WRONG = 1.1, 1.2
"""Poses that are so many times too large or too small are doubtful, and wrong."""
_UNLIKE = (0.2, 0.1)
"""To say so, pairs may differ by this share, in the median."""
_BETTER = (0.9, 0.8)
"""And the scene must stay within this share of what it did, once poses are scaled."""


@dataclass(frozen=True, slots=True)
class PoseScale:
    """How far the camera moves by its pictures, as a share of how far it does by its poses."""

    share: float
    unlike: float
    """By what share pairs of pictures differ from it, in the median."""

    def judged(self, better: float) -> Verdict:
        """What follows if the scene stays within such a share of what it did, once poses are scaled."""
        times = max(self.share, 1 / self.share) if self.share > 0 else 0.0
        for verdict, least, k in ((Verdict.REFUSED, _WRONG, 1), (Verdict.DOUBTFUL, _DOUBTED, 0)):
            if times > least and self.unlike < _UNLIKE[k] and better < _BETTER[k]:
                return verdict
        return Verdict.OK


def estimate_scale(pairs: Sequence[FlowPair], T_world_cam: Float[np.ndarray, "T 4 4"]) -> PoseScale | None:
    """The scale of poses; None where the camera moves too little to tell.

    Args:
        pairs: Points that two rows show.
        T_world_cam: The pose of every row.
    """
    shares = [share for pair in pairs if (share := _share(pair, T_world_cam)) is not None]
    if len(shares) < _LEAST_PAIRS:
        return None
    middle = float(np.median(shares))
    return PoseScale(middle, float(np.median(np.abs(np.array(shares) - middle))) / max(abs(middle), 1e-6))


def scaled(T_world_cam: Float[np.ndarray, "T 4 4"], share: float) -> Float64[np.ndarray, "T 4 4"]:
    """Poses of a camera that moves so many times as far."""
    T = T_world_cam.copy()
    T[:, :3, 3] *= share
    return T


def _share(pair: FlowPair, T_world_cam: np.ndarray) -> float | None:
    """Of two rows alone."""
    first, second = pair.rows
    T_second_first = inverse(T_world_cam[second]) @ T_world_cam[first]
    said = T_second_first[:3, 3]
    seen = np.median(pair.second - pair.first @ T_second_first[:3, :3].T, axis=0)
    length = float(np.linalg.norm(said))
    if max(length, float(np.linalg.norm(seen))) < _LEAST_M or length < 1e-6:
        return None
    return float(seen @ said) / length**2
