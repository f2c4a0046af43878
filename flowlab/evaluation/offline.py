"""What a policy is worth without a simulator: its errors on demonstrations it was not trained on."""

from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from flowlab.config import Settings
from flowlab.data.batch_builder import BatchBuilder
from flowlab.data.batches import Batch, ObservationBatch
from flowlab.data.query_points import choose_queries
from flowlab.data.replay_buffer import ReplayBuffer, load_buffer
from flowlab.data.source import TrainingSource, open_training_source
from flowlab.data.window_sampler import WindowIndex, index_windows
from flowlab.errors import DataError
from flowlab.evaluation.flow_metrics import FlowErrors, PointStepErrors, pool_errors
from flowlab.geometry.camera import Camera
from flowlab.policies.base import PolicyNetwork, PolicySpec
from flowlab.policies.checkpoint import RUN, LoadedPolicy, RunConfig, TrainedPolicy, check_observer, read_run_config
from flowlab.storage.dataset import Dataset
from flowlab.storage.shard import Shard
from flowlab.training.validation import constant_motion, portions, true_motion, validate

DRAWS = 10
"""Predictions of every window's flow, each from other noise."""


class OfflineErrors(Settings):
    """As :func:`~flowlab.training.validation.validate` defines them. None where there is no such prediction, or no
    last step to go by (``hold``, ``constant``)."""

    action_l1: float | None = None
    action_l1_zero: float | None = None
    action_l1_hold: float | None = None
    flow_moving_mm: float | None = None
    flow_moving_mm_zero: float | None = None
    flow_moving_mm_constant: float | None = None
    flow_static_mm: float | None = None
    flow_static_mm_zero: float | None = None
    flow_static_mm_constant: float | None = None
    pose_mm: float | None = None
    pose_mm_zero: float | None = None
    pose_mm_constant: float | None = None


class ErrorSummary(Settings):
    """Errors on one demonstration, or on all."""

    windows: int
    """Plans that are asked for; of more than 256, so many are made, evenly spaced."""
    errors: OfflineErrors
    flow: FlowErrors | None
    """None for policies that predict none, and where nothing moves. Of all demonstrations, distances are over all
    pairs, and TAPVid-3D's figures are means over the demonstrations, weighted by the pairs that are seen."""


class DemonstrationErrors(ErrorSummary):
    """Errors on one demonstration."""

    task: str
    seed: int


class OfflineReport(Settings):
    """How far a policy is from demonstrations it was not trained on."""

    policy: str
    """fdp, dp3 or mba."""
    step: int
    """Training steps that its weights have seen."""
    dataset: str
    demonstrations: tuple[DemonstrationErrors, ...]
    all: ErrorSummary


def evaluate_offline(loaded: LoadedPolicy, data: Path | None = None) -> OfflineReport:
    """Errors on the demonstrations that a policy's run held out; or on those of another dataset, but for layouts of
    the simulation that the policy was trained on.

    Raises :class:`DataError` where there are none, or the dataset does not fit the policy.
    """
    run = loaded.path.absolute().parents[1]
    source = _open(loaded, run, data)
    check_observer(loaded.trained, run, source)
    buffer = load_buffer(source, run, loaded.policy.needs.pictures)
    _check_fit(loaded.policy.spec, buffer, source.path)
    buffer = _only(buffer, _unseen(loaded, run, source, buffer))
    judge = _OfflineEvaluator(
        loaded.policy, buffer, _cameras(source.path, buffer) if source.provenance.kind != "imported" else None
    )
    each = [judge.measure(k) for k in range(len(buffer.episodes))]
    return OfflineReport(
        policy=loaded.policy.spec.settings.policy,
        step=loaded.step,
        dataset=str(source.path),
        demonstrations=tuple(each),
        all=ErrorSummary(
            windows=sum(m.windows for m in each),
            errors=judge.errors(range(len(each))),
            flow=pool_errors([m.flow for m in each if m.flow is not None]),
        ),
    )


def offline_rows(report: OfflineReport) -> tuple[list[str], list[list[object]]]:
    """Columns and rows for a table: every error over all demonstrations, beside what costs nothing."""
    e, flow = report.all.errors, report.all.flow
    rows: list[list[object]] = [["action L1", e.action_l1, e.action_l1_zero, e.action_l1_hold]]
    if e.flow_moving_mm is not None:
        rows.append(["flow of moving points mm", e.flow_moving_mm, e.flow_moving_mm_zero, e.flow_moving_mm_constant])
    if e.flow_static_mm is not None:
        rows.append(["flow of still points mm", e.flow_static_mm, e.flow_static_mm_zero, e.flow_static_mm_constant])
    if e.pose_mm is not None:
        rows.append(["object's position mm", e.pose_mm, e.pose_mm_zero, e.pose_mm_constant])
    if flow is not None:
        guesses = (flow.policy, flow.zero, flow.constant)
        for name, field in (("ADE mm", "ade_mm"), ("FDE mm", "fde_mm"), ("APD", "apd"), ("3D-AJ", "average_jaccard")):
            values = [None if g is None else getattr(g, field) for g in guesses]
            rows.append([f"{name}, mean of {flow.draws} draws", *values])
        rows.append([f"ADE mm, best of {flow.draws} draws", flow.best_ade_mm, None, None])
        rows.append([f"FDE mm, best of {flow.draws} draws", flow.best_fde_mm, None, None])
    return ["error", "policy", "no motion", "as before"], [["-" if v is None else v for v in row] for row in rows]


