"""Results in numbers: all that a report's tables and figures show."""

from collections.abc import Iterator, Sequence
from typing import Any

from pydantic import Field

from flowlab.benchmark.comparison import ActionStepsComparison, Comparison, compare_action_steps, compare_policies
from flowlab.benchmark.flow_accuracy import FlowAccuracy, flow_accuracies
from flowlab.benchmark.learning_curve import CurvePoint, learning_curve
from flowlab.benchmark.ordering import disambiguate, result_order, scopes_of, sort_tasks
from flowlab.benchmark.paper_comparison import ComparedTable, compare_with_paper
from flowlab.benchmark.success import GroupSuccess, TaskSuccess, by_trial, group_successes, task_successes
from flowlab.config import Settings
from flowlab.evaluation.results import EpisodeResult, PolicyResult, TrainingRecord
from flowlab.evaluation.trials import Trial


class NamedTraining(Settings):
    """How the policy of one result came about."""

    name: str
    label: str
    tasks: tuple[str, ...]
    training: TrainingRecord


class AbortedEpisode(Settings):
    """An episode that could not go on."""

    label: str
    trial: Trial
    step: int
    """Training steps that the weights had seen."""
    n_action_steps: int
    note: str
    """What happened."""


class Summary(Settings):
    """Everything, each table in the order of labels and tasks."""

    labels: tuple[str, ...]
    tasks: tuple[str, ...]
    seeds: tuple[int, ...]
    episodes: int
    """Evaluated with the newest weights, over all policies."""
    successes: tuple[TaskSuccess, ...]
    groups: tuple[GroupSuccess, ...]
    comparisons: tuple[Comparison, ...]
    flow: tuple[FlowAccuracy, ...]
    curves: tuple[CurvePoint, ...]
    action_steps: tuple[ActionStepsComparison, ...] = Field(serialization_alias="strides")
    training: tuple[NamedTraining, ...]
    aborted: tuple[AbortedEpisode, ...] = Field(serialization_alias="broken")
    paper: tuple[ComparedTable, ...]
    """The paper's tables in which there is a number of ours, with both."""

    def to_json(self) -> dict[str, Any]:
        """JSON values, under the keys that ``report.json`` has."""
        return self.model_dump(mode="json", by_alias=True)


def summarize(results: Sequence[PolicyResult]) -> Summary:
    """All numbers of a report; the order of results does not matter.

    Results that share a label and a task are told apart by their names.

    Raises:
        DataError: These do not differ either.
    """
    results = sorted(disambiguate(results), key=result_order)
    tried: dict[str, dict[Trial, EpisodeResult]] = {}
    for r in results:
        tried.setdefault(r.label, {}).update(by_trial(r.final if r.evaluations else ()))
    outcomes = [o for of_label in tried.values() for o in of_label.values()]
    tasks = sort_tasks({o.task for o in outcomes})
    scopes = scopes_of(tasks)
    successes = tuple(task_successes(tried, tasks))
    groups = tuple(group_successes(successes, tried, scopes))
    return Summary(
        labels=tuple(tried),
        tasks=tasks,
        seeds=tuple(sorted({o.seed for o in outcomes})),
        episodes=len(outcomes),
        successes=successes,
        groups=groups,
        comparisons=tuple(compare_policies(tried, scopes)),
        flow=tuple(flow_accuracies(tried, scopes)),
        curves=tuple(point for r in results for point in learning_curve(r)),
        action_steps=tuple(compare_action_steps(results, scopes)),
        training=tuple(NamedTraining(name=r.name, label=r.label, tasks=r.tasks, training=r.training) for r in results),
        aborted=tuple(_aborted(results)),
        paper=tuple(compare_with_paper(successes, groups)),
    )


def _aborted(results: Sequence[PolicyResult]) -> Iterator[AbortedEpisode]:
    """Every episode of any checkpoint that could not go on."""
    for r in results:
        for e in r.evaluations:
            for o in by_trial(e.outcomes).values():
                if o.note:
                    yield AbortedEpisode(
                        label=r.label, trial=o.trial, step=e.step, n_action_steps=e.n_action_steps, note=o.note
                    )
