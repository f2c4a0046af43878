"""Evaluate trained policies: which episodes are missing, who tries them, and what came out."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path

import torch

from flowlab.config import Settings
from flowlab.errors import DataError, UnfinishedError, UsageError, unknown
from flowlab.evaluation import trials as log
from flowlab.evaluation.results import Evaluation
from flowlab.evaluation.rollout import LANES, Stage, roll_out
from flowlab.evaluation.trials import Trial, check_unseen
from flowlab.learning.checkpoint import CHECKPOINTS, Trained, load_policy, newest_checkpoint, read_trained, step_of
from flowlab.learning.policy import PolicyNetwork
from flowlab.pipeline.engine import LocalEngine, StartEngine
from flowlab.sim.environment import SceneSettings

FOLDER = "evaluation"
"""Of a run: holds a folder for every checkpoint and number of executed steps."""
EPISODES = "episodes.jsonl"
_LARGEST_BLOCK = 40
"""Episodes given to a worker at a time: few enough that progress shows."""


@dataclass(frozen=True, slots=True)
class Subject:
    """A checkpoint to be evaluated."""

    run: Path
    weights: Path
    step: int
    executed: int
    """Steps of every plan that are executed."""
    trained: Trained

    @property
    def episodes(self) -> Path:
        """Where its outcomes are kept."""
        return self.run / FOLDER / f"step-{self.step:08d}-execute-{self.executed}" / EPISODES

    def evaluation(self, wanted: Sequence[Trial]) -> Evaluation:
        """The outcomes of those of the episodes that have been tried."""
        known = log.read(self.episodes)
        return Evaluation(
            step=self.step, executed=self.executed, outcomes=tuple(known[t] for t in wanted if t in known)
        )


class Block(Settings):
    """Some episodes of one task for one policy: what a worker does at a time."""

    weights: Path
    episodes: Path
    """The file that outcomes are added to."""
    scene: SceneSettings
    executed: int
    trials: tuple[Trial, ...]
    device: str = "cpu"


def find_subject(path: Path, executed: int | None = None) -> Subject:
    """The newest checkpoint of a run, or the one that is given.

    Raises :class:`DataError` where there is none, or the policy was not trained in simulation, and
    :class:`UsageError` where its plans are shorter than ``executed`` steps.
    """
    weights = newest_checkpoint(path) if path.suffix != ".safetensors" else path
    run = weights.absolute().parents[1] if path.suffix == ".safetensors" else path
    trained = read_trained(run)
    s = trained.policy.settings
    if trained.scene is None or trained.policy.observer is None:
        raise DataError(
            f"{path}: was trained on recordings or on a DP3 store ({trained.dataset}), so no simulation shows what it "
            f"knows; compare it with held-out demonstrations by 'flowlab eval {path} --offline'"
        )
    most = s.horizon - s.history + 1
    if executed is not None and not 1 <= executed <= most:
        raise UsageError(f"--execute {executed}: {path} plans {most} steps ahead, so execute 1 to {most}")
    return Subject(run, weights, step_of(weights), executed or s.executed, trained)


def find_checkpoints(run: Path, executed: int | None = None) -> list[Subject]:
    """Every checkpoint of a run, oldest first."""
    newest_checkpoint(run)
    return [find_subject(path, executed) for path in sorted((run / CHECKPOINTS).glob("step-*.safetensors"))]


def choose_tasks(subjects: Sequence[Subject], asked: Sequence[str]) -> tuple[str, ...]:
    """The tasks that are asked for, or all that every policy knows. Raises :class:`UsageError` where there is none."""
    known = [set(s.trained.policy.tasks) for s in subjects]
    for subject, tasks in zip(subjects, known, strict=True):
        for task in asked:
            if task not in tasks:
                raise UsageError(f"{subject.run}: {unknown('task that it was trained on', task, tasks)}")
    common = set.intersection(*known)
    if not common:
        each = "; ".join(f"{s.run} {', '.join(sorted(k))}" for s, k in zip(subjects, known, strict=True))
        raise UsageError(f"no task is common to all runs ({each}); evaluate them apart, or make one report of them")
    return tuple(dict.fromkeys(asked)) or tuple(sorted(common))


def evaluate(
    subjects: Sequence[Subject],
    wanted: Sequence[Trial],
    *,
    start_engine: StartEngine[Block, int],
    workers: int,
    device: str = "cpu",
    report: Callable[[int, int], None] = lambda done, of: None,
) -> list[Evaluation]:
    """Try what has not been tried yet, and return all outcomes, for every subject in turn.

    Every outcome is kept as its episode ends, so that an evaluation that was ended goes on where it was. ``report`` is
    told how many episodes are done, of how many. Raises :class:`UnfinishedError` where workers failed.
    """
    for subject in subjects:
        check_unseen(wanted, subject.trained.layouts, subject.run)
    blocks = [b for s in subjects for b in _missing(s, wanted, workers * 2, device)]
    blocks.sort(key=lambda b: b.trials[0].task)  # a worker keeps the simulations of the last task
    if blocks:
        _try_all(blocks, len(subjects) * len(wanted), start_engine, report)
    return [s.evaluation(wanted) for s in subjects]


def try_block(block: Block) -> int:
    """A worker's part: try every episode, keep each outcome as it ends, and say how many there were."""
    torch.set_num_threads(1)
    policy = _policy(block.weights, block.device)
    stage = _stage(block.trials[0].task, block.scene)
    known = log.read(block.episodes)  # by a worker that died over this block
    todo = [trial for trial in block.trials if trial not in known]
    for attempt in roll_out(policy, stage, todo, executed=block.executed):
        log.append(block.episodes, attempt.outcome)
    return len(block.trials)


