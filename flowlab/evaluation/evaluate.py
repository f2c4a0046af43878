"""Evaluate trained policies: which episodes are missing, who tries them, and what came out."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path

import torch

from flowlab.benchmark.results import Evaluation
from flowlab.config import Settings
from flowlab.engines.base import StartEngine
from flowlab.engines.local import LocalEngine
from flowlab.errors import DataError, UnfinishedError, UsageError, unknown_name
from flowlab.evaluation import trials as log
from flowlab.evaluation.rollout import BATCH_SLOTS, SimulatorPool, roll_out
from flowlab.evaluation.trials import Trial, check_unseen
from flowlab.policies.base import PolicyNetwork
from flowlab.policies.checkpoint import (
    CHECKPOINTS,
    TrainedPolicy,
    load_policy,
    newest_checkpoint,
    read_trained,
    step_of,
)
from flowlab.sim.simulation import SceneSettings

FOLDER = "evaluation"
"""Of a run: holds a folder for every checkpoint and number of executed steps."""
EPISODES = "episodes.jsonl"
_LARGEST_BLOCK = 40
"""Episodes given to a worker at a time: few enough that progress shows."""


@dataclass(frozen=True, slots=True)
class CheckpointRef:
    """A checkpoint to be evaluated."""

    run: Path
    weights: Path
    step: int
    n_action_steps: int
    """Steps of every plan that are executed."""
    trained: TrainedPolicy

    @property
    def episodes(self) -> Path:
        """Where its outcomes are kept."""
        return self.run / FOLDER / f"step-{self.step:08d}-execute-{self.n_action_steps}" / EPISODES

    def evaluation(self, wanted: Sequence[Trial]) -> Evaluation:
        """The outcomes of those of the episodes that have been tried."""
        known = log.read(self.episodes)
        return Evaluation(
            step=self.step, n_action_steps=self.n_action_steps, outcomes=tuple(known[t] for t in wanted if t in known)
        )


class EpisodeBatch(Settings):
    """Some episodes of one task for one policy: what a worker does at a time."""

    weights: Path
    episodes: Path
    """The file that outcomes are added to."""
    scene: SceneSettings
    n_action_steps: int
    trials: tuple[Trial, ...]
    device: str = "cpu"


def find_checkpoint(path: Path, n_action_steps: int | None = None) -> CheckpointRef:
    """The newest checkpoint of a run, or the one that is given.

    Raises :class:`DataError` where there is none, or the policy was not trained in simulation, and
    :class:`UsageError` where its plans are shorter than ``n_action_steps`` steps.
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
    most = s.horizon - s.n_obs_steps + 1
    if n_action_steps is not None and not 1 <= n_action_steps <= most:
        raise UsageError(f"--execute {n_action_steps}: {path} plans {most} steps ahead, so execute 1 to {most}")
    return CheckpointRef(run, weights, step_of(weights), n_action_steps or s.n_action_steps, trained)


def find_checkpoints(run: Path, n_action_steps: int | None = None) -> list[CheckpointRef]:
    """Every checkpoint of a run, oldest first."""
    newest_checkpoint(run)
    return [find_checkpoint(path, n_action_steps) for path in sorted((run / CHECKPOINTS).glob("step-*.safetensors"))]


def choose_tasks(subjects: Sequence[CheckpointRef], asked: Sequence[str]) -> tuple[str, ...]:
    """The tasks that are asked for, or all that every policy knows. Raises :class:`UsageError` where there is none."""
    known = [set(s.trained.policy.tasks) for s in subjects]
    for subject, tasks in zip(subjects, known, strict=True):
        for task in asked:
            if task not in tasks:
                raise UsageError(f"{subject.run}: {unknown_name('task that it was trained on', task, tasks)}")
    common = set.intersection(*known)
    if not common:
        each = "; ".join(f"{s.run} {', '.join(sorted(k))}" for s, k in zip(subjects, known, strict=True))
        raise UsageError(f"no task is common to all runs ({each}); evaluate them apart, or make one report of them")
    return tuple(dict.fromkeys(asked)) or tuple(sorted(common))


