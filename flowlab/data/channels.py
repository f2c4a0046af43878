"""Which numbers of state and action are places in the world, so that scenes can be moved and given relatively."""

import numpy as np

from flowlab.config import Settings
from flowlab.data.replay_buffer import ReplayBuffer
from flowlab.data.source import TrainingSource

_NEAR_M = 0.1
"""The gripper is taken to be where the state says if, in the median, a point of the cloud is this near."""
_REACHED_M = 0.02
"""Actions are taken to be places if, in the median, the gripper is this near to them a step later."""


class ChannelSpec(Settings):
    """Triples of channels that are places in the world frame [m]."""

    gripper: tuple[int, int, int] | None = None
    """Of the state: where the gripper is; None where that is not known."""
    state_positions: tuple[tuple[int, int, int], ...] = ()
    """Of the state: every place, the gripper's too."""
    action_position: tuple[int, int, int] | None = None
    """Of the action: where the gripper is sent to; None where actions are displacements or not known."""
    action_displacement: tuple[int, int, int] | None = None
    """Of the action: how far the gripper is to move along the world's axes; None where that is not known."""

    def turns(self, state_width: int, action_width: int) -> bool:
        """Whether all that has a direction is known, so that a scene can be turned: no quaternions, say.

        Beside its triple, an action may have one number, the gripper's opening.
        """
        known = (self.action_position is not None or self.action_displacement is not None) and action_width <= 4
        return known and self.gripper is not None and state_width == 3 * len(self.state_positions)


def infer_channels(source: TrainingSource, buffer: ReplayBuffer) -> ChannelSpec:
    """The layout of a dataset: known for simulation, measured for recordings, unknown in DP3's frame.

    DP3 gives clouds in its camera's frame and the state in the world's.
    """
    first = (0, 1, 2)
    if "expert" in source.settings:
        if source.settings["expert"]["scene"]["convention"] == "dp3":
            return ChannelSpec()
        fingers = (3, 4, 5), (6, 7, 8)
        return ChannelSpec(gripper=first, state_positions=(first, *fingers), action_displacement=first)
    if not source.settings or buffer.state.shape[1] < 3 or not _gripper_is_seen(buffer):
        return ChannelSpec()
    places = buffer.action.shape[1] >= 3 and _actions_are_places(buffer)
    return ChannelSpec(gripper=first, state_positions=(first,), action_position=first if places else None)


def _gripper_is_seen(buffer: ReplayBuffer) -> bool:
    rows = np.linspace(0, len(buffer.state) - 1, min(len(buffer.state), 200)).astype(int)
    nearest = [np.linalg.norm(buffer.points[r] - buffer.state[r, :3], axis=1).min() for r in rows]
    return bool(np.median(nearest) < _NEAR_M)


def _actions_are_places(buffer: ReplayBuffer) -> bool:
    apart = [
        np.linalg.norm(buffer.action[d.start : d.stop - 1, :3] - buffer.state[d.start + 1 : d.stop, :3], axis=1)
        for d in buffer.demos
    ]
    return bool(np.median(np.concatenate(apart)) < _REACHED_M)
