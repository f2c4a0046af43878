"""Which windows of the demonstrations a training step sees."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int

from flowlab.data.replay_buffer import ReplayBuffer


@dataclass(frozen=True, slots=True)
class WindowIndex:
    """Some windows of a :class:`~flowlab.data.replay_buffer.ReplayBuffer`, in runs of consecutive ones."""

    episode: Int[np.ndarray, "W"]
    now: Int[np.ndarray, "W"]
    """Row of the frame that the action is decided at."""
    run: Int[np.ndarray, "W"]
    """Which run each belongs to."""


def index_windows(buffer: ReplayBuffer, episodes: Sequence[int], n_action_steps: int) -> WindowIndex:
    """Every window of some episodes: actions are decided on up to ``n_action_steps`` steps before the end (DP3)."""
    length = [max(1, len(buffer.episodes[e]) - n_action_steps + 1) for e in episodes]
    now = [buffer.episodes[e].start + np.arange(n) for e, n in zip(episodes, length, strict=True)]
    return WindowIndex(np.repeat(episodes, length), np.concatenate(now), np.zeros(sum(length), int))


class WindowSampler:
    """The windows of every training step, a function of (seed, step) alone.

    Each epoch cuts all windows into runs, from a random place on, and deals the runs out in random order; fewer than a
    run's windows are left out.
    """

    def __init__(self, windows: WindowIndex, size: int, segment: int, seed: int) -> None:
        self._windows = windows
        self._segment = min(segment, len(windows.now))
        self._runs = size // segment
        self._seed = seed
        self._runs_per_epoch = len(windows.now) // self._segment

    @property
    def steps_per_epoch(self) -> float:
        """Steps that see every window once."""
        return self._runs_per_epoch / self._runs

    def windows(self, step: int) -> WindowIndex:
        """The windows of a step."""
        number = step * self._runs + np.arange(self._runs)
        epoch, position = np.divmod(number, self._runs_per_epoch)
        start = np.empty(self._runs, int)
        for e in np.unique(epoch):
            rng = np.random.default_rng([self._seed, int(e)])
            phase, order = rng.integers(self._segment), rng.permutation(self._runs_per_epoch)
            start[epoch == e] = phase + order[position[epoch == e]] * self._segment
        index = (start[:, None] + np.arange(self._segment)).reshape(-1) % len(self._windows.now)
        run = np.repeat(np.arange(self._runs), self._segment)
        return WindowIndex(self._windows.episode[index], self._windows.now[index], run)
