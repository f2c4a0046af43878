"""Train a policy: what ``flowlab train`` and ``flowlab.train`` both call."""

import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flowlab.arguments import check_count, check_minutes, check_names, check_optional_count, check_path, check_settings
from flowlab.data.mixture import check_weights, dataset_shares
from flowlab.data.source import paths_of
from flowlab.hub.pulling import local_sources
from flowlab.policies.profiles import load_settings
from flowlab.policies.trained import read_trained, writing_run
from flowlab.storage.dataset import Dataset
from flowlab.text import counted
from flowlab.training.loggers import check_loggers
from flowlab.training.metrics import last_metrics
from flowlab.training.precision import Precision
from flowlab.training.resume import resume_run
from flowlab.training.run import ComputeSettings, begin_run, run
from flowlab.training.trainer import Trainer, TrainingProgress
from flowlab.viz.training_metrics import METRICS

CURVE = "curve.png"
_SETTINGS_FORM = "a list of strings, as in settings=['batch.windows=64']"


@dataclass(frozen=True, slots=True)
class TrainedRun:
    """A training run that has come to its end, or was stopped."""

    folder: Path
    policy: str
    """Name of the policy."""
    step: int
    """Training steps done."""
    steps: int
    """Training steps that the run has in all."""
    finished: bool
    """Whether it came to its end; else it can be resumed."""
    training: dict[str, float]
    """The newest losses."""
    validation: dict[str, float]
    """The newest errors on held-out demonstrations, see :func:`~flowlab.training.validation.validate`."""

    @property
    def curve(self) -> Path:
        """The figure of how losses and errors fell."""
        return self.folder / CURVE

    def to_json(self) -> dict[str, Any]:
        """The same as JSON values.

        Returns:
            One JSON object, as ``flowlab train --json`` prints it.
        """
        return {
            "run": str(self.folder),
            "policy": self.policy,
            "step": self.step,
            "steps": self.steps,
            "finished": self.finished,
            "training": self.training,
            "validation": self.validation,
        }


def _ignore(_: object) -> None:
    """Nobody wants to know."""


def _never() -> bool:
    return False


@dataclass(frozen=True, slots=True)
class Watch:
    """Who looks on while a run goes."""

    on_start: Callable[[str], None] = _ignore
    """Is told in words what was found and what will be done."""
    on_progress: Callable[[TrainingProgress], None] = _ignore
    """Is told how far the run is, every fifty steps."""
    should_stop: Callable[[], bool] = _never
    """Asked after every step whether to stop, as one that can be resumed."""


def train(
    data: Dataset | Path | str | Sequence[Dataset | Path | str],
    out: Path | str,
    *,
    policy: str = "fdp",
    profile: str = "fast",
    minutes: float | None = None,
    settings: Sequence[str] = (),
    seed: int | None = None,
    overfit: int | None = None,
    began_from: Path | str | None = None,
    weights: Sequence[float | int] | None = None,
    device: str = "auto",
    threads: int = 1,
    precision: Precision = "auto",
    logs: Sequence[str] = (),
    watch: Watch = Watch(),
) -> TrainedRun:
    """Train a policy on a dataset.

    Under ``torchrun`` every process calls this, and they share each batch.

    Args:
        data: A dataset, opened or its path, or a store in DP3's layout; or several datasets that say the same of their
            frame, their camera, and what their numbers mean. ``hub:user/name`` is a dataset on the Hugging Face Hub,
            which is pulled into the cache.
        out: Folder of the run. Where the same call began it earlier, it goes on as if it had never stopped.
        policy: ``fdp``, ``dp3``, ``mba``, what an installed package offers, or ``module:Class``, whose module may lie
            in the current folder.
        profile: ``fast``, ``paper``, or a YAML file; see :func:`~flowlab.policies.profiles.load_settings`.
        minutes: How long, in CPU time of one thread, or on a GPU by the clock; None leaves it to the profile.
        settings: Single changes, ``key.path=value``.
        seed: Short for the setting ``run.seed``.
        overfit: Train on so many demonstrations, the first ones, and validate on the same.
        began_from: A run, or one of its checkpoints, that the first weights are taken from.
        weights: Of several datasets, how much of all windows each has, relative to the others: ``[0.7, 0.3]`` or
            ``[7, 3]``; None draws all windows alike, so that larger datasets have more of them.
        device: ``cpu``, ``cuda`` or ``cuda:1``; ``auto`` is a GPU where there is one.
        threads: CPU threads of each process.
        precision: ``fp32`` or ``bf16``; ``auto`` is bf16 where the device has units for it.
        logs: Where else metrics go: ``tensorboard``, ``wandb``, what an installed package offers, or ``module:Class``.
        watch: Is told of the run as it goes, and may stop it.

    Returns:
        The run, of which ``folder`` is what :class:`flowlab.Policy` loads.

    Raises:
        UsageError: A name, a setting or an option is wrong, or ``out`` holds a run that began in another way.
        DataError: The dataset cannot be read, or lacks what the policy is trained on.
        DivergedError: The loss is no longer a number.
    """
    here = Path.cwd()
    minutes, seed = check_minutes(minutes), check_optional_count(seed, "seed", 0)
    overfit, threads = check_optional_count(overfit, "overfit"), check_count(threads, "threads")
    logs = check_names(logs, "logs")
    changes = [f"run.minutes={minutes}", "run.steps=null"] if minutes is not None else []
    changes += [f"run.seed={seed}"] if seed is not None else []
    chosen = load_settings(profile, policy, [*check_settings(settings, form=_SETTINGS_FORM), *changes], here)
    check_loggers(tuple(logs), here)
    compute = ComputeSettings(device=device, threads=threads, precision=precision, logs=tuple(logs))
    began = None if began_from is None else check_path(began_from, "began_from")
    weighed = check_weights(weights, len(data) if isinstance(data, list | tuple) else 1) or None
    sources = paths_of(local_sources(data, watch.on_start))
    trainer = begin_run(
        sources, check_path(out, "out"), chosen, compute, overfit=overfit, began_from=began, weights=weighed
    )
    return _run(trainer, watch)


