"""What is known of a training run at a glance."""

import os
from dataclasses import dataclass
from pathlib import Path

from flowlab.policies.run_config import read_run_config
from flowlab.policies.trained import RUN, TrainedPolicy, checkpoint_files, read_trained, step_of


@dataclass(frozen=True, slots=True)
class RunOverview:
    """A run, or what the Hub has of one, which does not tell how it went."""

    trained: TrainedPolicy
    step: int
    """Training steps behind its newest weights; 0 where there are none."""
    steps: int | None
    """That the run has in all; None where that is not known."""
    demonstrations: int | None
    """Trained on; None as above."""
    held_out: int | None


def run_overview(folder: Path) -> RunOverview:
    """What is known of a run.

    Args:
        folder: Of the run, or of a policy that was pulled.

    Returns:
        What its files say; no weights are read.

    Raises:
        DataError: It is no run, or is damaged.
    """
    trained = read_trained(folder)
    plan = read_run_config(folder) if os.path.lexists(folder / RUN) else None
    weights = checkpoint_files(folder)
    return RunOverview(
        trained=trained,
        step=step_of(weights[-1]) if weights else 0,
        steps=None if plan is None else plan.steps,
        demonstrations=None if plan is None else len(plan.train),
        held_out=None if plan is None else len(plan.held_out),
    )
