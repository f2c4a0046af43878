"""Which numbers of state and action are positions in the world, so that scenes can be moved and given relatively."""

import logging
from collections.abc import Iterator, Sequence

import numpy as np

from flowlab.config import Settings
from flowlab.data.replay_buffer import EpisodeSlice, ReplayBuffer
from flowlab.data.source import TrainingSource
from flowlab.errors import DataError
from flowlab.provenance import Channels

_LOG = logging.getLogger(__name__)
_NEAR_M = 0.1
"""Tracks that may show that the gripper is where the state says are this near."""
_MOTION_M = 0.03
"""The gripper has moved when it has moved this far."""
_FOLLOWS = 0.25
"""A point moves with the gripper where it moves, and takes it to where it is up to this share of the way."""
_BODY = 3
"""So many points tell how a held thing turns, and so where it takes the gripper."""
_PROOFS = 3
"""So many motions, and half of those with a track nearby, must have points that move with the gripper."""
_REACHED_M = 0.02
"""Actions are taken to be positions if, in the median, the gripper is this near to them a step later."""
Triple = tuple[int, int, int]


class ChannelSpec(Settings):
    """Triples of channels that are positions in the world frame [m]."""

    gripper: Triple | None = None
    """Of the state: where the gripper is; None where that is not known."""
    state_positions: tuple[Triple, ...] = ()
    """Of the state: every position, the gripper's too."""
    action_position: Triple | None = None
    """Of the action: where the gripper is sent to; None where actions are displacements or not known."""
    action_displacement: Triple | None = None
    """Of the action: how far the gripper is to move along the world's axes; None where that is not known."""

    def turns(self, state_width: int, action_width: int) -> bool:
        """Whether all that has a direction is known, so that a scene can be turned: no quaternions, say.

        Beside its triple, an action may have one number, the gripper's opening.
        """
        known = (self.action_position is not None or self.action_displacement is not None) and action_width <= 4
        return known and self.gripper is not None and state_width == 3 * len(self.state_positions)


def infer_channels(source: TrainingSource, buffer: ReplayBuffer) -> ChannelSpec:
    """The channels of a dataset: as its provenance says; where a recording's says nothing, as its numbers show.

    What is neither said nor a recording's, or is said to be in another frame than the clouds, is not known.
    """
    about = source.provenance
    if about.state is not None or about.action is not None:
        for name, told, width in (("state", about.state, buffer.state.shape[1]),
                                  ("action", about.action, buffer.action.shape[1])):  # fmt: skip
            if any(not 0 <= k < width for c in told or () for k in c.index):
                raise DataError(
                    f"{source.path}: its provenance names a number of the {name} that is not there; each has {width}"
                )
        return _as_stated(about.state or (), about.action or ())
    if about.kind != "recorded" or buffer.state.shape[1] < 3:
        return ChannelSpec()
    if not _gripper_is_seen(buffer):
        _LOG.info("flowlab: %s: no tracks move with the first three numbers of the state, so they are not taken as the "
                  "gripper's position; clouds and actions stay in the world", source.path)  # fmt: skip
        return ChannelSpec()
    first = (0, 1, 2)
    to_positions = buffer.action.shape[1] >= 3 and _actions_are_positions(buffer)
    return ChannelSpec(gripper=first, state_positions=(first,), action_position=first if to_positions else None)


def _as_stated(state: Sequence[Channels], action: Sequence[Channels]) -> ChannelSpec:
    """The gripper is the first position of a state."""
    positions = _triples(state, "position", ("m",))
    return ChannelSpec(
        gripper=positions[0] if positions else None,
        state_positions=tuple(positions),
        action_position=next(iter(_triples(action, "position", ("m",))), None),
        # A displacement is only turned, so that its unit does not matter.
        action_displacement=next(iter(_triples(action, "displacement", None)), None),
    )


def _triples(channels: Sequence[Channels], kind: str, units: tuple[str, ...] | None) -> list[Triple]:
    """The triples of a kind along the axes of the world frame, in order of their first channel."""
    found = [
        (c.index[0], c.index[1], c.index[2])
        for c in channels
        if c.kind == kind and c.frame == "world" and len(c.index) == 3 and (units is None or c.unit in units)
    ]
    return sorted(found)


def _gripper_is_seen(buffer: ReplayBuffer) -> bool:
    """Whether what is near the first three numbers of the state moves with them: nearness alone may be chance."""
    moved = [with_it for e in buffer.episodes for with_it in _motions(buffer, e)]
    return len(moved) >= _PROOFS and sum(moved) >= max(_PROOFS, len(moved) / 2)


def _motions(buffer: ReplayBuffer, episode: EpisodeSlice) -> Iterator[bool]:
    """For every motion of the gripper with tracks nearby, whether most of those that move do so as it does."""
    last = episode.start
    for t in range(episode.start + 1, episode.stop):
        way = buffer.state[t, :3] - buffer.state[last, :3]
        length = float(np.linalg.norm(way))
        if length < _MOTION_M:
            continue
        then, now = buffer.tracks[last], buffer.tracks[t]
        near = np.linalg.norm(then - buffer.state[last, :3], axis=1) < _NEAR_M
        near &= buffer.visible[last] & buffer.visible[t]
        moves = near & (np.linalg.norm(now - then, axis=1) > _FOLLOWS * length)
        if near.any():
            yield bool(_off_way(then[moves], now[moves], buffer.state[last, :3], way) < _FOLLOWS * length)
        last = t


def _off_way(then: np.ndarray, now: np.ndarray, gripper: np.ndarray, way: np.ndarray) -> float:
    """How far from its way points take a gripper with them [m]: all as they move, or as a body that turns."""
    from flowlab.tracking.trackers.rigid_bodies.rigid_motion import fit_rigid  # with which Numba is loaded

    if not len(then):
        return float("inf")
    alike = float(np.median(np.linalg.norm(now - then - way, axis=1)))
    if len(then) < _BODY:  # they turn about an axis that is not known, but stay as far away
        before, after = np.linalg.norm(then - gripper, axis=1), np.linalg.norm(now - gripper - way, axis=1)
        return alike if len(then) == 1 else min(alike, float(np.abs(after - before).max()))
    R, t = fit_rigid(then, now, np.ones(len(then)), refinements=0)
    return min(alike, float(np.linalg.norm(R @ gripper + t - gripper - way)))


def _actions_are_positions(buffer: ReplayBuffer) -> bool:
    apart = [
        np.linalg.norm(buffer.action[e.start : e.stop - 1, :3] - buffer.state[e.start + 1 : e.stop, :3], axis=1)
        for e in buffer.episodes
    ]
    return bool(np.median(np.concatenate(apart)) < _REACHED_M)
