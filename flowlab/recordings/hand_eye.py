"""Where a camera is mounted on what its poses are of, as on a hand: told by how both move."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64
from scipy.spatial.transform import Rotation

from flowlab.geometry.transforms import inverse, rigid
from flowlab.recordings.pose_pairs import FlowPair, rotation_between
from flowlab.recordings.verdicts import Verdict

_LEAST_PAIRS = 4
"""Fewer pairs of pictures tell nothing."""
_TURNED_RAD, _FAR_TURNED_RAD = float(np.radians(5.0)), float(np.radians(10.0))
"""A camera that is turned by less may as well be what its poses are of, by more surely is not. That it is away alone is
not told: before what it goes around, depth or a focal length that errs by some percent looks alike."""
_BETTER, _MOST = (0.7, 0.5), 0.85
"""Poses are doubtful, and wrong, if the scene stays within this share of what it did where they are taken for the
hand's, and is better in so many of the pairs."""
_GAIN_M = 0.002
"""And by so much [m]."""
_OTHER_AXES = 0.05
"""Turns and steps that leave less than this share for a second direction do not tell how a camera is turned."""
_ROUNDS = 4
_RIDGE = 1e-3
"""Keeps the camera at the hand where nothing tells how far away it is: a hand that does not turn."""


@dataclass(frozen=True, slots=True)
class HandEye:
    """Where a camera is on what its poses are of."""

    T_hand_cam: Float64[np.ndarray, "4 4"]

    @property
    def turn_rad(self) -> float:
        """By how much it is turned."""
        return float(Rotation.from_matrix(self.T_hand_cam[:3, :3]).magnitude())

    @property
    def away_m(self) -> float:
        """How far away it is."""
        return float(np.linalg.norm(self.T_hand_cam[:3, 3]))

    def judged(self, off_m: Float64[np.ndarray, "P"], mounted_m: Float64[np.ndarray, "P"], floor_m: float) -> Verdict:
        """What follows from within what the scene stays, in each pair, as it is and with poses taken for the hand's.

        Of 73 films with true poses none is told, neither where depth or the focal length is off by 5 %, nor with noise
        of 2 mm and 0.5 degrees; where the camera is turned by 20 degrees 55 are.

        Args:
            off_m: As it is [m].
            mounted_m: With poses taken for the hand's [m].
            floor_m: What sensors and flow err by [m].
        """
        off, best = float(np.median(off_m)), float(np.median(mounted_m))
        explains = best <= min(_BETTER[0] * off, off - _GAIN_M, floor_m) and (mounted_m < off_m).mean() >= _MOST
        if self.turn_rad < _TURNED_RAD or not explains:
            return Verdict.OK
        sure = self.turn_rad >= _FAR_TURNED_RAD and best <= _BETTER[1] * off
        return Verdict.REFUSED if sure else Verdict.DOUBTFUL


def estimate_hand_eye(pairs: Sequence[FlowPair], T_world_hand: Float[np.ndarray, "T 4 4"]) -> HandEye | None:
    """Where a camera is on a hand, from how the hand moves by poses and the scene by pictures; None where that is too
    little to tell.

    Rotations about axes and steps along directions are turned alike between the two frames; what the hand's own turns
    move the camera is then told by how far away it is, and taken from the steps.

    Args:
        pairs: Points that two rows show.
        T_world_hand: The pose of every row.
    """
    if len(pairs) < _LEAST_PAIRS:
        return None
    far = float(np.median([np.median(p.first[:, 2]) for p in pairs]))
    said = np.stack([inverse(T_world_hand[p.rows[1]]) @ T_world_hand[p.rows[0]] for p in pairs])
    fits = [p.fit() for p in pairs]
    steps = np.stack([f.t for f in fits])
    turns_hand, turns_cam = (far * Rotation.from_matrix(R).as_rotvec() for R in
                             (said[:, :3, :3], np.stack([f.R for f in fits])))  # fmt: skip
    turned = np.eye(3) - said[:, :3, :3]
    t = np.zeros(3)
    for _ in range(_ROUNDS):
        R = rotation_between(
            np.concatenate([turns_cam, steps]), np.concatenate([turns_hand, said[:, :3, 3] - turned @ t])
        )
        M, rest = turned.reshape(-1, 3), (said[:, :3, 3] - steps @ R.T).ravel()
        t = np.linalg.solve(M.T @ M + _RIDGE * len(pairs) * np.eye(3), M.T @ rest)
    return HandEye(rigid(R, t))
