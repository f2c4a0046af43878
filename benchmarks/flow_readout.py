"""Actions read off a predicted flow: where the gripper's points will go, and what action makes a gripper go there."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from flowlab.actions.kernel import MOST_ROWS, KernelRegression
from flowlab.records import Episode

_BACK, _AHEAD = 1, 6
"""Steps before and after an action whose motion tells it; a plan has as many on either side of what it executes."""
_UNIT_M = 0.01
_ON_GRIPPER_M, _BELOW_M, _ABOVE_M = 0.1, 0.05, 0.25
"""Query points that an episode begins with this near to the gripper along x and y, and this far below or above it, are
on it or on the hand that carries it, which MetaWorld never turns."""
_COPIES = 6
"""Of the demonstrations, each turned about z by another angle."""


@dataclass(frozen=True, slots=True)
class FlowReadout:
    """What turns the flow of a plan into the displacements that its actions command."""

    start: Float[np.ndarray, "3"]
    """Where the gripper begins, in all demonstrations [m]."""
    regression: KernelRegression

    @classmethod
    def fit(cls, demonstrations: Iterable[Episode], rng: np.random.Generator) -> "FlowReadout":
        """Learn it from how the gripper went and what was commanded.

        Args:
            demonstrations: Episodes of MetaWorld, whose state begins with the gripper's place and whose action begins
                with its displacement along the world's axes.
            rng: Draws turns.

        Raises:
            ValueError: The gripper does not begin where it always does.
        """
        starts, rows, actions = [], [], []
        for episode in demonstrations:
            assert episode.state is not None
            assert episode.action is not None
            hand = np.asarray(episode.state[:, :3], float)
            starts.append(hand[0])
            step = np.diff(np.concatenate([hand, hand[-1:]]), axis=0)
            last = len(step) - 1 - _AHEAD
            rows += [step[k - _BACK : k + _AHEAD + 1] for k in range(_BACK, last)]
            actions += list(np.asarray(episode.action[_BACK:last, :3], float))
        if np.ptp(starts, axis=0).max() > _ON_GRIPPER_M / 4:
            raise ValueError("the gripper begins at different places; which points are on it cannot be told by that")
        x, y = np.stack(rows), np.stack(actions)
        angle = rng.uniform(-np.pi, np.pi, _COPIES * len(x))
        angle[: len(x)] = 0
        c, s, o = np.cos(angle), np.sin(angle), np.zeros_like(angle)
        R = np.stack([np.stack([c, -s, o], 1), np.stack([s, c, o], 1), np.stack([o, o, o + 1], 1)], 1)
        x, y = (
            np.einsum("nij,nkj->nki", R, np.tile(x, (_COPIES, 1, 1))),
            np.einsum("nij,nj->ni", R, np.tile(y, (_COPIES, 1))),
        )
        chosen = rng.permutation(len(x))[:MOST_ROWS]
        x = x.reshape(len(x), -1)[chosen] / _UNIT_M
        return cls(np.mean(starts, 0), KernelRegression.fit(x, y[chosen], ridge=0.01, sharpness=0.3))

    def read(
        self, flow: Float[np.ndarray, "W T M 3"], queries: Float[np.ndarray, "W M 3"], first: int, count: int
    ) -> Float[np.ndarray, "W K 3"]:
        """The displacements commanded by actions ``first`` to ``first + count - 1`` of each window; NaN where no query
        point is on the gripper."""
        off = queries - self.start
        near = (np.abs(off[..., :2]).max(2) < _ON_GRIPPER_M) & (off[..., 2] > -_BELOW_M) & (off[..., 2] < _ABOVE_M)
        hand = np.stack(
            [
                np.median(f[:, n], 1) if n.any() else np.full((f.shape[0], 3), np.nan)
                for f, n in zip(flow, near, strict=True)
            ]
        )
        around = np.arange(first, first + count)[:, None] + np.arange(-_BACK, _AHEAD + 1)
        rows = hand[:, around] / _UNIT_M
        return self.regression.predict(rows.reshape(-1, rows.shape[2] * 3)).reshape(len(flow), count, 3)
