"""Success while training: a policy at each of its checkpoints."""

from collections.abc import Iterator

from flowlab.benchmark.ordering import sort_tasks
from flowlab.benchmark.statistics import Proportion, share_of
from flowlab.benchmark.success import by_trial
from flowlab.config import Settings
from flowlab.evaluation.results import PolicyResult


class CurvePoint(Settings):
    """One policy on one task, at one of its checkpoints."""

    label: str
    task: str
    step: int
    cpu_min: float
    """CPU time of training until then, if every step took the same [min]."""
    success: Proportion
    """Of the same episodes at every checkpoint, where all have some in common."""


def learning_curve(result: PolicyResult) -> Iterator[CurvePoint]:
    """The points of a policy whose earlier checkpoints were evaluated too, task by task."""
    usual = result.training.n_action_steps
    steps = {e.step: by_trial(e.outcomes) for e in result.evaluations if e.n_action_steps == usual and e.outcomes}
    if len(steps) < 2:
        return
    for task in sort_tasks({t.task for tried in steps.values() for t in tried}):
        here = {step: {t for t in tried if t.task == task} for step, tried in sorted(steps.items())}
        common = set.intersection(*(trials for trials in here.values() if trials))
        for step, trials in here.items():
            if trials:
                yield CurvePoint(
                    label=result.label,
                    task=task,
                    step=step,
                    cpu_min=round(result.training.cpu_s / 60 * step / result.training.steps, 3),
                    success=share_of(steps[step][t].success for t in common or trials),
                )
