"""Which windows of the demonstrations a training step sees."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

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

    def __init__(self, windows: WindowIndex, size: int, segment: int, seed: int, stream: int | None = None) -> None:
        self._windows = windows
        self._segment = min(segment, len(windows.now))
        self._runs = size // segment
        self._seed = (seed,) if stream is None else (seed, stream)
        self._runs_per_epoch = len(windows.now) // self._segment

    @property
    def steps_per_epoch(self) -> float:
        """Steps that see every window once."""
        return self._runs_per_epoch / self._runs

    def windows(self, step: int) -> WindowIndex:
        """The windows of a step."""
        index = self.runs(step * self._runs + np.arange(self._runs), self._segment).reshape(-1)
        run = np.repeat(np.arange(self._runs), self._segment)
        return WindowIndex(self._windows.episode[index], self._windows.now[index], run)

    def runs(self, number: Int[np.ndarray, "R"], length: int) -> Int[np.ndarray, "R L"]:
        """Positions of the windows of some runs, which are numbered through all epochs; behind the last window is the
        first."""
        epoch, position = np.divmod(number, self._runs_per_epoch)
        start = np.empty(len(number), int)
        for e in np.unique(epoch):
            rng = np.random.default_rng([*self._seed, int(e)])
            phase, order = rng.integers(self._segment), rng.permutation(self._runs_per_epoch)
            start[epoch == e] = phase + order[position[epoch == e]] * self._segment
        return (start[:, None] + np.arange(length)) % len(self._windows.now)


class MixedSampler:
    """The windows of every training step from several datasets, each with its share of them, whatever its size.

    Of the first n runs of all steps, a dataset with share w has n w, rounded, give or take one for each other dataset.
    Its own runs are dealt out as by :class:`WindowSampler`, in epochs of its own; a dataset with fewer windows than a
    run repeats them in it.
    """

    def __init__(
        self, windows: Sequence[WindowIndex], weights: Sequence[float], size: int, segment: int, seed: int
    ) -> None:
        self._windows = windows
        self._share = shares(weights)
        self._samplers = [WindowSampler(w, size, segment, seed, k) for k, w in enumerate(windows)]
        self._runs, self._segment = size // segment, segment

    def windows(self, step: int) -> WindowIndex:
        """The windows of a step."""
        origin, number = deal(self._share, step * self._runs, self._runs)
        episode, now = (np.empty((self._runs, self._segment), int) for _ in range(2))
        for k in np.unique(origin):
            mine = origin == k
            index = self._samplers[k].runs(number[mine], self._segment)
            episode[mine], now[mine] = self._windows[k].episode[index], self._windows[k].now[index]
        run = np.repeat(np.arange(self._runs), self._segment)
        return WindowIndex(episode.reshape(-1), now.reshape(-1), run)


def shares(weights: Sequence[float]) -> Float[np.ndarray, "D"]:
    """What part of all windows each of several weights means; they add up to 1."""
    relative = np.array(weights, float) / max(weights)
    return relative / relative.sum()


def deal(share: Float[np.ndarray, "D"], first: int, count: int) -> tuple[Int[np.ndarray, "R"], Int[np.ndarray, "R"]]:
    """Whose each run from the ``first`` on is, and which of its owner's runs it is, both from 0.

    Owner k has its j-th turn at time (j + 1/2) / share; turns are taken in order of time. No two calls need to know of
    each other: what is before ``first`` follows from how many turns each owner has had by then.
    """
    owners = len(share)
    since, until = max(0, first - 2 * owners), first + count + owners
    begin, end = (np.ceil(np.maximum(t * share - 0.5, 0)).astype(int) for t in (since, until))
    lengths = end - begin
    owner = np.repeat(np.arange(owners), lengths)
    turn = np.concatenate([np.arange(a, b) for a, b in zip(begin, end, strict=True)])
    order = np.lexsort((owner, (turn + 0.5) / share[owner]))
    chosen = order[first - begin.sum() :][:count]
    return owner[chosen], turn[chosen]
