"""Episodes of one task for one policy: those that are missing, as units of work, and how a worker does them."""

import time
from collections.abc import Iterable, Sequence
from functools import lru_cache
from pathlib import Path

import torch

from flowlab.config import Settings
from flowlab.deployment.loading import check_device
from flowlab.evaluation.checkpoints import CheckpointRef
from flowlab.evaluation.episode_log import append_result, read_results
from flowlab.evaluation.results import CheckpointEvaluation
from flowlab.evaluation.rollout import BATCH_SLOTS, SimulatorPool, roll_out
from flowlab.evaluation.trials import Trial, check_unseen
from flowlab.files import check_inside, remove_leftovers, told_when_unwritable
from flowlab.policies.base import PolicyNetwork
from flowlab.policies.checkpoint import load_policy
from flowlab.registry import POLICIES
from flowlab.sim.scene_settings import SceneSettings

_LARGEST_BATCH = 40
"""Episodes given to a worker at a time: few enough that progress shows."""


class EpisodeBatch(Settings):
    """Some episodes of one task for one policy: what a worker does at a time."""

    policy: str
    """Name or import path of its kind, which whoever asked for the evaluation has loaded."""
    weights: Path
    episodes: Path
    """The file that results are added to."""
    scene: SceneSettings
    n_action_steps: int
    trials: tuple[Trial, ...]
    device: str = "cpu"


def missing_batches(
    checkpoint: CheckpointRef, trials: Sequence[Trial], parts: int, device: str
) -> Iterable[EpisodeBatch]:
    """Batches of the trials that have no result yet, at least ``parts`` of them if there are enough."""
    folder = checkpoint.episodes.parent
    check_inside(checkpoint.run, checkpoint.episodes)
    with told_when_unwritable(folder, "make room, or copy the run to where it can be written"):
        folder.mkdir(parents=True, exist_ok=True)
        remove_leftovers(folder)
    known = read_results(checkpoint.episodes)
    todo = [t for t in trials if t not in known]
    rounds = -(-len(todo) // (parts * BATCH_SLOTS))  # every slot has as many episodes
    size = min(rounds * BATCH_SLOTS, _LARGEST_BATCH)
    for task in dict.fromkeys(t.task for t in todo):
        of_task = [t for t in todo if t.task == task]
        for first in range(0, len(of_task), size):
            yield EpisodeBatch(
                policy=checkpoint.trained.policy.settings.policy,
                weights=checkpoint.weights,
                episodes=checkpoint.episodes,
                scene=checkpoint.scene,
                n_action_steps=checkpoint.n_action_steps,
                trials=tuple(of_task[first : first + size]),
                device=device,
            )


def evaluate_here(checkpoint: CheckpointRef, trials: Sequence[Trial], device: str = "cpu") -> CheckpointEvaluation:
    """Try what has not been tried yet in this process, and return all results, with the CPU time they took."""
    check_unseen(trials, checkpoint.trained.scene_seeds, checkpoint.run)
    began, tried = time.process_time(), 0
    for batch in missing_batches(checkpoint, trials, 1, device):
        tried += run_batch(batch)
    found = checkpoint.read_evaluation(trials)
    if not tried:
        return found
    spent = time.process_time() - began
    return found.model_copy(update={"cpu_s": round(spent * len(trials) / tried, 1)})


def run_batch(batch: EpisodeBatch) -> int:
    """A worker's part: try every episode, keep each result as it ends, and say how many there were."""
    torch.set_num_threads(1)
    check_device(batch.device)
    POLICIES.load(batch.policy)
    policy = _policy(batch.weights, batch.device)
    simulators = _simulators(batch.trials[0].task, batch.scene)
    known = read_results(batch.episodes)  # by a worker that died over this batch
    todo = [trial for trial in batch.trials if trial not in known]
    for episode in roll_out(policy, simulators, todo, n_action_steps=batch.n_action_steps):
        append_result(batch.episodes, episode.result)
    return len(batch.trials)


@lru_cache(maxsize=4)
def _policy(weights: Path, device: str) -> PolicyNetwork:
    """A policy that this worker keeps for its next batch."""
    return load_policy(weights, device).policy


@lru_cache(maxsize=1)
def _simulators(task: str, scene: SceneSettings) -> SimulatorPool:
    """Simulators that this worker keeps for its next batch."""
    return SimulatorPool(task, scene)
