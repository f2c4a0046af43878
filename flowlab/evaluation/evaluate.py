"""Evaluate trained policies: which episodes are missing, who tries them, and what came out."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from flowlab.arguments import check_count, check_counts, check_names, check_optional_count, check_paths
from flowlab.engines.base import StartEngine, core_count, engine_by_name
from flowlab.errors import UnfinishedError, UsageError
from flowlab.evaluation.checkpoints import CheckpointRef, common_tasks, find_checkpoint, find_checkpoints
from flowlab.evaluation.execution import AUTO, check_not_choosing, choose_execution
from flowlab.evaluation.results import CheckpointEvaluation, PolicyResult
from flowlab.evaluation.training_record import describe_run
from flowlab.evaluation.trials import Trial, check_unseen, list_trials
from flowlab.text import counted

if TYPE_CHECKING:
    from flowlab.evaluation.episode_batches import EpisodeBatch

_WORK = "flowlab.evaluation.episode_batches"
"""What workers need; it takes seconds to import, and is when nothing was refused."""
Progress = Callable[[int, int], None]
"""Told how many episodes are done, of how many."""


def evaluate(
    runs: Path | str | Sequence[Path | str],
    *,
    tasks: Sequence[str] | str = (),
    seeds: Sequence[int] | int = (0, 1, 2),
    episodes: int = 20,
    n_action_steps: int | Literal["auto"] | None = None,
    checkpoints: bool = False,
    engine: str = "local",
    workers: int | None = None,
    device: str = "cpu",
    on_progress: Progress | None = None,
    on_choosing: Progress | None = None,
) -> list[PolicyResult]:
    """Let trained policies act in simulation, on scenes that none of them was trained on.

    How every episode went is kept in the run's folder as it ends: ended early, the same call does the rest, and more
    episodes add to those that are there. What comes out does not depend on the number of workers.

    Args:
        runs: Folders that :func:`flowlab.train` made, or checkpoints of theirs.
        tasks: What to try; by default all tasks that every policy was trained on.
        seeds: Evaluation seeds, which decide the scenes: the same for every policy.
        episodes: How many to try of each task and seed.
        n_action_steps: Steps of every plan to execute; by default as many as each policy was trained to. ``auto``
            chooses for each run among these and 2, 4 and 8 what solves most of 20 other layouts of each task.
        checkpoints: Evaluate every checkpoint of the runs, not the newest alone.
        engine: Name or import path of what runs the workers.
        workers: How many; by default one for each core that this process may use.
        device: Where plans are made, as PyTorch names it.
        on_progress: Told how many episodes are done, of how many.
        on_choosing: Told the same of the other layouts, for one run after the other, while ``auto`` chooses; by default
            ``on_progress`` is.

    Returns:
        A result for each run, with an evaluation for each of its checkpoints that were asked for, in order of steps.

    Raises:
        DataError: A run has no checkpoint, or was not trained in simulation.
        UsageError: A name or number does not fit, or a scene was trained on.
        UnfinishedError: Workers failed; the same call tries their episodes again.
    """
    paths = check_paths(runs, "runs")
    if not paths:
        raise UsageError(
            "runs: there is none to evaluate; give the folder of a run, as in flowlab.evaluate('runs/fdp')"
        )
    tasks, seeds, episodes = (
        check_names(tasks, "tasks"),
        check_counts(seeds, "seeds", least=None),
        check_count(episodes, "episodes"),
    )
    chooses = n_action_steps == AUTO
    steps = None if chooses else check_optional_count(n_action_steps, "n_action_steps")
    workers = check_optional_count(workers, "workers")
    refs = [ref for path in paths for ref in _checkpoints_of(path, steps, every=checkpoints)]
    trials = list_trials(common_tasks(refs, tasks), seeds, episodes)
    progress = on_progress or (lambda done, of: None)
    run_trials = partial(evaluate_checkpoints, engine=engine, workers=workers, device=device, on_progress=progress)
    choices = {}
    if chooses:
        check_not_choosing(seeds)
        newest = {ref.run: ref for ref in sorted(refs, key=lambda r: r.step)}
        choose = partial(run_trials, on_progress=on_choosing or progress)
        choices = {run: choose_execution(ref, common_tasks(refs, tasks), choose) for run, ref in newest.items()}
        refs = [replace(ref, n_action_steps=choices[ref.run].best) for ref in refs]
    found = run_trials(refs, trials)
    by_run: dict[Path, list[CheckpointEvaluation]] = {}
    for ref, evaluation in zip(refs, found, strict=True):
        by_run.setdefault(ref.run, []).append(evaluation)
    described = [describe_run(run, evaluations) for run, evaluations in by_run.items()]
    return [r.model_copy(update={"execution": choices.get(run)}) for run, r in zip(by_run, described, strict=True)]


def evaluate_checkpoints(
    checkpoints: Sequence[CheckpointRef],
    trials: Sequence[Trial],
    *,
    engine: str,
    workers: int | None,
    device: str,
    on_progress: Progress,
) -> list[CheckpointEvaluation]:
    """Try what has not been tried yet, and return all results, for every checkpoint in turn.

    The arguments are those of :func:`evaluate`. Raises :class:`UnfinishedError` where workers failed.
    """
    for checkpoint in checkpoints:
        check_unseen(trials, checkpoint.trained.scene_seeds, checkpoint.run)
    workers = workers or core_count()
    start_engine = engine_by_name(engine, workers, [_WORK])
    from flowlab.evaluation.episode_batches import missing_batches

    batches = [b for c in checkpoints for b in missing_batches(c, trials, workers * 2, device)]
    batches.sort(key=lambda b: b.trials[0].task)  # a worker keeps the simulations of the last task
    if batches:
        _run_batches(batches, len(checkpoints) * len(trials), start_engine, on_progress)
    return [c.read_evaluation(trials) for c in checkpoints]


def _checkpoints_of(path: Path, n_action_steps: int | None, *, every: bool) -> list[CheckpointRef]:
    """All checkpoints of a run, or the newest alone."""
    return find_checkpoints(path, n_action_steps) if every else [find_checkpoint(path, n_action_steps)]


def _run_batches(
    batches: Sequence["EpisodeBatch"], total: int, start_engine: "StartEngine[EpisodeBatch, int]", on_progress: Progress
) -> None:
    """Have workers try every batch. Raises :class:`UnfinishedError` where some failed."""
    from flowlab.evaluation.episode_batches import run_batch

    done = total - sum(len(b.trials) for b in batches)
    on_progress(done, total)
    failures = []
    with start_engine(run_batch) as engine:
        for ended in engine.results_of(batches):
            if ended.receipt is None:
                failures.append(ended.reason)
            done += ended.receipt or 0
            on_progress(done, total)
    if failures:
        raise UnfinishedError(
            f"{total - done} of {counted(total, 'episode')} could not be tried; the first failure: {failures[0]}; "
            f"the same command tries them again"
        )
