"""A training run from beginning to end: started anew, from another's weights, or resumed."""

import copy
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from flowlab.config import Settings
from flowlab.data.batches import query_settings
from flowlab.data.channels import infer_channels
from flowlab.data.normalizer import fit_normalizer
from flowlab.data.replay_buffer import ReplayBuffer, load_buffer
from flowlab.data.source import TrainingSource, open_training_source
from flowlab.errors import DataError, UsageError, unknown_name
from flowlab.policies.base import PolicyNetwork, PolicySpec
from flowlab.policies.checkpoint import (
    RunConfig,
    TrainedPolicy,
    check_observer,
    load_policy,
    read_resume,
    read_run_config,
    read_trained,
    start_folder,
    writing_run,
)
from flowlab.policies.settings import TrainSettings
from flowlab.training.distributed import ProcessGroup
from flowlab.training.loggers import LOGS, make_logger
from flowlab.training.metrics import MetricsFile
from flowlab.training.trainer import Trainer, TrainingProgress

_UNTIMED, _TIMED = 3, 12
"""Steps made to learn how long one takes."""


class ComputeSettings(Settings):
    """What a run computes on, and where else its metrics go."""

    device: str = "auto"
    """``cpu``, ``cuda``, ``cuda:1``; ``auto`` is a GPU where there is one."""
    threads: int = 1
    """Of each process, on a CPU."""
    precision: str = "auto"
    """``fp32`` or ``bf16``; ``auto`` is bf16 where the device has units for it."""
    logs: tuple[str, ...] = ()
    """Names of other places, see :func:`~flowlab.training.loggers.make_logger`."""


def prepare_run(
    data: Path,
    out: Path,
    settings: TrainSettings,
    machine: ComputeSettings,
    *,
    overfit: int | None = None,
    began_from: Path | None = None,
) -> Trainer:
    """A new run, ready to :func:`run`. ``overfit`` trains on the first demonstrations and validates on the same.

    Raises :class:`DataError` or :class:`UsageError` where settings, data or weights do not fit each other; then
    nothing is written but the decoded corpus.
    """
    for name in machine.logs:
        if name not in LOGS:
            raise unknown_name("log", name, LOGS)
    processes = ProcessGroup(machine.device, machine.threads, machine.precision)
    processes.part(settings.batch.windows)
    source = open_training_source(data)
    buffer = load_buffer(source, out)
    train, held_out = buffer.split(settings.data.demonstrations, settings.data.held_out)
    if overfit is not None:
        train = held_out = list(range(min(overfit, len(buffer.demos))))
    policy = _make_policy(source, buffer, settings, began_from)
    planned = RunConfig(
        dataset=data.resolve(),
        steps=_epochs_to_steps(buffer, train, settings),
        train=tuple(train),
        held_out=tuple(held_out),
        threads=machine.threads,
        device=processes.device.type,
        precision=processes.precision,
        logs=machine.logs,
        began_from=None if began_from is None else str(began_from),
    )
    if settings.run.minutes is not None and settings.run.steps is None:
        steps = _fitting_steps(Trainer(out, planned, copy.deepcopy(policy), buffer, processes), settings.run.minutes)
        planned = planned.model_copy(update={"steps": processes.tell(steps)})
    trainer = Trainer(out, planned, policy, buffer, processes)
    if processes.is_first:
        start_folder(out, TrainedPolicy.now(policy.spec, source, buffer), planned)
        trainer.keep()
    processes.wait()
    return trainer


def resume_run(folder: Path, **changes: Any) -> Trainer:
    """A run that ended early, as it was after the last step that was kept; ``changes`` are those of its machine.

    Raises :class:`DataError` where the dataset is no longer what the run began with.
    """
    kept, trained = read_run_config(folder), read_trained(folder)
    kept = kept.model_copy(update=changes)
    processes = ProcessGroup(kept.device, kept.threads, kept.precision)
    source = open_training_source(kept.dataset)
    check_observer(trained, folder, source)
    if source.fingerprint != trained.fingerprint:
        raise DataError(
            f"{folder}: began with content {trained.fingerprint} of {kept.dataset}, now {source.fingerprint}; "
            "restore the dataset, or start a new run"
        )
    step, groups = read_resume(folder)
    trainer = Trainer(folder, kept, PolicyNetwork(trained.policy), load_buffer(source, folder), processes)
    trainer.load_state(step, groups)
    return trainer


