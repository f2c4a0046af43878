"""Flow predicted several times for the same window, each from other noise, against the demonstrated flow."""

from dataclasses import fields

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int

from flowlab.data.batch_builder import BatchBuilder
from flowlab.data.batches import Batch, ObservationBatch
from flowlab.data.replay_buffer import ReplayBuffer
from flowlab.data.window_sampler import WindowIndex
from flowlab.evaluation.flow_metrics import PointStepErrors
from flowlab.policies.base import PolicyNetwork
from flowlab.training.validation import constant_motion, portions, true_motion

DRAWS = 10
"""Predictions of every window's flow, each from other noise."""


class FlowSampler:
    """Predicts the flow of windows :data:`DRAWS` times, and compares it with what was demonstrated."""

    def __init__(
        self, policy: PolicyNetwork, buffer: ReplayBuffer, builder: BatchBuilder, columns: Int[np.ndarray, "D M"]
    ) -> None:
        self._policy, self._buffer, self._builder = policy, buffer, builder
        self._columns = columns
        """Which of the buffer's query points the policy follows, in each demonstration."""
        self._device = next(policy.parameters()).device

    def compare(self, windows: WindowIndex) -> PointStepErrors:
        """The errors of all windows, whose noise is the same whenever they are compared."""
        generator = torch.Generator().manual_seed(0)
        parts: list[PointStepErrors] = []
        first = 0
        for part in portions(windows):
            parts.append(self._compare_portion(part, generator, first))
            first += len(part.now)
        names = [f.name for f in fields(PointStepErrors)]
        return PointStepErrors(**{name: np.concatenate([getattr(p, name) for p in parts], -1) for name in names})

    def _compare_portion(self, windows: WindowIndex, generator: torch.Generator, first: int) -> PointStepErrors:
        """The errors of some windows, numbered from ``first``."""
        batch = self._builder.build(windows).to(self._device)
        now = self._policy.spec.settings.n_obs_steps - 1
        true, known, moving = true_motion(batch, now)
        predicted = self._policy.plan(_repeat(batch, DRAWS), generator).flow
        assert predicted is not None
        samples = predicted[:, now:].cumsum(1).reshape(DRAWS, *true.shape)
        counted = known & moving
        left = known.sum(1, keepdim=True) - torch.arange(known.shape[1], device=known.device)[:, None]
        mask = counted.cpu().numpy()
        xyz_world, visible = self._labels(windows, true.shape[1])

        def distance(prediction: torch.Tensor) -> np.ndarray:
            return (prediction - true).norm(dim=-1)[..., counted].double().cpu().numpy()

        return PointStepErrors(
            policy=distance(samples),
            zero=distance(torch.zeros_like(true)[None]),
            constant=distance(constant_motion(batch, now)[None]),
            last=(left == 1)[counted].cpu().numpy(),
            window=first + np.nonzero(mask)[0],
            visible=visible[mask],
            xyz_world=xyz_world[mask].T,
        )

    def _labels(
        self, windows: WindowIndex, steps: int
    ) -> tuple[Float32[np.ndarray, "W K M 3"], Bool[np.ndarray, "W K M"]]:
        """Where the query points are after 1, 2, ... actions [m], and whether they are seen."""
        stop = np.array([d.stop for d in self._buffer.episodes])[windows.episode]
        row = np.minimum(windows.now[:, None] + np.arange(1, steps + 1), stop[:, None] - 1)
        column = self._columns[windows.episode][:, None]
        return self._buffer.tracks[row[..., None], column], self._buffer.visible[row[..., None], column]


def _repeat(batch: Batch, times: int) -> ObservationBatch:
    """The windows of a batch several times over; frames are still encoded once."""
    return ObservationBatch(
        points=batch.points,
        state=batch.state,
        observed=batch.observed.repeat(times, 1),
        queries=batch.queries.repeat(times, 1, 1),
        task=batch.task.repeat(times),
        rgb=batch.rgb,
        depth=batch.depth,
    )
