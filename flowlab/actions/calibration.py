"""How far off inferred numbers are: measured on demonstrations that were left out, stated for every step of a film."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from flowlab.actions.kernel import KernelRegression
from flowlab.actions.robot import RobotLayout
from flowlab.provenance import ChannelError
from flowlab.records import Episode

_ONE_SIGMA = 0.68
_ROWS = 1200
"""So many rows tell how an error goes with the gripper's pace."""
_LEAST_M = 0.0008
"""No number that was read off a sampled cloud is surer than this [m, or its own unit]."""
_OF_USUAL = 0.5
"""No action is surer than this share of what 68 % of the errors on demonstrations left out are below: films are labeled
with one demonstration more than these were, so that errors as large as theirs are rare (chosen on three tasks, looked
at on five others)."""


@dataclass(frozen=True, slots=True)
class InferredRows:
    """State and actions of an episode, with spreads that are still to be calibrated."""

    state: Float[np.ndarray, "T S"]
    action: Float[np.ndarray, "T A"]
    state_spread: Float[np.ndarray, "T S"]
    action_spread: Float[np.ndarray, "T A"]
    pace: Float[np.ndarray, "T d"]
    """How fast the gripper is, by which the size of an action's error is told."""
    tracks: int
    """Tracks that lie on the gripper; 0 where clouds alone told where it is."""
    fit: float
    """How well the gripper's shape fits, in the median; 1 is as usual."""


@dataclass(frozen=True, slots=True)
class ErrorCalibration:
    """By how much spreads are to be multiplied, so that 68 % of errors lie below them."""

    state: Float[np.ndarray, "S"]
    action: Float[np.ndarray, "A"]
    size: KernelRegression
    """Of an action's error over its spread, by the gripper's pace: its logarithm."""
    usual: tuple[Float[np.ndarray, "S"], Float[np.ndarray, "A"]]
    """Of state and action the error that 68 % of all lay below on the demonstrations left out."""
    errors: tuple[ChannelError, ...]
    """What was found there."""
    fit: float
    """How well the gripper's shape fitted there, at the worst."""

    def sigma(self, rows: InferredRows) -> tuple[Float[np.ndarray, "T S"], Float[np.ndarray, "T A"]]:
        """The stated errors of state and action: never less than what is usual of the demonstrations left out, or half
        of it, since a film is hardly surer than they are."""
        state, action = self.usual
        return (
            np.maximum(rows.state_spread * self.state, np.maximum(state, _LEAST_M)),
            np.maximum(_sized(rows, self.size) * self.action, _OF_USUAL * action),
        )


def calibrate(truth: Sequence[Episode], guessed: Sequence[InferredRows], layout: RobotLayout) -> ErrorCalibration:
    """Compare what was inferred of demonstrations that were left out with what is known of them.

    Args:
        truth: The demonstrations.
        guessed: What was inferred of each by what the others taught.
        layout: Which numbers are a rotation: all of these are scaled alike.
    """
    every = range(len(truth))
    scaled = [_sized(g, _size(truth, guessed, [j for j in every if j != k])) for k, g in enumerate(guessed)]
    turn, target_turn = ([*r.index] if r else [] for r in (layout.rotation, layout.target_rotation))
    states = _calibrated("state", truth, [g.state for g in guessed], [g.state_spread for g in guessed], turn)
    actions = _calibrated("action", truth, [g.action for g in guessed], scaled, target_turn)
    few = (len(truth) + 1) / len(truth)  # of few demonstrations, the worst was hardly seen
    return ErrorCalibration(
        states.factor * few, actions.factor, _size(truth, guessed, every), (states.usual * few, actions.usual),
        (*states.errors, *actions.errors), min(g.fit for g in guessed),
    )  # fmt: skip


def _factor(ratio: Sequence[np.ndarray], turn: list[int]) -> Float[np.ndarray, "C"]:
    """By how much 68 % of errors are at most larger than their spread: one factor for the numbers of a rotation, of
    which few demonstrations tell too little one by one."""
    found = np.concatenate(ratio)
    factor = np.quantile(found, _ONE_SIGMA, axis=0)
    factor[turn] = np.quantile(found[:, turn], _ONE_SIGMA) if turn else 0.0
    return np.asarray(factor)


@dataclass(frozen=True, slots=True)
class _Calibrated:
    """What was found of a state or an action."""

    factor: Float[np.ndarray, "C"]
    """What spreads are to be multiplied with."""
    usual: Float[np.ndarray, "C"]
    errors: list[ChannelError]


def _size(truth: Sequence[Episode], guessed: Sequence[InferredRows], used: Sequence[int]) -> KernelRegression:
    """How an action's error over its spread, in logarithms, goes with the gripper's pace."""
    off = np.concatenate([np.abs(guessed[k].action - truth[k].action) for k in used])
    spread, x = (np.concatenate([getattr(guessed[k], n) for k in used]) for n in ("action_spread", "pace"))
    step = -(-len(x) // _ROWS)
    y = np.log(off + 0.02 * spread) - np.log(spread)
    return KernelRegression.fit(x[::step], y[::step], ridge=3.0, sharpness=1.0)


def _sized(rows: InferredRows, size: KernelRegression) -> np.ndarray:
    """The spread of actions, given the gripper's pace."""
    return rows.action_spread * np.exp(size.predict(rows.pace))


def _calibrated(
    array: Literal["state", "action"],
    truth: Sequence[Episode],
    guessed: Sequence[np.ndarray],
    spread: Sequence[np.ndarray],
    turn: list[int],
) -> _Calibrated:
    """Compare each number with what is known of it."""
    off = [np.abs(g - getattr(t, array)) for g, t in zip(guessed, truth, strict=True)]
    ratio = [o / np.maximum(s, 1e-9) for o, s in zip(off, spread, strict=True)]
    within = [r <= _factor([x for j, x in enumerate(ratio) if j != k], turn) for k, r in enumerate(ratio)]
    mean, share = np.concatenate(off).mean(0), np.concatenate(within).mean(0)
    varies = np.concatenate([getattr(t, array) for t in truth]).std(0)
    errors = [
        ChannelError(
            array=array, index=c, mean_error=float(mean[c]), varies=float(varies[c]), within_sigma=float(share[c])
        )
        for c in range(len(mean))
    ]
    return _Calibrated(
        np.maximum(_factor(ratio, turn), 1e-6), np.quantile(np.concatenate(off), _ONE_SIGMA, axis=0), errors
    )
