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
_LATER = range(1, 16)
"""Or if it is where they are so many steps later, as of an arm that lags: along every axis on which it moves, action
and place rise alike,"""
_ALIKE, _SLOPES = 0.95, (0.8, 1.25)
"""with at least this correlation, and this slope,"""
_LEADS_M = 0.15
"""and are this near to each other in the median, which places relative to where an episode began are not."""
_VARIES_M = 0.01
"""An axis counts where the gripper varies by this along it (one standard deviation); two must."""
_COMMANDED, _MOST_STEPS = 0.8, 5
"""Actions are displacements if along every such axis they are correlated by this with the way of up to so many steps,
and more than with the ways along other axes."""
_ONE_ARM = 10
"""Numbers of an action that may be one arm's: a place, six of a rotation, a gripper. Of more, nobody knows what else is
a place."""
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

    @property
    def shifts(self) -> bool:
        """Whether a scene can be shifted with all that is said of it: whoever does not know what an action is cannot
        say what it would be elsewhere, as of angles of joints."""
        known = self.action_position is not None or self.action_displacement is not None
        return known and self.gripper is not None

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
    found = ChannelSpec(gripper=first, state_positions=(first,))
    if not 3 <= buffer.action.shape[1] <= _ONE_ARM:
        return found
    if _actions_are_positions(buffer):
        return found.model_copy(update={"action_position": first})
    return found.model_copy(update={"action_displacement": first if _actions_are_displacements(buffer) else None})


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
    """Whether the gripper is where its actions sent it, at once or later."""
    for steps in _LATER:
        sent, there, _ = _paired(buffer, steps)
        apart = float(np.median(np.linalg.norm(sent - there, axis=1))) if len(sent) else np.inf
        if steps == 1 and apart < _REACHED_M:
            return True
        axes = _moving_axes(there)
        if len(axes) < 2 or apart > _LEADS_M:
            continue
        alike = np.array([_correlation(sent[:, k], there[:, k]) for k in axes])
        slope = alike * sent.std(0)[axes] / there.std(0)[axes]
        if alike.min() > _ALIKE and _SLOPES[0] < slope.min() and slope.max() < _SLOPES[1]:
            return True
    return False


def _actions_are_displacements(buffer: ReplayBuffer) -> bool:
    """Whether the gripper goes along the world's axes as its actions say, in whatever unit."""
    for steps in range(1, _MOST_STEPS + 1):
        sent, there, way = _paired(buffer, steps)
        axes = _moving_axes(there)
        if len(axes) < 2:
            continue
        alike = np.array([[_correlation(sent[:, k], way[:, j]) for j in axes] for k in axes])
        if np.diag(alike).min() > _COMMANDED and (np.abs(alike).argmax(1) == np.arange(len(axes))).all():
            return True
    return False


def _moving_axes(places: np.ndarray) -> np.ndarray:
    """The axes along which places vary."""
    return np.flatnonzero(places.std(0) > _VARIES_M) if len(places) else np.zeros(0, int)


def _paired(buffer: ReplayBuffer, steps: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """First three numbers of the actions, where the gripper is so many steps later, and its way until then [m]."""
    rows = np.concatenate([np.arange(e.start, max(e.stop - steps, e.start)) for e in buffer.episodes])
    there = np.asarray(buffer.state[rows + steps, :3], float)
    return np.asarray(buffer.action[rows, :3], float), there, there - buffer.state[rows, :3]


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Pearson's; 0 where one of them is always the same."""
    spread = float(a.std() * b.std())
    return float(((a - a.mean()) * (b - b.mean())).mean() / spread) if spread > 0 else 0.0
