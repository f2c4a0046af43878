"""Policies against each other on the same episodes, and against themselves with plans executed otherwise."""

from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations

from flowlab.benchmark.statistics import PairedComparison, Proportion, compare_pairs, share_of
from flowlab.benchmark.success import Tried, by_trial
from flowlab.config import Settings
from flowlab.evaluation.results import EpisodeResult, PolicyResult


class Comparison(Settings):
    """Two policies on the episodes that both tried."""

    first: str
    second: str
    over: str
    """A task, a difficulty, or ``all``."""
    tasks: int
    paired: PairedComparison


class ActionStepsComparison(Settings):
    """One policy when it executes more, or less, of its plans than it was trained to; on the same episodes."""

    label: str
    over: str
    """A task, a difficulty, or ``all``."""
    usual: int
    other: int
    """Steps of a plan that are executed."""
    usual_success: Proportion
    other_success: Proportion
    paired: PairedComparison


def compare_policies(tried: Mapping[str, Tried], scopes: Mapping[str, Sequence[str]]) -> Iterator[Comparison]:
    """Every two policies, over every scope in which both tried the same episodes."""
    for over, tasks in scopes.items():
        for first, second in combinations(tried, 2):
            both = [t for t in tried[first] if t.task in tasks and t in tried[second]]
            if both:
                yield Comparison(
                    first=first,
                    second=second,
                    over=over,
                    tasks=len({t.task for t in both}),
                    paired=compare_pairs((tried[first][t].success, tried[second][t].success) for t in both),
                )


def compare_action_steps(
    results: Sequence[PolicyResult], scopes: Mapping[str, Sequence[str]]
) -> Iterator[ActionStepsComparison]:
    """Every policy whose newest weights were evaluated with other numbers of executed steps too."""
    pairs: dict[tuple[str, int, int], list[tuple[EpisodeResult, EpisodeResult]]] = {}
    for r in results:
        for usual, other, of_result in _action_step_pairs(r):
            pairs.setdefault((r.label, usual, other), []).extend(of_result)
    for over, tasks in scopes.items():
        for (label, usual, other), of_label in pairs.items():
            if met := [(a.success, b.success) for a, b in of_label if a.task in tasks]:
                yield ActionStepsComparison(
                    label=label,
                    over=over,
                    usual=usual,
                    other=other,
                    usual_success=share_of(a for a, _ in met),
                    other_success=share_of(b for _, b in met),
                    paired=compare_pairs(met),
                )


def _action_step_pairs(
    result: PolicyResult,
) -> Iterator[tuple[int, int, list[tuple[EpisodeResult, EpisodeResult]]]]:
    """The usual and another number of steps, and the episodes that were tried with both."""
    usual = result.training.n_action_steps
    newest = {e.n_action_steps: e for e in result.evaluations if e.step == result.evaluations[-1].step}
    if usual not in newest:
        return
    mine = by_trial(newest[usual].outcomes)
    for other in sorted(newest.keys() - {usual}):
        theirs = by_trial(newest[other].outcomes)
        yield usual, other, [(mine[t], theirs[t]) for t in mine if t in theirs]
