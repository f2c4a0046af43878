"""How many steps of its plans a policy had better execute: tried on layouts that nothing else is reported of."""

from collections.abc import Callable, Sequence
from dataclasses import replace

from flowlab.errors import UsageError
from flowlab.evaluation.checkpoints import CHOOSING, CheckpointRef
from flowlab.evaluation.results import CheckpointEvaluation, ExecutionChoice
from flowlab.evaluation.trials import MOST_SEEDS, Trial, list_trials

AUTO = "auto"
"""In place of a number of steps: choose one."""
CHOOSING_SEED = MOST_SEEDS - 1
"""Evaluation seed of the layouts on which it is chosen, and no other evaluation is made."""
_LAYOUTS = 20
"""Of every task."""
_TRIED = (2, 4, 8)
"""Steps, beside as many as the policy was trained to execute, as far as it plans ahead."""


def choose_execution(
    checkpoint: CheckpointRef,
    tasks: Sequence[str],
    evaluate: Callable[[Sequence[CheckpointRef], Sequence[Trial]], list[CheckpointEvaluation]],
) -> ExecutionChoice:
    """Try as many steps as the policy was trained to execute, and 2, 4 and 8.

    What is tried is kept in the run's folder, so that the same choice is made again at once.

    Args:
        checkpoint: Of the policy.
        tasks: On layouts of these.
        evaluate: Tries every trial with every checkpoint.
    """
    s = checkpoint.trained.policy.settings
    tried = sorted({s.n_action_steps, *(n for n in _TRIED if n <= s.horizon - s.n_obs_steps + 1)})
    trials = list_trials(tasks, (CHOOSING_SEED,), _LAYOUTS)
    found = evaluate([replace(checkpoint, n_action_steps=n, folder=CHOOSING) for n in tried], trials)
    solved = {n: sum(o.success for o in e.outcomes) for n, e in zip(tried, found, strict=True)}
    return ExecutionChoice(solved=solved, of=len(trials))


def check_not_choosing(seeds: Sequence[int]) -> None:
    """Refuse to report layouts on which a choice was made: of several, the luckiest would be reported."""
    if CHOOSING_SEED in seeds:
        raise UsageError(
            f"seed {CHOOSING_SEED}: its layouts are those on which --execute {AUTO} chooses; evaluate others"
        )