def demonstration_rows(report: OfflineReport) -> tuple[list[str], list[list[object]]]:
    """Columns and rows for a table: the policy's own errors on each demonstration, only those that there are."""
    columns = [
        "demonstration",
        "windows",
        "action L1",
        "moving mm",
        "still mm",
        "pose mm",
        "FDE mm",
        "best ADE mm",
        "3D-AJ",
    ]
    rows: list[list[object]] = []
    for m in report.demonstrations:
        e, flow = m.errors, m.flow
        of_flow = [None] * 3 if flow is None else [flow.policy.fde_mm, flow.best_ade_mm, flow.policy.average_jaccard]
        found = [e.action_l1, e.flow_moving_mm, e.flow_static_mm, e.pose_mm, *of_flow]
        rows.append([f"{m.task} {m.seed}", m.windows, *found])
    kept = [k for k in range(len(columns)) if any(row[k] is not None for row in rows)]
    return [columns[k] for k in kept], [["-" if row[k] is None else row[k] for k in kept] for row in rows]


class _OfflineEvaluator:
    """Compares a policy's plans with what was demonstrated."""

    def __init__(self, policy: PolicyNetwork, buffer: ReplayBuffer, cameras: Sequence[Camera] | None) -> None:
        self._policy, self._buffer, self._cameras = policy, buffer, cameras
        s, spec = policy.spec.settings, policy.spec
        self._builder = BatchBuilder(buffer, spec.channels, s, spec.tasks)
        self._device = next(policy.parameters()).device
        self._columns = None if s.needs.flow is None else choose_queries(buffer, s.needs.flow)

    def measure(self, demo: int) -> DemonstrationErrors:
        """All errors on one demonstration."""
        about = self._buffer.episodes[demo]
        return DemonstrationErrors(
            task=about.task,
            seed=about.seed,
            windows=len(self._windows([demo]).now),
            errors=self.errors([demo]),
            flow=None if self._columns is None else self._flow(demo),
        )

    def errors(self, demos: Sequence[int]) -> OfflineErrors:
        """The errors that training looks at, too."""
        return OfflineErrors(**validate(self._policy, self._builder, self._windows(demos), self._device))

    def _windows(self, demos: Sequence[int]) -> WindowIndex:
        return index_windows(self._buffer, list(demos), self._policy.spec.settings.n_action_steps)

    def _flow(self, demo: int) -> FlowErrors | None:
        generator = torch.Generator().manual_seed(0)
        parts: list[PointStepErrors] = []
        first = 0
        for windows in portions(self._windows([demo])):
            parts.append(self._pairs(windows, generator, first))
            first += len(windows.now)
        pairs = PointStepErrors(
            **{f.name: np.concatenate([getattr(p, f.name) for p in parts], -1) for f in fields(PointStepErrors)}
        )
        history = self._policy.spec.settings.n_obs_steps
        camera = None if self._cameras is None else self._cameras[demo]
        return pairs.compute(camera, has_past=history > 1) if len(pairs.window) else None

    def _pairs(self, windows: WindowIndex, generator: torch.Generator, first: int) -> PointStepErrors:
        """Predict the flow of some windows several times, and compare it; the windows are numbered from ``first``."""
        batch = self._builder.build(windows).to(self._device)
        now = self._policy.spec.settings.n_obs_steps - 1
        true, known, moving = true_motion(batch, now)
        predicted = self._policy.plan(_repeated(batch, DRAWS), generator).flow
        assert predicted is not None
        drawn = predicted[:, now:].cumsum(1).reshape(DRAWS, *true.shape)
        counted = known & moving
        left = known.sum(1, keepdim=True) - torch.arange(known.shape[1], device=known.device)[:, None]
        mask = counted.cpu().numpy()
        xyz_world, visible = self._labels(windows, true.shape[1])

        def off(guess: torch.Tensor) -> np.ndarray:
            return (guess - true).norm(dim=-1)[..., counted].double().cpu().numpy()

        return PointStepErrors(
            policy=off(drawn),
            zero=off(torch.zeros_like(true)[None]),
            constant=off(constant_motion(batch, now)[None]),
            last=(left == 1)[counted].cpu().numpy(),
            window=first + np.nonzero(mask)[0],
            visible=visible[mask],
            xyz_world=xyz_world[mask].T,
        )

    def _labels(self, windows: WindowIndex, steps: int) -> tuple[np.ndarray, np.ndarray]:
        """Where the query points are after 1, 2, ... actions (W, K, M, 3) [m], and whether they are seen (W, K, M)."""
        assert self._columns is not None
        stop = np.array([d.stop for d in self._buffer.episodes])[windows.episode]
        row = np.minimum(windows.now[:, None] + np.arange(1, steps + 1), stop[:, None] - 1)
        column = self._columns[windows.episode][:, None]
        return self._buffer.tracks[row[..., None], column], self._buffer.visible[row[..., None], column]


