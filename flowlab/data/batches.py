"""From demonstrations to batches: which windows a training step sees, and their tensors."""

import math
from dataclasses import dataclass, fields
from typing import Any, Self

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from flowlab.data.augmentation import SceneAugmentation
from flowlab.data.channels import ChannelSpec
from flowlab.data.replay_buffer import ReplayBuffer
from flowlab.errors import DataError, UsageError
from flowlab.geometry.sampling import farthest_points
from flowlab.perception.observer import pad
from flowlab.policies.settings import MotionSettings, TrainSettings
from flowlab.records import Role

_OBJECT_SHARE = 1 / 3
"""Of stratified queries; the default of :class:`~flowlab.perception.queries.QuerySettings`."""


@dataclass(frozen=True, slots=True)
class ObservationBatch:
    """What a policy decides on, for W windows that share F frames."""

    points: Tensor
    """(F, N, 3) [m], world frame."""
    state: Tensor
    """(F, S)."""
    observed: Tensor
    """(W, history): the frames of each window, the last is now."""
    queries: Tensor
    """(W, M, 3) [m], world frame: where each query point was when its episode began."""
    task: Tensor
    """(W,): index of the task."""

    def to(self, device: torch.device) -> Self:
        """The same on another device."""
        return type(self)(**{f.name: getattr(self, f.name).to(device, non_blocking=True) for f in fields(self)})


@dataclass(frozen=True, slots=True)
class Batch(ObservationBatch):
    """A context, and what followed in the demonstrations. Row k of every sequence is action k of the window."""

    action: Tensor
    """(W, T, A)."""
    action_weight: Tensor
    """(W, T): 0 where the demonstration has no such step; the mean over the whole batch is 1."""
    flow: Tensor
    """(W, T, M, 3) [m]: how far each query point moves during each action."""
    flow_weight: Tensor
    """(W, T, M): less where the label is less sure; the mean over the whole batch is 1."""
    object_pose: Tensor
    """(W, T, 9)."""

    def part(self, windows: slice) -> "Batch":
        """Some of the windows, with the frames they need. The weights stay those of the whole batch."""
        if windows == slice(0, len(self.observed)):
            return self
        frame, observed = torch.unique(self.observed[windows], return_inverse=True)
        mine = {f.name: getattr(self, f.name)[windows] for f in fields(self)}
        return Batch(**mine | {"points": self.points[frame], "state": self.state[frame], "observed": observed})


@dataclass(frozen=True, slots=True)
class WindowIndex:
    """Some windows of a corpus, in runs of consecutive ones."""

    demo: Int[np.ndarray, "W"]
    now: Int[np.ndarray, "W"]
    """Row of the corpus of the frame that the action is decided at."""
    run: Int[np.ndarray, "W"]
    """Which run each belongs to."""


def index_windows(buffer: ReplayBuffer, demos: list[int], n_action_steps: int) -> WindowIndex:
    """Every window of some demonstrations: actions are decided on up to ``n_action_steps`` steps before the end (DP3)."""
    length = [max(1, len(buffer.demos[d]) - n_action_steps + 1) for d in demos]
    now = [buffer.demos[d].start + np.arange(n) for d, n in zip(demos, length, strict=True)]
    return WindowIndex(np.repeat(demos, length), np.concatenate(now), np.zeros(sum(length), int))


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
        return WindowIndex(self._windows.demo[index], self._windows.now[index], run)


