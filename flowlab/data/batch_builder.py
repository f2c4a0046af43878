"""From windows of demonstrations to the tensors that a policy needs of them."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int

from flowlab.data.augmentation import SceneAugmentation
from flowlab.data.batches import Batch
from flowlab.data.channels import ChannelSpec
from flowlab.data.query_subset import choose_queries, label_weight
from flowlab.data.replay_buffer import ReplayBuffer
from flowlab.data.training_settings import TrainSettings
from flowlab.data.window_sampler import WindowIndex
from flowlab.errors import UsageError

_HALF_WEIGHT = 0.5
"""Stated error of an inferred action, as a share of what its number varies by, at which its weight is a half."""


class BatchBuilder:
    """Makes batches of windows that hold what a policy needs, and nothing else.

    With a random generator it also varies them, as the settings say.
    """

    def __init__(
        self, buffer: ReplayBuffer, channels: ChannelSpec, settings: TrainSettings, tasks: tuple[str, ...]
    ) -> None:
        needs = settings.needs
        _check_points(settings, buffer)
        self._buffer, self._channels, self._settings, self._needs = buffer, channels, settings, needs
        self._tasks = np.array([tasks.index(e.task) for e in buffer.episodes])
        self._start = np.array([e.start for e in buffer.episodes])
        self._stop = np.array([e.stop for e in buffer.episodes])
        self._center = buffer.state[:, channels.gripper].mean(0) if channels.gripper else np.zeros(3)
        self._action_weight = action_weight(buffer)
        self._queries = np.zeros((len(buffer.episodes), 0), int)
        self._weight = np.zeros((len(buffer.state), 0), np.float32)
        if needs.flow is not None:
            self._queries, self._weight = choose_queries(buffer, needs.flow), label_weight(buffer, needs.flow)

    def build(self, windows: WindowIndex, rng: np.random.Generator | None = None) -> Batch:
        """The batch of some windows."""
        buffer, s = self._buffer, self._settings
        first, last = self._start[windows.episode], self._stop[windows.episode] - 1
        observed_rows = np.clip(windows.now[:, None] + np.arange(1 - s.n_obs_steps, 1), first[:, None], None)
        # Frames are shared within a run only, since every run may be shifted by its own amount.
        key, observed = np.unique(windows.run[:, None] * len(buffer.state) + observed_rows, return_inverse=True)
        run_of_frame, frame = np.divmod(key, len(buffer.state))
        ahead = windows.now[:, None] + np.arange(1 - s.n_obs_steps, s.horizon - s.n_obs_steps + 1)
        row = np.clip(ahead, first[:, None], last[:, None])
        demonstrated = ahead == row
        points, query = self._subsets(rng)
        flow, flow_weight = self._flow(windows.episode, row, last, demonstrated, query)
        arrays: dict[str, Any] = {
            "points": buffer.point_cloud[frame[:, None], points],
            "state": buffer.state[frame].copy(),
            "queries": np.take_along_axis(buffer.queries, self._queries[:, query, None], 1)[windows.episode],
            "action": buffer.action[row],
            "flow": flow,
            "object_pose": buffer.object_pose[row]
            if self._needs.object_pose
            else np.zeros((*row.shape, 0), np.float32),
        }
        if rng is not None and self._channels.shifts and (s.batch.shift_m or s.batch.turn_deg):
            self._move(arrays, windows, run_of_frame, rng)
        return Batch(
            **{name: torch.from_numpy(np.ascontiguousarray(values)) for name, values in arrays.items()},
            **{name: torch.from_numpy(getattr(buffer, name)[frame]) for name in self._needs.pictures},
            observed=torch.from_numpy(observed.reshape(observed_rows.shape)),
            task=torch.from_numpy(self._tasks[windows.episode]),
            action_weight=torch.from_numpy(_mean_one((demonstrated | s.batch.pad).astype(np.float32))),
            action_confidence=torch.from_numpy(self._confidence(row)),
            flow_weight=torch.from_numpy(flow_weight),
        )

    def _move(
        self,
        arrays: dict[str, Any],
        windows: WindowIndex,
        run_of_frame: Int[np.ndarray, "F"],
        rng: np.random.Generator,
    ) -> None:
        """Move the scene of every run about in the world."""
        channels, batch = self._channels, self._settings.batch
        state, action, pose = arrays["state"], arrays["action"], arrays["object_pose"]
        turn = batch.turn_deg if channels.turns(state.shape[1], action.shape[-1]) else 0.0
        runs = int(windows.run.max()) + 1
        scene = SceneAugmentation.draw(rng, runs, batch.shift_m, turn, self._center)
        arrays["points"] = scene.transform_points(arrays["points"], run_of_frame)
        arrays["queries"] = scene.transform_points(arrays["queries"], windows.run)
        arrays["flow"] = scene.rotate_vectors(arrays["flow"], windows.run)
        for position in channels.state_positions:
            state[:, position] = scene.transform_points(state[:, position], run_of_frame)
        if (target := channels.action_position) is not None:
            action[..., target] = scene.transform_points(action[..., target], windows.run)
        if (along := channels.action_displacement) is not None:
            action[..., along] = scene.rotate_vectors(action[..., along], windows.run)
        if pose.shape[-1]:
            pose[..., :3] = scene.transform_points(pose[..., :3], windows.run)
            axes = pose[..., 3:].reshape(*pose.shape[:-1], 2, 3)
            pose[..., 3:] = scene.rotate_vectors(axes, windows.run).reshape(*pose.shape[:-1], 6)

    def _confidence(self, row: Int[np.ndarray, "W T"]) -> Float32[np.ndarray, "W T A"]:
        """How sure the actions of every window are, where they were inferred."""
        if self._action_weight is None:
            return np.ones((*row.shape, self._buffer.action.shape[1]), np.float32)
        return _mean_one(self._action_weight[row])

    def _subsets(self, rng: np.random.Generator | None) -> tuple[Int[np.ndarray, "N"], Any]:
        """Which points of the clouds and which of the queries this batch sees."""
        cloud, flow = self._needs.point_cloud, self._needs.flow
        points, query = np.arange(0 if cloud is None else cloud.points), slice(None)
        if rng is None:
            return points, query
        if cloud is not None and cloud.subset is not None:
            points, many = rng.permutation(cloud.points), cloud.subset
            if cloud.subset_most is not None:
                many = round(many * (cloud.subset_most / many) ** rng.random())
            points = points[:many]
        if flow is not None and flow.subset is not None:
            return points, rng.permutation(self._queries.shape[1])[: flow.subset]
        return points, query

    def _flow(
        self,
        episode: Int[np.ndarray, "W"],
        row: Int[np.ndarray, "W T"],
        last: Int[np.ndarray, "W"],
        demonstrated: Bool[np.ndarray, "W T"],
        query: Any,
    ) -> tuple[Float32[np.ndarray, "W T M 3"], Float32[np.ndarray, "W T M"]]:
        """Flow of every window's queries during each of its actions, and how much each counts."""
        then = np.minimum(row + 1, last[:, None])
        column = self._queries[episode][:, None, query]
        tracks, weight = self._buffer.tracks, self._weight
        flow = tracks[then[..., None], column] - tracks[row[..., None], column]
        sure = np.minimum(weight[row[..., None], column], weight[then[..., None], column])
        # Nothing is known of how points move during the last action, or before and after the demonstration.
        known = (then > row) & demonstrated
        flow[~known] = 0
        return flow, _mean_one(sure * known[..., None])


def action_weight(buffer: ReplayBuffer) -> Float32[np.ndarray, "F A"] | None:
    """How much every number of every action counts, by its stated error; None where none was inferred."""
    if buffer.action_sigma is None or not buffer.action_sigma.any():
        return None
    half = _HALF_WEIGHT * np.maximum(buffer.action.std(0), 1e-6)
    return (1 / (1 + (buffer.action_sigma / half) ** 2)).astype(np.float32)


def _check_points(settings: TrainSettings, buffer: ReplayBuffer) -> None:
    """Refuse a dataset whose clouds have fewer points than are wanted."""
    cloud, found = settings.needs.point_cloud, buffer.point_cloud.shape[1]
    if cloud is not None and cloud.points > found:
        raise UsageError(
            f"encoder.points is {cloud.points}, and the dataset's clouds have {found}; add --set encoder.points="
            f"{found}, or extract with --set observer.points={cloud.points}"
        )


def _mean_one(weight: Float32[np.ndarray, "*s"]) -> Float32[np.ndarray, "*s"]:
    return weight / max(float(weight.mean()), 1e-9) if weight.size else weight