def _try_all(
    blocks: Sequence[Block], total: int, start_engine: StartEngine[Block, int], report: Callable[[int, int], None]
) -> None:
    done = total - sum(len(b.trials) for b in blocks)
    report(done, total)
    failures = []
    with start_engine(try_block) as engine:
        for block in blocks:
            engine.submit(block)
        for _ in blocks:
            ended = engine.next_outcome()
            if ended.receipt is None:
                failures.append(ended.failure.strip())
            done += ended.receipt or 0
            report(done, total)
    if failures:
        raise UnfinishedError(
            f"{total - done} of {total} episodes could not be tried; the first failure: "
            f"{failures[0].splitlines()[-1]}; the same command tries them again"
        )


def try_missing(subject: Subject, wanted: Sequence[Trial], device: str = "cpu") -> None:
    """Try what has not been tried yet, in this process."""
    check_unseen(wanted, subject.trained.layouts, subject.run)
    for block in _missing(subject, wanted, 1, device):
        try_block(block)


def _missing(subject: Subject, wanted: Sequence[Trial], parts: int, device: str) -> Iterable[Block]:
    """Blocks of the episodes that have no outcome yet, at least ``parts`` of them if there are enough episodes."""
    subject.episodes.parent.mkdir(parents=True, exist_ok=True)
    log.mend(subject.episodes)
    known = log.read(subject.episodes)
    todo = [t for t in wanted if t not in known]
    rounds = -(-len(todo) // (parts * LANES))  # every lane of a block has as many episodes
    size = min(rounds * LANES, _LARGEST_BLOCK)
    scene = SceneSettings.model_validate(subject.trained.scene).model_copy(update={"rgb": False})
    for task in dict.fromkeys(t.task for t in todo):
        of_task = [t for t in todo if t.task == task]
        for first in range(0, len(of_task), size):
            yield Block(
                weights=subject.weights,
                episodes=subject.episodes,
                scene=scene,
                executed=subject.executed,
                trials=tuple(of_task[first : first + size]),
                device=device,
            )


@lru_cache(maxsize=4)
def _policy(weights: Path, device: str) -> PolicyNetwork:
    return load_policy(weights, device).policy


@lru_cache(maxsize=1)
def _stage(task: str, scene: SceneSettings) -> Stage:
    return Stage(task, scene)


def local_engine(workers: int) -> StartEngine[Block, int]:
    """Processes of this machine."""
    return partial(LocalEngine, workers=workers, imports=[__name__])
