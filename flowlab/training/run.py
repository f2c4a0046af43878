"""A training run from beginning to end: started anew, from another's weights, or resumed."""

import copy
import json
import logging
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pydantic import PositiveInt

from flowlab.config import Settings
from flowlab.data.channels import infer_channels
from flowlab.data.mixture import check_drawn, check_weights, describe_mixture
from flowlab.data.normalizer import fit_normalizer
from flowlab.data.replay_buffer import ReplayBuffer, load_buffer
from flowlab.data.source import TrainingSource, open_training_source, warn_of_shared_scenes, warn_of_what_is_unsaid
from flowlab.data.split import split_episodes
from flowlab.data.training_settings import TrainSettings
from flowlab.errors import DataError, UsageError
from flowlab.files import remove_leftovers
from flowlab.policies.base import PolicyNetwork, make_policy
from flowlab.policies.checkpoint import check_observer, load_policy
from flowlab.policies.run_config import RunConfig, has_begun, read_run_config
from flowlab.policies.spec import PolicySpec
from flowlab.policies.trained import TrainedPolicy, read_trained, writing_run
from flowlab.registry import POLICIES
from flowlab.storage.manifest import differences
from flowlab.training.distributed import ProcessGroup
from flowlab.training.loggers import check_loggers, make_logger
from flowlab.training.metrics import MetricsFile
from flowlab.training.precision import Precision
from flowlab.training.resume import resume_run
from flowlab.training.trainer import Trainer, TrainingProgress

_UNTIMED, _TIMED = 3, 12
"""Steps made to learn how long one takes."""

_LOG = logging.getLogger(__name__)


class ComputeSettings(Settings):
    """What a run computes on, and where else its metrics go."""

    device: str = "auto"
    """``cpu``, ``cuda``, ``cuda:1``; ``auto`` is a GPU where there is one."""
    threads: PositiveInt = 1
    """Of each process, on a CPU."""
    precision: Precision = "auto"
    """``auto`` is bf16 where the device has units for it."""
    logs: tuple[str, ...] = ()
    """Names of other places, see :func:`~flowlab.training.loggers.make_logger`."""


def begin_run(
    data: Path | Sequence[Path],
    out: Path,
    settings: TrainSettings,
    compute: ComputeSettings,
    *,
    overfit: int | None = None,
    began_from: Path | None = None,
    weights: Sequence[float] | None = None,
) -> Trainer:
    """A new run; or, where the same call began it earlier, that run, as it was after the last step that was saved.

    Arguments and errors are those of :func:`prepare_run` and :func:`resume_run`; a run that began with others is a
    :class:`UsageError` that shows the difference.
    """
    if not has_begun(out):
        return prepare_run(data, out, settings, compute, overfit=overfit, began_from=began_from, weights=weights)
    _check_same(out, settings, overfit, began_from, weights)
    device = None if compute.device == "auto" else compute.device
    precision = None if compute.precision == "auto" else compute.precision
    data = (data,) if isinstance(data, Path) else data
    return resume_run(out, data, device=device, threads=compute.threads, precision=precision, logs=compute.logs)


def prepare_run(
    data: Path | Sequence[Path],
    out: Path,
    settings: TrainSettings,
    compute: ComputeSettings,
    *,
    overfit: int | None = None,
    began_from: Path | None = None,
    weights: Sequence[float] | None = None,
) -> Trainer:
    """A new run, ready to :func:`run`.

    Args:
        data: The dataset, or a store in DP3's layout; or several datasets.
        out: Folder of the run.
        settings: Of its policy.
        compute: What it computes on.
        overfit: Train on so many demonstrations, the first ones, and validate on the same.
        began_from: A run, or one of its checkpoints, that the first weights are taken from.
        weights: Of several datasets, how much of all windows each has, relative to the others; None draws all windows
            alike.

    Raises:
        DataError, UsageError: Settings, data or weights do not fit each other; then nothing is written but the decoded
            dataset.
    """
    trainer, trained = make_trainer(
        data, out, settings, compute, overfit=overfit, began_from=began_from, weights=weights
    )
    trainer.begin(trained)
    return trainer


def make_trainer(
    data: Path | Sequence[Path],
    out: Path,
    settings: TrainSettings,
    compute: ComputeSettings,
    *,
    overfit: int | None = None,
    began_from: Path | None = None,
    weights: Sequence[float] | None = None,
) -> tuple[Trainer, TrainedPolicy]:
    """The same without its folder, of which nothing is made, and what the folder would say of the policy.

    Arguments and errors are those of :func:`prepare_run`.
    """
    check_loggers(compute.logs)
    processes = ProcessGroup(compute.device, compute.threads, compute.precision)
    processes.part(settings.batch.windows)
    places = (data,) if isinstance(data, Path) else data
    weighed = check_weights(weights, len(places))
    source = open_training_source(*places)
    warn_of_what_is_unsaid(source)
    warn_of_shared_scenes(source.parts)
    buffer = load_buffer(source, out, settings.needs.pictures)
    train, held_out = split_episodes(buffer.episodes, settings.data, buffer.inferred)
    if overfit is not None:
        train = held_out = list(range(min(overfit, len(buffer.episodes))))
    if not train:
        raise DataError(
            f"{source.path}: nothing is left to train on beside what is held out; add --set data.held_out=0"
        )
    mixture = describe_mixture(source.parts, buffer, train, held_out, weighed)
    policy = _new_policy(source, buffer, settings, began_from)
    planned = RunConfig(
        dataset=source.path.resolve(),
        more_datasets=tuple(path.resolve() for path in source.paths[1:]),
        steps=_epochs_to_steps(buffer, train, settings),
        train=tuple(train),
        held_out=tuple(held_out),
        inferred=tuple(sorted(buffer.inferred)),
        threads=compute.threads,
        device=processes.device.type,
        precision=processes.precision,
        logs=compute.logs,
        began_from=None if began_from is None else str(began_from),
        overfit=overfit,
        weights=weighed,
    )
    if settings.run.minutes is not None and settings.run.steps is None:
        steps = _fitting_steps(Trainer(out, planned, copy.deepcopy(policy), buffer, processes), settings.run.minutes)
        planned = planned.model_copy(update={"steps": processes.broadcast(steps)})
    check_drawn(source.parts, weighed, settings, planned.steps)
    trainer = Trainer(out, planned, policy, buffer, processes)
    return trainer, TrainedPolicy.now(policy.spec, source, buffer, mixture)


