"""From the gripper's motion to the action that made it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from flowlab.actions.kernel import MOST_ROWS, KernelRegression
from flowlab.actions.linear import LinearPart
from flowlab.actions.robot import GripperPath, RobotLayout
from flowlab.actions.sight import SeenRobot

_BACK, _AHEAD = 2, 10
"""Steps before and after an action that are looked at."""
_OFFSETS = np.arange(-_BACK, _AHEAD + 1)
_UNIT_M = 0.02
"""What a displacement is given in."""
_TURN_UNIT = 0.2
"""[rad]"""
_DRAWS = 4
"""Times a path is disturbed by its own error, to see what that does to actions."""


@dataclass(frozen=True, slots=True)
class GripperMotion:
    """What an action is inferred from, row by row."""

    way: Float[np.ndarray, "T k 3"]
    """Where the gripper is around every instant, relative to where it is then, along the world's axes [m]."""
    turn: Float[np.ndarray, "T k 3"]
    """How it is turned, relative to how it is then, as a rotation vector in its own axes [rad]; k is 0 where that is
    not known."""
    grip: Float[np.ndarray, "T g"]
    """What else the state tells around every instant, and how much of the demonstration is before and after it."""

    def rows(self, chosen: np.ndarray) -> "GripperMotion":
        """Some of the instants."""
        return GripperMotion(self.way[chosen], self.turn[chosen], self.grip[chosen])

    def features(self) -> Float[np.ndarray, "T d"]:
        """All of it in one row."""
        n = len(self.way)
        parts = [self.way.reshape(n, -1) / _UNIT_M, self.turn.reshape(n, -1) / _TURN_UNIT, self.grip]
        return np.concatenate(parts, 1)

    def pace(self) -> Float[np.ndarray, "T d"]:
        """How fast the gripper is around every instant, whatever the direction."""
        far, up = np.linalg.norm(self.way, axis=2), np.abs(self.way[..., 2])
        return np.concatenate([far / _UNIT_M, up / _UNIT_M, self.grip], 1)

    @classmethod
    def join(cls, motions: "Sequence[GripperMotion]") -> "GripperMotion":
        """Some one behind the other."""
        way, turn, grip = (np.concatenate([getattr(m, n) for m in motions]) for n in ("way", "turn", "grip"))
        return cls(way, turn, grip)

    def turned(self, M: Float[np.ndarray, "T 3 3"]) -> "GripperMotion":
        """The same in a scene that was turned or mirrored."""
        return GripperMotion(np.einsum("tij,tkj->tki", M, self.way), self.turn, self.grip)


def motion_of(
    layout: RobotLayout, path: GripperPath, rest: Float[np.ndarray, "T r"], unit: Float[np.ndarray, "r"]
) -> GripperMotion:
    """What the actions of an episode are inferred from.

    Args:
        layout: What the numbers of a state are.
        path: The gripper's.
        rest: What else the state tells; see :meth:`RobotLayout.rest`.
        unit: What its numbers are given in.
    """
    frames = len(path)
    around = np.clip(np.arange(frames)[:, None] + _OFFSETS, 0, frames - 1)
    way = path.position[around] - path.position[:, None]
    turn = np.zeros((frames, 0, 3))
    if path.R is not None:
        relative = np.swapaxes(path.R, 1, 2)[:, None] @ path.R[around]
        turn = Rotation.from_matrix(relative.reshape(-1, 3, 3)).as_rotvec().reshape(frames, -1, 3)
    parts = rest[:, : 3 * len(layout.positions)].reshape(frames, -1, 3)
    apart = [np.linalg.norm(parts[:, a] - parts[:, b], axis=1) / _UNIT_M
             for a in range(parts.shape[1]) for b in range(a)]  # fmt: skip
    if parts.shape[1] == 1:
        apart = [np.linalg.norm(parts[:, 0], axis=1) / _UNIT_M]
    others = (rest / np.maximum(unit, 1e-6))[:, 3 * len(layout.positions) :]
    grip = np.concatenate([np.stack(apart, 1) if apart else np.zeros((frames, 0)), others], 1)
    left = np.minimum(frames - 1 - np.arange(frames), _AHEAD) / _AHEAD
    gone = np.minimum(np.arange(frames), _BACK) / _BACK
    return GripperMotion(way, turn, np.concatenate([grip[around].reshape(frames, -1), left[:, None], gone[:, None]], 1))


