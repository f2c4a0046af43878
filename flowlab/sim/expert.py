"""MetaWorld's scripted experts, who show how a task is done."""

import warnings
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float32
from metaworld import policies

if TYPE_CHECKING:
    from flowlab.sim.simulation import Simulation


class Expert:
    """MetaWorld's scripted policy of a task."""

    def __init__(self, simulation: "Simulation") -> None:
        self._simulation = simulation
        self._policy = getattr(policies, simulation.task.expert)()

    def act(self) -> Float32[np.ndarray, "4"]:
        """The next action, clipped to [-1, 1]: what is executed, and what a policy should learn."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the policies warn at every step that needs clipping
            action = self._policy.get_action(self._simulation.observation)
        return np.clip(action, -1, 1).astype(np.float32)