class BatchBuilder:
    """Makes batches of windows; with a random generator it also varies them, as the settings say."""

    def __init__(
        self, buffer: ReplayBuffer, channels: ChannelSpec, settings: TrainSettings, tasks: tuple[str, ...]
    ) -> None:
        if settings.encoder.points > buffer.points.shape[1]:
            raise UsageError(
                f"encoder.points is {settings.encoder.points}, and the dataset's clouds have {buffer.points.shape[1]}; "
                f"add --set encoder.points={buffer.points.shape[1]}, or extract with --set observer.points="
                f"{settings.encoder.points}"
            )
        self._buffer, self._channels, self._settings = buffer, channels, settings
        self._tasks = np.array([tasks.index(d.task) for d in buffer.demos])
        self._start = np.array([d.start for d in buffer.demos])
        self._stop = np.array([d.stop for d in buffer.demos])
        self._center = buffer.state[:, channels.gripper].mean(0) if channels.gripper else np.zeros(3)
        flow = settings.policy == "fdp"
        self._queries = choose_queries(buffer, settings.motion) if flow else np.zeros((len(buffer.demos), 0), int)
        self._weight = _label_weight(buffer, settings.motion) if flow else np.zeros((len(buffer.state), 0), np.float32)

    def build(self, windows: WindowIndex, rng: np.random.Generator | None = None) -> Batch:
        """The batch of some windows."""
        buffer, s = self._buffer, self._settings
        first, last = self._start[windows.demo], self._stop[windows.demo] - 1
        observed_rows = np.clip(windows.now[:, None] + np.arange(1 - s.n_obs_steps, 1), first[:, None], None)
        # Frames are shared within a run only, since every run may be shifted by its own amount.
        key, observed = np.unique(windows.run[:, None] * len(buffer.state) + observed_rows, return_inverse=True)
        run_of_frame, frame = np.divmod(key, len(buffer.state))
        ahead = windows.now[:, None] + np.arange(1 - s.n_obs_steps, s.horizon - s.n_obs_steps + 1)
        row = np.clip(ahead, first[:, None], last[:, None])
        demonstrated = ahead == row
        query, columns = self._query_subset(rng)
        points, state = buffer.points[frame[:, None], columns], buffer.state[frame].copy()
        flow, flow_weight = self._flow(windows.demo, row, last, demonstrated, query)
        queries = np.take_along_axis(buffer.queries, self._queries[:, query, None], 1)[windows.demo]
        action, pose = buffer.action[row], buffer.object_pose[row]
        if rng is not None and (s.batch.shift_m or s.batch.turn_deg):
            turn = s.batch.turn_deg if self._channels.turns(state.shape[1], action.shape[-1]) else 0.0
            moves = SceneAugmentation.draw(rng, int(windows.run.max()) + 1, s.batch.shift_m, turn, self._center)
            points, queries = moves.transform_points(points, run_of_frame), moves.transform_points(queries, windows.run)
            flow = moves.rotate_vectors(flow, windows.run)
            for place in self._channels.state_positions:
                state[:, place] = moves.transform_points(state[:, place], run_of_frame)
            if (target := self._channels.action_position) is not None:
                action[..., target] = moves.transform_points(action[..., target], windows.run)
            if (along := self._channels.action_displacement) is not None:
                action[..., along] = moves.rotate_vectors(action[..., along], windows.run)
            if pose.shape[-1]:
                pose[..., :3] = moves.transform_points(pose[..., :3], windows.run)
                axes = pose[..., 3:].reshape(*pose.shape[:-1], 2, 3)
                pose[..., 3:] = moves.rotate_vectors(axes, windows.run).reshape(*pose.shape[:-1], 6)
        return Batch(
            **_tensors(
                points=points,
                state=state,
                observed=observed.reshape(observed_rows.shape),
                queries=queries,
                task=self._tasks[windows.demo],
                action=action,
                action_weight=_mean_one((demonstrated | s.batch.pad).astype(np.float32)),
                flow=flow,
                flow_weight=flow_weight,
                object_pose=pose,
            )
        )

    def _query_subset(self, rng: np.random.Generator | None) -> tuple[Any, Any]:
        """Which of the queries and which of the points this batch sees."""
        s = self._settings
        query: Any = slice(None)
        points = np.arange(s.encoder.points)
        if rng is not None and s.encoder.subset is not None:
            points = rng.permutation(s.encoder.points)[: s.encoder.subset]
        if rng is not None and s.motion.subset is not None and s.motion.flow_representation == "per-query":
            query = rng.permutation(self._queries.shape[1])[: s.motion.subset]
        return query, points

    def _flow(
        self, demo: np.ndarray, row: np.ndarray, last: np.ndarray, demonstrated: np.ndarray, query: Any
    ) -> tuple[np.ndarray, np.ndarray]:
        """Flow of every window's queries during each of its actions, and how much each counts."""
        then = np.minimum(row + 1, last[:, None])
        column = self._queries[demo][:, None, query]
        tracks, weight = self._buffer.tracks, self._weight
        flow = tracks[then[..., None], column] - tracks[row[..., None], column]
        sure = np.minimum(weight[row[..., None], column], weight[then[..., None], column])
        # Nothing is known of how points move during the last action, or before and after the demonstration.
        known = (then > row) & demonstrated
        flow[~known] = 0
        return flow, _mean_one(sure * known[..., None])


def choose_queries(buffer: ReplayBuffer, settings: MotionSettings) -> Int[np.ndarray, "D M"]:
    """Which of a dataset's query points each demonstration is trained with.

    ``scene`` takes the first M where the dataset was extracted with that sampling, which is the farthest-point sample
    of M. Raises :class:`DataError` where the dataset has too few, or none of the kind asked for.
    """
    held = buffer.queries.shape[1]
    if settings.points > held:
        raise DataError(
            f"motion.points is {settings.points}, and the dataset has {held} query points; add --set motion.points="
            f"{held}, or make the dataset with --set queries.points={settings.points}"
            if held
            else "the dataset has no query points, and fdp learns from how they move; train --policy dp3"
        )
    return np.stack([_choose(buffer, k, settings) for k in range(len(buffer.demos))])


def query_settings(settings: MotionSettings) -> dict[str, Any]:
    """The same choice, for :class:`~flowlab.perception.queries.QuerySettings` to make on a new cloud."""
    return {"points": settings.points, "sampling": settings.sampling, "object_share": _OBJECT_SHARE}


def _choose(buffer: ReplayBuffer, demo: int, settings: MotionSettings) -> np.ndarray:
    count, wanted = int(buffer.query_count[demo, 0]), settings.points
    xyz, role = buffer.queries[demo, :count], buffer.query_role[demo, :count]
    if settings.sampling == "scene":
        return pad(farthest_points(xyz, wanted), wanted)
    movable = np.flatnonzero(role == Role.OBJECT)
    if not len(movable):
        where = buffer.demos[demo]
        raise DataError(
            f"{where.task} seed {where.seed}: none of its {count} query points is known to lie on an object; use "
            "--set motion.sampling=scene, or make the dataset with --set queries.sampling=stratified"
        )
    chosen = movable[
        farthest_points(xyz[movable], wanted if settings.sampling == "object" else math.ceil(wanted * _OBJECT_SHARE))
    ]
    if settings.sampling == "stratified":
        chosen = np.concatenate([chosen, farthest_points(xyz, wanted - len(chosen), chosen)])
    return pad(chosen, wanted)


def _label_weight(buffer: ReplayBuffer, settings: MotionSettings) -> np.ndarray:
    """How much the position of every query point counts at every frame: (F, Q)."""
    seen = np.where(buffer.visible, 1.0, settings.occluded_weight)
    return (seen / (1 + (buffer.sigma / settings.sigma_m) ** 2)).astype(np.float32)


def _mean_one(weight: np.ndarray) -> np.ndarray:
    return weight / max(float(weight.mean()), 1e-9) if weight.size else weight


def _tensors(**arrays: np.ndarray) -> dict[str, Tensor]:
    return {name: torch.from_numpy(np.ascontiguousarray(a)) for name, a in arrays.items()}