def _repeated(batch: Batch, times: int) -> ObservationBatch:
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


def _open(loaded: LoadedPolicy, run: Path, data: Path | None) -> TrainingSource:
    """The dataset that is given, or the run's own, which must be what it was."""
    if data is not None:
        return open_training_source(data)
    path = _read_plan(run).dataset
    if not path.exists():
        raise DataError(f"{run}: its dataset is no longer at {path}; give where it is now with --data")
    source = open_training_source(path)
    if source.fingerprint != loaded.trained.fingerprint:
        raise DataError(
            f"{run}: was trained on content {loaded.trained.fingerprint} of {path}, now {source.fingerprint}; restore "
            "the dataset, or give another with --data"
        )
    return source


def _read_plan(run: Path) -> RunConfig:
    """Which demonstrations were trained on, and which held out."""
    if not (run / RUN).exists():
        raise DataError(
            f"{run}: does not tell which demonstrations were held out (it has no {RUN}); restore it, or give another "
            "dataset with --data"
        )
    return read_run_config(run)


def _check_fit(spec: PolicySpec, buffer: ReplayBuffer, where: Path) -> None:
    """Refuse a dataset whose state or action is another than the policy's, or that lacks what it predicts."""
    for name, wanted, found in (
        ("state", spec.state_width, buffer.state.shape[1]),
        ("action", spec.action_width, buffer.action.shape[1]),
    ):
        if found != wanted:
            raise DataError(f"{where}: '{name}' is {found} wide, and {wanted} in what the policy was trained on")
    if missing := spec.settings.needs.missing_from(buffer):
        raise DataError(
            f"{where}: has no {missing}, which {spec.settings.policy} needs; evaluate it on a dataset that has them"
        )
    if not set(spec.tasks) & set(buffer.tasks):
        raise DataError(
            f"{where}: has the tasks {', '.join(buffer.tasks)}, and the policy was trained on {', '.join(spec.tasks)}"
        )


def _unseen(loaded: LoadedPolicy, run: Path, source: TrainingSource, buffer: ReplayBuffer) -> list[int]:
    """Positions of the demonstrations that the policy knows the task of, and was not trained on."""
    if source.fingerprint == loaded.trained.fingerprint:
        planned = _read_plan(run)
        if found := [k for k in planned.held_out if k not in planned.train]:
            return found
        raise DataError(
            f"{run}: no demonstration was held out from its training (data.held_out, --overfit); give another dataset "
            "with --data"
        )
    known = _known_layouts(loaded.trained, run, source)
    of_tasks = [k for k, d in enumerate(buffer.episodes) if d.task in loaded.trained.policy.tasks]
    if found := [k for k in of_tasks if (buffer.episodes[k].task, buffer.episodes[k].seed) not in known]:
        return found
    raise DataError(
        f"{source.path}: the policy was trained on the layouts of all its {len(of_tasks)} demonstrations; give a "
        "dataset with others"
    )


def _known_layouts(trained: TrainedPolicy, run: Path, source: TrainingSource) -> set[tuple[str, int]]:
    """Simulated layouts, by task and seed, that a policy was trained on and that another dataset may hold too."""
    planned = read_run_config(run) if (run / RUN).exists() else None
    if source.provenance.is_simulated:
        scene_seeds = [(task, seed) for task in sorted(trained.scene_seeds) for seed in trained.scene_seeds[task]]
        return set([scene_seeds[k] for k in planned.train] if scene_seeds and planned is not None else scene_seeds)
    if planned is not None and source.path.resolve() == planned.dataset:
        raise DataError(
            f"{source.path}: its content is no longer what {run} was trained on, and nothing tells which of its "
            "demonstrations were; give a dataset of others with --data"
        )
    return set()


def _only(buffer: ReplayBuffer, demos: Sequence[int]) -> ReplayBuffer:
    """The corpus with some of its demonstrations."""
    names = ("queries", "query_role", "query_count")
    mine: dict[str, Any] = {name: getattr(buffer, name)[list(demos)] for name in names}
    return replace(buffer, episodes=tuple(buffer.episodes[k] for k in demos), **mine)


def _cameras(path: Path, buffer: ReplayBuffer) -> list[Camera]:
    """The camera of every demonstration: a simulated dataset's, or its recording's."""
    shards = {(r.task, r.seed): r.shard for r in Dataset(path).refs}
    attributes = {shard: Shard(path / shard).attributes for shard in {shards[d.task, d.seed] for d in buffer.episodes}}
    return [Camera.from_json(attributes[shards[d.task, d.seed]]["camera"]) for d in buffer.episodes]
