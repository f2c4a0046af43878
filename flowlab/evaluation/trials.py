"""Which episodes are tried: the same for every policy, and none of them demonstrated."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from flowlab.errors import UsageError

SCENES_PER_SEED = 1_000_000
"""Seed s is evaluated on the scenes from ``(s + 1) * SCENES_PER_SEED`` on; demonstrations are numbered from 0."""
MOST_SEEDS = 4000
"""Beyond, scenes would have no numbers left: MetaWorld's generator takes 32 bits."""


@dataclass(frozen=True, slots=True, order=True)
class Trial:
    """One episode to be tried: the ``episode``-th of an evaluation seed, the same for every policy."""

    task: str
    seed: int
    episode: int

    @property
    def scene_seed(self) -> int:
        """The seed that decides the scene, and the policy's noise."""
        return (self.seed + 1) * SCENES_PER_SEED + self.episode


def list_trials(tasks: Sequence[str], seeds: Sequence[int], episodes: int) -> list[Trial]:
    """Every episode of an evaluation, task by task.

    Args:
        tasks: Names of the tasks.
        seeds: Evaluation seeds; one that is there twice counts once.
        episodes: How many of each task and seed.

    Raises:
        UsageError: A seed or the number of episodes is out of range.
    """
    if bad := [s for s in seeds if not 0 <= s < MOST_SEEDS]:
        raise UsageError(f"seed {bad[0]}: evaluation seeds are from 0 to {MOST_SEEDS - 1}")
    if not 0 < episodes <= SCENES_PER_SEED:
        raise UsageError(f"{episodes} episodes: a seed has from 1 to {SCENES_PER_SEED:,}")
    return [Trial(task, seed, k) for task in tasks for seed in dict.fromkeys(seeds) for k in range(episodes)]


def check_unseen(trials: Iterable[Trial], trained_on: Mapping[str, Sequence[int]], where: Path) -> None:
    """Refuse to evaluate on a scene that the policy's dataset holds.

    Args:
        trials: What is to be tried.
        trained_on: Scene seeds of the dataset, by task.
        where: The run, for the message.

    Raises:
        UsageError: A trial's scene was demonstrated.
    """
    for trial in trials:
        if trial.scene_seed in trained_on.get(trial.task, ()):
            raise UsageError(
                f"{where}: its dataset holds the scene {trial.scene_seed} of {trial.task}, which evaluation seed "
                f"{trial.seed} would try; demonstrations belong below {SCENES_PER_SEED:,}: make them with another "
                "first_seed, or evaluate other --seeds"
            )
