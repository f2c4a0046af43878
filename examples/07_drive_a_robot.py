"""Drive a robot with a trained policy: a frame and a state in, an action out, at every control step.

    flowlab train data/drawers --policy fdp --minutes 5 --out runs/drawers
    python examples/07_drive_a_robot.py runs/drawers

The loop is the one you write for a robot of your own. Here a simulated arm stands in for it, with a depth camera: the
class below is all that has to be replaced. It gives a :class:`~flowlab.records.Frame` (depth in meters, and a camera
whose pose is known in the world frame of the training data), the robot's state as in the training data, and it carries
out actions.
"""

import sys

import numpy as np

from flowlab import Policy
from flowlab.records import Frame
from flowlab.sim.recorder import TaskSimulator
from flowlab.sim.scene_settings import SceneSettings

STEPS = 200


class SimulatedRobot:
    """An arm at a table, and a camera that looks at it."""

    def __init__(self, task: str, seed: int) -> None:
        self._episode = TaskSimulator(task, SceneSettings()).begin(seed)
        self.solved = False

    def frame(self) -> Frame:
        """What the camera sees now."""
        return self._episode.frame()

    def state(self) -> np.ndarray:
        """What the robot says of itself now: positions of hand and fingers [m]."""
        return self._episode.simulation.state

    def send(self, action: np.ndarray) -> None:
        """Carry out one control step; like a real arm's, its motion has limits."""
        self.solved |= self._episode.step(np.clip(action, -1, 1))


run, *task = sys.argv[1:]  # a task is needed where a policy was trained on several
policy = Policy.load(run, *task)
robot = SimulatedRobot(policy.task, seed=5_000_000)  # a scene that no demonstration showed
print(f"a plan takes {1000 * policy.warm_up(robot.frame()):.0f} ms")

for step in range(STEPS):
    frame = robot.frame() if policy.wants_frame else None  # most steps need no picture
    robot.send(policy.act(frame, robot.state()))
    if policy.planned_at == step and policy.flow is not None:
        length_mm = 1000 * np.linalg.norm(policy.flow.sum(axis=0), axis=-1)
        print(f"step {step}: a new plan, in which the farthest point moves {length_mm.max():.0f} mm")
    if robot.solved:
        break

print(f"{policy.task}: {'solved' if robot.solved else 'not solved'} after {step + 1} steps")