def run(
    trainer: Trainer, report: Callable[[TrainingProgress], None], should_stop: Callable[[], bool] = lambda: False
) -> bool:
    """Train to the end; whether it was reached."""
    first = trainer.processes.is_first
    name, settings = trainer.folder.name, trainer.settings.model_dump(mode="json")
    logs = [make_logger(log, trainer.folder, name, settings) for log in trainer.run.logs] if first else []
    with writing_run(trainer.folder):
        metrics = MetricsFile(trainer.folder, trainer.step, logs) if first else None
    try:
        return trainer.fit(metrics, report if first else _silent, should_stop)
    finally:
        if metrics is not None:
            metrics.close()
        trainer.processes.close()


def _silent(progress: TrainingProgress) -> None:
    """Only the first process reports."""


def _make_policy(
    source: TrainingSource, buffer: ReplayBuffer, settings: TrainSettings, began_from: Path | None
) -> PolicyNetwork:
    if settings.policy == "mba" and buffer.object_pose.shape[1] != 9:
        raise DataError(
            f"{source.path}: has no object poses, which mba learns to predict; train --policy fdp, which learns from "
            "points, or dp3"
        )
    loaded = None if began_from is None else load_policy(began_from)
    channels = infer_channels(source, buffer)
    spec = PolicySpec(
        settings=settings,
        state_width=buffer.state.shape[1],
        action_width=buffer.action.shape[1],
        tasks=buffer.tasks,
        channels=channels,
        normalizer=fit_normalizer(source, buffer, channels, settings),
        observer=source.observer,
        queries={**source.queries, **query_settings(settings.motion)},
    )
    torch.manual_seed(settings.run.seed)
    if loaded is None:
        return PolicyNetwork(spec)
    check_observer(loaded.trained, loaded.path, source)
    old = loaded.trained.policy
    policy = PolicyNetwork(spec.model_copy(update={"normalizer": old.normalizer, "channels": old.channels}))
    try:
        policy.load_state_dict(loaded.policy.state_dict())
    except RuntimeError as error:
        raise UsageError(
            f"{loaded.path}: its network has another shape than the one asked for; train with the policy, profile and "
            f"settings of {began_from}, on data with the same tasks, state and actions"
        ) from error
    return policy


def _epochs_to_steps(buffer: ReplayBuffer, train: list[int], settings: TrainSettings) -> int:
    if settings.run.steps is not None:
        return settings.run.steps
    windows = sum(max(1, len(buffer.demos[d]) - settings.n_action_steps + 1) for d in train)
    return max(1, round(settings.run.epochs * windows / settings.batch.windows))


def _fitting_steps(trial: Trainer, minutes: float) -> int:
    """How many steps, and the looks at held-out demonstrations, fit into so many minutes.

    CPU time is what counts on a CPU, so that what else the machine does changes nothing.
    """
    on_gpu = trial.processes.device.type == "cuda"
    threads = trial.run.threads

    def seconds(work: Callable[[], Any]) -> float:
        begin = time.perf_counter() if on_gpu else time.process_time()
        work()
        if on_gpu:
            torch.cuda.synchronize()
            return time.perf_counter() - begin
        return (time.process_time() - begin) / threads

    for _ in range(_UNTIMED):
        trial.train_step()
    per_step = float(np.median([seconds(trial.train_step) for _ in range(_TIMED)]))
    needs_frame = trial.settings.run.validations if trial.run.held_out else 0
    per_look = seconds(trial.validate) if needs_frame else 0.0
    return max(1, int((60 * minutes - needs_frame * per_look) / per_step))