@dataclass(frozen=True, slots=True)
class InverseModel:
    """A fitted inverse model: actions by motion, relative to the gripper."""

    layout: RobotLayout
    linear: LinearPart
    regression: KernelRegression
    """Of what the linear part leaves."""
    unit: Float[np.ndarray, "A"]
    """How much each number varies."""

    def infer(self, motion: GripperMotion, path: GripperPath, like: Float[np.ndarray, "A"]) -> Float[np.ndarray, "T A"]:
        """The actions of an episode, in the dataset's units; ``like`` is one of the demonstrations."""
        return _absolute(self.layout, self.relative(motion), path, like)

    def relative(self, motion: GripperMotion) -> Float[np.ndarray, "T A"]:
        """The same relative to the gripper; of a rotation three numbers are used."""
        return self.linear.predict(motion) + self.regression.predict(motion.features())

    def novelty(self, motion: GripperMotion) -> Float[np.ndarray, "T"]:
        """How unlike the demonstrations a motion is, from 0 to 1."""
        return self.regression.novelty(motion.features())


def fit_inverse(
    layout: RobotLayout,
    motion: GripperMotion,
    path: GripperPath,
    action: Float[np.ndarray, "F A"],
    rng: np.random.Generator,
    *,
    sure: int,
    ridge: float,
) -> InverseModel:
    """Fit it on demonstrations; where all that has a direction is known, in scenes turned about z and mirrored, too.

    Args:
        layout: What the numbers are.
        motion: Of every frame.
        path: The gripper's pose in every frame.
        action: The action of every frame.
        rng: Draws turns.
        sure: So many of the frames, the first ones, are as they were recorded; the linear part is fitted to these.
        ridge: Of what the linear part leaves; a large one leaves it alone.
    """
    relative = _relative(layout, action.astype(float), path)
    linear = LinearPart.fit(layout, motion.rows(np.arange(sure)), relative[:sure])
    left = relative - linear.predict(motion)
    frames = len(motion.way)
    copies = max(1, MOST_ROWS // frames) if layout.turns else 1
    rows = np.tile(np.arange(frames), min(copies, 16))[:MOST_ROWS]
    if frames > MOST_ROWS:
        rows = np.sort(rng.choice(frames, MOST_ROWS, replace=False))
    motion, left = motion.rows(rows), left[rows]
    if layout.turns:
        M = _turns(len(rows), rng, mirrors=path.R is None)
        M[: min(frames, len(rows))] = np.eye(3)  # each as it was, too
        motion = motion.turned(M)
        left[:, layout.vector] = np.einsum("tij,tj->ti", M, left[:, layout.vector])
    unit = np.maximum(action.std(0).astype(float), 1e-6)
    regression = KernelRegression.fit(motion.features(), left, ridge=ridge, sharpness=1.0)
    return InverseModel(layout, linear, regression, unit)


def disturbed(
    model: InverseModel, layout: RobotLayout, seen: SeenRobot, unit: Float[np.ndarray, "r"], rng: np.random.Generator
) -> Float[np.ndarray, "T A"]:
    """By how much actions change where the path is off by its own error."""
    path, jitter = seen.path.path, seen.path.jitter_m[:, None]

    def actions(position: np.ndarray) -> np.ndarray:
        return model.relative(motion_of(layout, path.moved_to(position), seen.rest, unit))

    plain = actions(path.position)
    if not jitter.any():
        return np.zeros_like(plain)
    off = [actions(path.position + rng.normal(size=path.position.shape) * jitter) - plain for _ in range(_DRAWS)]
    return np.sqrt(np.mean(np.square(off), 0))


def _turns(count: int, rng: np.random.Generator, *, mirrors: bool) -> Float[np.ndarray, "n 3 3"]:
    """Random turns about z, half of them with a mirror where that is wanted."""
    angle = rng.uniform(0, 2 * np.pi, count)
    side = rng.choice([1.0, -1.0], count) if mirrors else np.ones(count)
    M = np.zeros((count, 3, 3))
    M[:, 0, 0], M[:, 0, 1], M[:, 1, 0], M[:, 1, 1] = (
        np.cos(angle),
        -np.sin(angle) * side,
        np.sin(angle),
        np.cos(angle) * side,
    )
    M[:, 2, 2] = 1
    return M


def _relative(layout: RobotLayout, action: np.ndarray, path: GripperPath) -> np.ndarray:
    """Actions relative to the gripper; of a rotation three numbers are used, the rest are 0."""
    action = action.copy()
    if layout.target is not None:
        action[:, layout.target] -= path.position
    if layout.target_rotation is not None and path.R is not None:
        index = list(layout.target_rotation.index)
        turn = Rotation.from_matrix(np.swapaxes(path.R, 1, 2) @ layout.target_rotation.read(action)).as_rotvec()
        action[:, index] = 0
        action[:, index[:3]] = turn
    return action


def _absolute(layout: RobotLayout, relative: np.ndarray, path: GripperPath, like: np.ndarray) -> np.ndarray:
    action = relative.copy()
    if layout.target is not None:
        action[:, layout.target] += path.position
    if layout.target_rotation is not None and path.R is not None:
        index = list(layout.target_rotation.index)
        R = path.R @ Rotation.from_rotvec(relative[:, index[:3]]).as_matrix()
        action[:, index] = layout.target_rotation.write(R, like[index])
    return action
