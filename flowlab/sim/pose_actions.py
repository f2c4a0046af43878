"""Actions as those of a real arm, for MetaWorld's hand: where to be, how to be turned, gripper open or closed."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Float32
from pydantic import Field
from scipy.spatial.transform import Rotation

from flowlab.config import Settings
from flowlab.errors import DataError
from flowlab.sim.simulation import Simulation

POSE_SIZE = 8
"""Position x, y, z [m], quaternion x, y, z, w, and gripper: of an action 1 to close and 0 to open, of a state the
distance between the fingers [m]."""
_STEP_M = 0.01
"""How far a whole unit of MetaWorld's action sends the hand, along each axis."""
_CLOSES = 0.5
"""The gripper number from which on it closes."""
_NORM_TOLERANCE = 0.1
_TURN_LIMIT_DEG = 10.0


class PoseActions(Settings):
    """How actions of eight numbers are meant, and carried out by an arm that MetaWorld never turns."""

    position: Literal["absolute", "relative"] = "absolute"
    """``absolute``: where the hand is sent, in the world [m]. ``relative``: from where it was sent last [m]."""
    every: int = Field(default=3, gt=0)
    """Control steps of MetaWorld to an action, 12.5 ms each; the way is gone evenly in them."""
    efforts: tuple[float, float] = (-1.0, 1.0)
    """Of the gripper, open and closed: what MetaWorld's gripper takes is an effort in [-1, 1], as a real one is told a
    force."""


@dataclass(frozen=True, slots=True)
class PoseArm:
    """The arm of a simulation, told poses. It is sent where MetaWorld's own actions send it: to a target that the hand
    follows some centimeters behind."""

    simulation: Simulation
    settings: PoseActions

    @property
    def state(self) -> Float32[np.ndarray, "8"]:
        """Where the hand is, how it is turned, and how far its fingers are apart [m]: see :data:`POSE_SIZE`."""
        data = self.simulation.data
        fingers = data.site("rightEndEffector").xpos - data.site("leftEndEffector").xpos
        turn = _scipy_order(data.body("hand").xquat)
        return np.array([*data.body("hand").xpos, *turn, np.linalg.norm(fingers)], np.float32)

    @property
    def target(self) -> Float[np.ndarray, "3"]:
        """Where the hand has been sent last [m], world frame."""
        return np.array(self.simulation.data.mocap_pos[0])

    def closes(self, effort: float) -> bool:
        """Whether an effort of the gripper is nearer to that which closes it than to that which opens it."""
        opened, closed = self.settings.efforts
        return abs(effort - closed) < abs(effort - opened)

    def binary(self, action: Float32[np.ndarray, "4"]) -> Float32[np.ndarray, "4"]:
        """MetaWorld's action with the gripper's effort set to one of the two."""
        return np.array([*action[:3], self.settings.efforts[self.closes(float(action[3]))]], np.float32)

    def action(self, start: Float[np.ndarray, "3"], effort: float) -> Float32[np.ndarray, "8"]:
        """What was done since the hand's target was ``start`` [m], as one action."""
        position = self.target - (start if self.settings.position == "relative" else 0)
        turn = _scipy_order(self.simulation.data.mocap_quat[0])
        return np.array([*position, *turn, float(self.closes(effort))], np.float32)

    def steps(self, action: Float[np.ndarray, "8"]) -> Iterator[Float32[np.ndarray, "4"]]:
        """MetaWorld's actions that carry out one of eight numbers, each to be executed before the next is asked for.

        The hand's target gets as far toward what is asked for as 1 cm along each axis in every step allows, and
        MetaWorld keeps it in its own workspace.

        Args:
            action: As the settings mean it. A gripper number from 0.5 on closes; the quaternion's sign does not matter.

        Raises:
            DataError: It is no action, or asks for a turn that MetaWorld's hand cannot take.
        """
        action = np.asarray(action, np.float64)
        self._check(action)
        goal = action[:3] + (self.target if self.settings.position == "relative" else 0)
        effort = self.settings.efforts[bool(action[7] >= _CLOSES)]
        return self._toward(goal, effort)

    def _toward(self, goal: Float[np.ndarray, "3"], effort: float) -> Iterator[Float32[np.ndarray, "4"]]:
        for left in range(self.settings.every, 0, -1):
            way = (goal - self.target) / (left * _STEP_M)
            yield np.array([*np.clip(way, -1, 1), effort], np.float32)

    def _check(self, action: Float[np.ndarray, "..."]) -> None:
        if action.shape != (POSE_SIZE,):
            raise DataError(
                f"action has the shape {action.shape}, expected ({POSE_SIZE},): x, y, z [m], quaternion x, y, z, w, "
                "and gripper, 1 closed and 0 open"
            )
        if not np.isfinite(action).all():
            k = int(np.argmin(np.isfinite(action)))
            raise DataError(f"action[{k}] is {action[k]}, expected a finite number")
        norm = float(np.linalg.norm(action[3:7]))
        if abs(norm - 1) > _NORM_TOLERANCE:
            raise DataError(
                f"action[3:7] is {action[3:7].round(3).tolist()}, of length {norm:.3g}, expected a quaternion x, y, z, "
                "w of length 1"
            )
        held = Rotation.from_quat(_scipy_order(self.simulation.data.mocap_quat[0]))
        turn = np.rad2deg((Rotation.from_quat(action[3:7]) * held.inv()).magnitude())
        if turn > _TURN_LIMIT_DEG:
            raise DataError(
                f"action[3:7] asks for a hand turned by {turn:.0f} degrees, and MetaWorld's is never turned; expected "
                f"{held.as_quat().round(3).tolist()} (x, y, z, w), to within {_TURN_LIMIT_DEG:g} degrees"
            )


def _scipy_order(wxyz: Float[np.ndarray, "4"]) -> Float[np.ndarray, "4"]:
    """MuJoCo's quaternion w, x, y, z as x, y, z, w, of length 1, and of its two signs the one with w from 0 on."""
    unit = np.asarray(wxyz, np.float64) / np.linalg.norm(wxyz)
    w, x, y, z = unit if unit[0] >= 0 else -unit
    return np.array([x, y, z, w])
