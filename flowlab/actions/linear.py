"""The part of an action that is a weighted sum of the motion around it: most of it, where actions are targets."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from flowlab.actions.robot import RobotLayout

if TYPE_CHECKING:
    from flowlab.actions.inverse import GripperMotion

_RIDGE = 1e-4
"""Of the mean square of a column."""


@dataclass(frozen=True, slots=True)
class LinearPart:
    """Weights of the instants around an action, the same for x, y and z, so that they hold in any direction."""

    layout: RobotLayout
    way: Float[np.ndarray, "k"]
    turn: Float[np.ndarray, "k"]
    grip: Float[np.ndarray, "g o"]
    """For all numbers that have no direction; the last row is what is added always."""

    @classmethod
    def fit(cls, layout: RobotLayout, motion: "GripperMotion", action: Float[np.ndarray, "F A"]) -> "LinearPart":
        """Fit it to actions relative to the gripper; where there are none, it is nothing."""
        way, turn = np.zeros(motion.way.shape[1]), np.zeros(motion.turn.shape[1])
        if not len(action):
            return cls(layout, way, turn, np.zeros((motion.grip.shape[1] + 1, len(layout.other_action))))
        if layout.vector is not None:
            way = _ridge(_columns(motion.way), action[:, layout.vector].reshape(-1))
        if layout.target_rotation is not None and len(turn):
            turn = _ridge(_columns(motion.turn), action[:, layout.target_rotation.index[:3]].reshape(-1))
        return cls(layout, way, turn, _ridge(_with_one(motion.grip), action[:, layout.other_action]))

    def predict(self, motion: "GripperMotion") -> Float[np.ndarray, "T A"]:
        """Actions relative to the gripper, as far as they are such a sum."""
        action = np.zeros((len(motion.way), self.layout.action_width))
        if self.layout.vector is not None:
            action[:, self.layout.vector] = np.einsum("k,tkc->tc", self.way, motion.way)
        if self.layout.target_rotation is not None and len(self.turn):
            action[:, self.layout.target_rotation.index[:3]] = np.einsum("k,tkc->tc", self.turn, motion.turn)
        action[:, self.layout.other_action] = _with_one(motion.grip) @ self.grip
        return action


def _columns(vectors: np.ndarray) -> np.ndarray:
    """(T, k, 3) as rows for x, y and z of every instant."""
    return vectors.transpose(0, 2, 1).reshape(-1, vectors.shape[1])


def _with_one(x: np.ndarray) -> np.ndarray:
    return np.concatenate([x, np.ones((len(x), 1))], 1)


def _ridge(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Weights of columns, each measured in its own size: steps nearby count as much as those far ahead."""
    size = np.sqrt((x**2).mean(0)) + 1e-9
    x = x / size
    weights = np.linalg.solve(x.T @ x + _RIDGE * len(x) * np.eye(x.shape[1]), x.T @ y)
    return (weights.T / size).T
