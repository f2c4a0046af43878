"""A training run from beginning to end: started anew, from another's weights, or resumed."""

import copy
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from flowlab.config import Settings
from flowlab.errors import DataError, UsageError, unknown
from flowlab.learning.batches import query_settings
from flowlab.learning.checkpoint import (
    Run,
    Trained,
    check_observer,
    load_policy,
    read_resume,
    read_run,
    read_trained,
    room_to_write,
    start_folder,
)
from flowlab.learning.corpus import Corpus, load_corpus
from flowlab.learning.layout import find_layout
from flowlab.learning.logs import LOGS, make_log
from flowlab.learning.metrics import Metrics
from flowlab.learning.normaliser import fit
from flowlab.learning.policy import PolicyNetwork, PolicySpec
from flowlab.learning.processes import Processes
from flowlab.learning.settings import TrainSettings
from flowlab.learning.source import Source, open_source
from flowlab.learning.trainer import Progress, Trainer

_UNTIMED, _TIMED = 3, 12
"""Steps made to learn how long one takes."""


class Machine(Settings):
    """What a run computes on, and where else its metrics go."""

    device: str = "auto"
    """``cpu``, ``cuda``, ``cuda:1``; ``auto`` is a GPU where there is one."""
    threads: int = 1
    """Of each process, on a CPU."""
    precision: str = "auto"
    """``fp32`` or ``bf16``; ``auto`` is bf16 where the device has units for it."""
    logs: tuple[str, ...] = ()
    """Names of other places, see :func:`~flowlab.learning.logs.make_log`."""


def prepare(
    data: Path,
    out: Path,
    settings: TrainSettings,
    machine: Machine,
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
            raise unknown("log", name, LOGS)
    processes = Processes(machine.device, machine.threads, machine.precision)
    processes.part(settings.batch.windows)
    source = open_source(data)
    corpus = load_corpus(source, out)
    train, held_out = corpus.split(settings.data.demonstrations, settings.data.held_out)
    if overfit is not None:
        train = held_out = list(range(min(overfit, len(corpus.demos))))
    policy = _make_policy(source, corpus, settings, began_from)
    planned = Run(
        dataset=data.resolve(),
        steps=_epochs_to_steps(corpus, train, settings),
        train=tuple(train),
        held_out=tuple(held_out),
        threads=machine.threads,
        device=processes.device.type,
        precision=processes.precision,
        logs=machine.logs,
        began_from=None if began_from is None else str(began_from),
    )
    if settings.run.minutes is not None and settings.run.steps is None:
        steps = _fitting_steps(Trainer(out, planned, copy.deepcopy(policy), corpus, processes), settings.run.minutes)
        planned = planned.model_copy(update={"steps": processes.tell(steps)})
    trainer = Trainer(out, planned, policy, corpus, processes)
    if processes.is_first:
        start_folder(out, Trained.now(policy.spec, source, corpus), planned)
        trainer.keep()
    processes.wait()
    return trainer


def resume(folder: Path, **changes: Any) -> Trainer:
    """A run that ended early, as it was after the last step that was kept; ``changes`` are those of its machine.

    Raises :class:`DataError` where the dataset is no longer what the run began with.
    """
    kept, trained = read_run(folder), read_trained(folder)
    kept = kept.model_copy(update=changes)
    processes = Processes(kept.device, kept.threads, kept.precision)
    source = open_source(kept.dataset)
    check_observer(trained, folder, source)
    if source.fingerprint != trained.fingerprint:
        raise DataError(
            f"{folder}: began with content {trained.fingerprint} of {kept.dataset}, now {source.fingerprint}; "
            "restore the dataset, or start a new run"
        )
    step, groups = read_resume(folder)
    trainer = Trainer(folder, kept, PolicyNetwork(trained.policy), load_corpus(source, folder), processes)
    trainer.take_up(step, groups)
    return trainer


def run(trainer: Trainer, report: Callable[[Progress], None], should_stop: Callable[[], bool] = lambda: False) -> bool:
    """Train to the end; whether it was reached."""
    first = trainer.processes.is_first
    name, settings = trainer.folder.name, trainer.settings.model_dump(mode="json")
    logs = [make_log(log, trainer.folder, name, settings) for log in trainer.run.logs] if first else []
    with room_to_write(trainer.folder):
        metrics = Metrics(trainer.folder, trainer.step, logs) if first else None
    try:
        return trainer.fit(metrics, report if first else _silent, should_stop)
    finally:
        if metrics is not None:
            metrics.close()
        trainer.processes.close()


def _silent(progress: Progress) -> None:
    """Only the first process reports."""


def _make_policy(source: Source, corpus: Corpus, settings: TrainSettings, began_from: Path | None) -> PolicyNetwork:
    if settings.policy == "mba" and corpus.object_pose.shape[1] != 9:
        raise DataError(
            f"{source.path}: has no object poses, which mba learns to predict; train --policy fdp, which learns from "
            "points, or dp3"
        )
    loaded = None if began_from is None else load_policy(began_from)
    layout = find_layout(source, corpus)
    spec = PolicySpec(
        settings=settings,
        state_width=corpus.state.shape[1],
        action_width=corpus.action.shape[1],
        tasks=corpus.tasks,
        layout=layout,
        normaliser=fit(source, corpus, layout, settings),
        observer=source.observer,
        queries={**source.queries, **query_settings(settings.motion)},
    )
    torch.manual_seed(settings.run.seed)
    if loaded is None:
        return PolicyNetwork(spec)
    check_observer(loaded.trained, loaded.path, source)
    old = loaded.trained.policy
    policy = PolicyNetwork(spec.model_copy(update={"normaliser": old.normaliser, "layout": old.layout}))
    try:
        policy.load_state_dict(loaded.policy.state_dict())
    except RuntimeError as error:
        raise UsageError(
            f"{loaded.path}: its network has another shape than the one asked for; train with the policy, profile and "
            f"settings of {began_from}, on data with the same tasks, state and actions"
        ) from error
    return policy


def _epochs_to_steps(corpus: Corpus, train: list[int], settings: TrainSettings) -> int:
    if settings.run.steps is not None:
        return settings.run.steps
    windows = sum(max(1, len(corpus.demos[d]) - settings.executed + 1) for d in train)
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
    looks = trial.settings.run.validations if trial.run.held_out else 0
    per_look = seconds(trial.validate) if looks else 0.0
    return max(1, int((60 * minutes - looks * per_look) / per_step))