def evaluate(
    subjects: Sequence[CheckpointRef],
    wanted: Sequence[Trial],
    *,
    start_engine: StartEngine[EpisodeBatch, int],
    workers: int,
    device: str = "cpu",
    report: Callable[[int, int], None] = lambda done, of: None,
) -> list[Evaluation]:
    """Try what has not been tried yet, and return all outcomes, for every subject in turn.

    Every outcome is kept as its episode ends, so that an evaluation that was ended goes on where it was. ``report`` is
    told how many episodes are done, of how many. Raises :class:`UnfinishedError` where workers failed.
    """
    for subject in subjects:
        check_unseen(wanted, subject.trained.scene_seeds, subject.run)
    blocks = [b for s in subjects for b in _missing(s, wanted, workers * 2, device)]
    blocks.sort(key=lambda b: b.trials[0].task)  # a worker keeps the simulations of the last task
    if blocks:
        _try_all(blocks, len(subjects) * len(wanted), start_engine, report)
    return [s.evaluation(wanted) for s in subjects]


def run_batch(block: EpisodeBatch) -> int:
    """A worker's part: try every episode, keep each outcome as it ends, and say how many there were."""
    torch.set_num_threads(1)
    policy = _policy(block.weights, block.device)
    stage = _stage(block.trials[0].task, block.scene)
    known = log.read(block.episodes)  # by a worker that died over this block
    todo = [trial for trial in block.trials if trial not in known]
    for attempt in roll_out(policy, stage, todo, n_action_steps=block.n_action_steps):
        log.append(block.episodes, attempt.outcome)
    return len(block.trials)


def _try_all(
    blocks: Sequence[EpisodeBatch],
    total: int,
    start_engine: StartEngine[EpisodeBatch, int],
    report: Callable[[int, int], None],
) -> None:
    done = total - sum(len(b.trials) for b in blocks)
    report(done, total)
    failures = []
    with start_engine(run_batch) as engine:
        for block in blocks:
            engine.submit(block)
        for _ in blocks:
            ended = engine.next_result()
            if ended.receipt is None:
                failures.append(ended.failure.strip())
            done += ended.receipt or 0
            report(done, total)
    if failures:
        raise UnfinishedError(
            f"{total - done} of {total} episodes could not be tried; the first failure: "
            f"{failures[0].splitlines()[-1]}; the same command tries them again"
        )


def run_missing(subject: CheckpointRef, wanted: Sequence[Trial], device: str = "cpu") -> None:
    """Try what has not been tried yet, in this process."""
    check_unseen(wanted, subject.trained.scene_seeds, subject.run)
    for block in _missing(subject, wanted, 1, device):
        run_batch(block)


def _missing(subject: CheckpointRef, wanted: Sequence[Trial], parts: int, device: str) -> Iterable[EpisodeBatch]:
    """Blocks of the episodes that have no outcome yet, at least ``parts`` of them if there are enough episodes."""
    subject.episodes.parent.mkdir(parents=True, exist_ok=True)
    log.repair_tail(subject.episodes)
    known = log.read(subject.episodes)
    todo = [t for t in wanted if t not in known]
    rounds = -(-len(todo) // (parts * BATCH_SLOTS))  # every lane of a block has as many episodes
    size = min(rounds * BATCH_SLOTS, _LARGEST_BLOCK)
    scene = SceneSettings.model_validate(subject.trained.scene).model_copy(update={"rgb": False})
    for task in dict.fromkeys(t.task for t in todo):
        of_task = [t for t in todo if t.task == task]
        for first in range(0, len(of_task), size):
            yield EpisodeBatch(
                weights=subject.weights,
                episodes=subject.episodes,
                scene=scene,
                n_action_steps=subject.n_action_steps,
                trials=tuple(of_task[first : first + size]),
                device=device,
            )


@lru_cache(maxsize=4)
def _policy(weights: Path, device: str) -> PolicyNetwork:
    return load_policy(weights, device).policy


@lru_cache(maxsize=1)
def _stage(task: str, scene: SceneSettings) -> SimulatorPool:
    return SimulatorPool(task, scene)


def local_engine(workers: int) -> StartEngine[EpisodeBatch, int]:
    """Processes of this machine."""
    return partial(LocalEngine, workers=workers, imports=[__name__])