def _check_same(
    out: Path,
    settings: TrainSettings,
    overfit: int | None,
    began_from: Path | None,
    weights: Sequence[float] | None,
) -> None:
    """Raises :class:`UsageError` where the run of a folder was begun in another way."""
    began, trained = read_run_config(out), read_trained(out)
    asked = {"overfit": overfit, "from": began_from and str(began_from), "weights": [*weights] if weights else None}
    found = {"overfit": began.overfit, "from": began.began_from, "weights": [*began.weights] or None}
    old, new = (json.loads(s.model_dump_json()) for s in (trained.policy.settings, settings))
    owners = ("the run", "this command")
    if lines := [*differences(found, asked, "run", owners=owners), *differences(old, new, "settings", owners=owners)]:
        raise UsageError(
            f"{out}: holds a run already, which began in another way; choose another --out, or go on with it by "
            f"'flowlab train {out} --resume':\n  " + "\n  ".join(lines)
        )


def run(
    trainer: Trainer, report: Callable[[TrainingProgress], None], should_stop: Callable[[], bool] = lambda: False
) -> bool:
    """Train to the end; whether it was reached."""
    first = trainer.processes.is_first
    name, settings = trainer.folder.name, trainer.settings.model_dump(mode="json")
    metrics = None
    if first:
        with writing_run(trainer.folder):
            remove_leftovers(trainer.folder)
            logs = [make_logger(log, trainer.folder, name, settings) for log in trainer.run.logs]
            metrics = MetricsFile(trainer.folder, trainer.step, logs)
            if metrics.lines < trainer.lines:
                lost = f"{trainer.lines - metrics.lines} of {trainer.lines} lines"
                _LOG.warning("flowlab: %s: %s up to step %d are lost", metrics.path, lost, trainer.step)
                trainer.lines = metrics.lines
    try:
        return trainer.fit(metrics, report if first else _silent, should_stop)
    finally:
        if metrics is not None:
            with writing_run(trainer.folder):
                metrics.close()
        trainer.processes.close()


def _silent(progress: TrainingProgress) -> None:
    """Only the first process reports."""


def _new_policy(
    source: TrainingSource, buffer: ReplayBuffer, settings: TrainSettings, began_from: Path | None
) -> PolicyNetwork:
    POLICIES.load(settings.policy).check_dataset(source.path, buffer, settings)
    loaded = None if began_from is None else load_policy(began_from)
    channels = infer_channels(source, buffer)
    flow = settings.needs.flow
    try:
        normalizer = fit_normalizer(buffer, channels, settings)
    except DataError as error:
        raise DataError(f"{source.path}: {error}") from error
    spec = PolicySpec(
        settings=settings,
        state_width=buffer.state.shape[1],
        action_width=buffer.action.shape[1],
        tasks=buffer.tasks,
        channels=channels,
        normalizer=normalizer,
        observer=source.provenance.observer,
        queries={} if flow is None else {**(source.provenance.queries or {}), **flow.query_settings},
    )
    torch.manual_seed(settings.run.seed)
    if loaded is None:
        return make_policy(spec)
    check_observer(loaded.trained, loaded.path, source)
    old = loaded.trained.policy
    other = UsageError(
        f"{loaded.path}: its network has another shape than the one asked for; train with the policy, profile and "
        f"settings of {began_from}, on data with the same tasks, state and actions"
    )
    if old.settings.policy != settings.policy:
        raise other
    policy = make_policy(spec.model_copy(update={"normalizer": old.normalizer, "channels": old.channels}))
    try:
        policy.load_state_dict(loaded.policy.state_dict())
    except RuntimeError as error:
        raise other from error
    return policy


def _epochs_to_steps(buffer: ReplayBuffer, train: Sequence[int], settings: TrainSettings) -> int:
    if settings.run.steps is not None:
        return settings.run.steps
    windows = sum(max(1, len(buffer.episodes[e]) - settings.n_action_steps + 1) for e in train)
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
            torch.cuda.synchronize(trial.processes.device)
            return time.perf_counter() - begin
        return (time.process_time() - begin) / threads

    for _ in range(_UNTIMED):
        trial.train_step()
    per_step = float(np.median([seconds(trial.train_step) for _ in range(_TIMED)]))
    validations = trial.settings.run.validations if trial.run.held_out else 0
    per_validation = seconds(trial.validate) if validations else 0.0
    return max(1, int((60 * minutes - validations * per_validation) / per_step))