def resume(
    folder: Path | str,
    *,
    device: str | None = None,
    threads: int | None = None,
    precision: Precision | None = None,
    logs: Sequence[str] | None = None,
    watch: Watch = Watch(),
) -> TrainedRun:
    """Go on with a run that ended early, as if it had never stopped.

    Arguments and errors are those of :func:`train`; what is None is as the run began.
    """
    if logs is not None:
        check_loggers(tuple(logs), Path.cwd())
    trainer = resume_run(Path(folder), device=device, threads=threads, precision=precision, logs=logs)
    return _run(trainer, watch)


@contextmanager
def stop_on_signal() -> Iterator[Callable[[], bool]]:
    """Tells, by what it yields, whether Ctrl-C or a termination asked to stop; a second one stops at once."""
    asked: list[int] = []

    def ask(number: int, _: object) -> None:
        if asked:
            raise KeyboardInterrupt
        asked.append(number)

    before = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: bool(asked)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _run(trainer: Trainer, watch: Watch) -> TrainedRun:
    first, metrics = trainer.processes.is_first, trainer.folder / METRICS
    if first:
        for text in _describe(trainer):
            watch.on_start(text)
    finished = run(trainer, watch.on_progress, watch.should_stop)
    found = TrainedRun(
        folder=trainer.folder,
        policy=trainer.settings.policy,
        step=trainer.step,
        steps=trainer.run.steps,
        finished=finished,
        training=last_metrics(metrics, "train") if first else {},
        validation=last_metrics(metrics, "validation") if first else {},
    )
    if found.training or found.validation:
        from flowlab.viz.training_figure import draw_training

        with writing_run(trainer.folder):
            draw_training(metrics, found.curve)
    return found


def _describe(trainer: Trainer) -> Iterator[str]:
    """What was found and what will be done, before it takes long."""
    spec, planned = trainer.policy.spec, trainer.run
    inferred = len(set(planned.train) & set(planned.inferred))
    taught = counted(len(planned.train), "demonstration") + (f" ({inferred} with inferred actions)" if inferred else "")
    millions = sum(p.numel() for p in trainer.policy.parameters()) / 1e6
    yield (
        f"{spec.settings.policy}, {millions:.1f} M weights, {planned.steps - trainer.step:,} steps on "
        f"{taught} of {', '.join(spec.tasks)}; {len(planned.held_out)} held out; "
        f"{trainer.processes.description}"
    )
    trained = read_trained(trainer.folder)
    yield from map(str, dataset_shares(trained.mixture, trained.dataset))
    if set(planned.held_out) & set(planned.inferred):
        yield (
            "actions of what is held out were inferred, too: held-out errors are against these, not against what a "
            "robot was told; give demonstrations with actions beside them"
        )
    if trainer.step:
        yield f"{trainer.folder}: goes on after step {trainer.step:,} of {planned.steps:,}"
    if spec.settings.relative_to_gripper and spec.channels.gripper is None:
        yield "points are given in the world frame: the data do not tell where in it the gripper is"
    if (spec.settings.batch.shift_m or spec.settings.batch.turn_deg) and not spec.channels.shifts:
        yield (
            "no scene is shifted or turned in training (batch.shift_m, batch.turn_deg): the data do not tell what "
            "their actions would be elsewhere"
        )
