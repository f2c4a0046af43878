"""Results in numbers: all that a report's tables and figures show."""

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from statistics import fmean

from flowlab.benchmark.results import Evaluation, PolicyResult, TrainingRecord
from flowlab.benchmark.statistics import PairedComparison, Proportion, mcnemar, wilson
from flowlab.config import Settings
from flowlab.errors import DataError
from flowlab.evaluation.trials import EpisodeResult, RolloutFlowError, Trial
from flowlab.sim.tasks import GROUPS, TASKS

ALL = "all"
_DIGITS = 6
"""After the point: more would differ between machines."""
_FIRST = ("dp3", "mba", "fdp")
"""Labels that come before others, and their variants with them."""


class TaskSuccess(Settings):
    """One policy on one task."""

    label: str
    task: str
    group: str
    success: Proportion
    success_dp3: Proportion
    """As DP3's runner counts."""
    mean_steps: float | None
    """To success, over the episodes that have it."""
    broken: int
    """Episodes that broke down; they count as failed."""


class GroupSuccess(Settings):
    """One policy on those of a group's tasks that it tried."""

    label: str
    group: str
    """A difficulty, or ``all``."""
    tasks: tuple[str, ...]
    of: int
    """Tasks that the group has."""
    success: Proportion
    """Of all episodes."""
    success_dp3: Proportion
    task_mean: float
    """Mean of the tasks' shares: the paper's average."""
    task_mean_dp3: float
    mean_steps: float | None


class Comparison(Settings):
    """Two policies on the episodes that both tried."""

    first: str
    second: str
    over: str
    """A task, a difficulty, or ``all``."""
    tasks: int
    paired: PairedComparison


class FlowAccuracy(Settings):
    """Predicted flow of one policy."""

    label: str
    over: str
    """A task, a difficulty, or ``all``."""
    episodes: int
    """In which something moved."""
    error: RolloutFlowError
    """Over all of their moving points, and all that are still."""


class CurvePoint(Settings):
    """One policy on one task, at one of its checkpoints."""

    label: str
    task: str
    step: int
    cpu_min: float
    """CPU time of training until then, if every step took the same [min]."""
    success: Proportion
    """Of the same episodes at every checkpoint, where all have some in common."""


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


class TrainingFacts(Settings):
    """How one policy came about."""

    name: str
    label: str
    tasks: tuple[str, ...]
    training: TrainingRecord


class BrokenEpisode(Settings):
    """An episode that broke down."""

    label: str
    trial: Trial
    step: int
    n_action_steps: int
    note: str


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
    strides: tuple[ActionStepsComparison, ...]
    training: tuple[TrainingFacts, ...]
    broken: tuple[BrokenEpisode, ...]


_Tried = Mapping[Trial, EpisodeResult]


def summarize(results: Sequence[PolicyResult]) -> Summary:
    """All numbers of a report; the order of results does not matter.

    Results that share a label and a task are told apart by their names. Raises :class:`DataError` where these do not
    differ either.
    """
    results = sorted(disambiguate(results), key=_place)
    tried: dict[str, dict[Trial, EpisodeResult]] = {}
    for r in results:
        tried.setdefault(r.label, {}).update(_by_trial(r.final if r.evaluations else ()))
    outcomes = [o for of_label in tried.values() for o in of_label.values()]
    tasks = sort_tasks({o.task for o in outcomes})
    scopes = _scopes(tasks)
    single = [_on_task(x, t, found) for t in tasks for x in tried if (found := _among(tried[x], [t]))]
    return Summary(
        labels=tuple(tried),
        tasks=tasks,
        seeds=tuple(sorted({o.seed for o in outcomes})),
        episodes=len(outcomes),
        successes=tuple(single),
        groups=tuple(_groups(single, tried, scopes)),
        comparisons=tuple(_comparisons(tried, scopes)),
        flow=tuple(_foresight(tried, scopes)),
        curves=tuple(point for r in results for point in _curve(r)),
        strides=tuple(_strides(results, scopes)),
        training=tuple(TrainingFacts(name=r.name, label=r.label, tasks=r.tasks, training=r.training) for r in results),
        broken=tuple(_broken(results)),
    )


def disambiguate(results: Sequence[PolicyResult]) -> list[PolicyResult]:
    """The results, each with a label of its own among those that tried the same tasks."""
    met = Counter(key for r in results for key in _tasks_of(r))
    apart = [
        r.model_copy(update={"label": r.name}) if any(met[key] > 1 for key in _tasks_of(r)) else r for r in results
    ]
    for (label, task), count in Counter(key for r in apart for key in _tasks_of(r)).items():
        if count > 1:
            raise DataError(f"{count} results on {task} are all called {label}; rename all but one of them")
    return apart


def sort_tasks(tasks: Iterable[str]) -> tuple[str, ...]:
    """By difficulty, then by name."""
    return tuple(sorted(tasks, key=_place_of_task))


def group_of(task: str) -> str:
    """A task's difficulty."""
    return TASKS[task].difficulty if task in TASKS else "other"


def pool_flow(errors: Sequence[RolloutFlowError]) -> RolloutFlowError:
    """The error over the points of several episodes, each point and step as heavy as any other."""

    def mean(name: str, weight: str) -> float:
        total = sum(getattr(e, weight) for e in errors)
        return round(sum(getattr(e, name) * getattr(e, weight) for e in errors) / total, _DIGITS) if total else 0.0

    of_pairs = ("ade_mm", "zero_ade_mm", "apd", "zero_apd", "average_jaccard", "zero_average_jaccard")
    return RolloutFlowError(
        pairs=sum(e.pairs for e in errors),
        ends=sum(e.ends for e in errors),
        still_pairs=sum(e.still_pairs for e in errors),
        **{name: mean(name, "pairs") for name in of_pairs},
        **{name: mean(name, "ends") for name in ("fde_mm", "zero_fde_mm")},
        still_mm=mean("still_mm", "still_pairs"),
    )


def _place(result: PolicyResult) -> tuple[object, ...]:
    return *_place_of_label(result.label), [_place_of_task(t) for t in result.tasks], result.name


def _place_of_label(label: str) -> tuple[int, list[str | int]]:
    """Where a label comes: dp3, mba, fdp, the variants of each after it, 50 before 200; others last."""
    first = label.partition("-")[0]
    place = _FIRST.index(first) if first in _FIRST else len(_FIRST)
    parts = re.split(r"(\d+)", label)  # text and numbers in turn, so like meets like
    return place, [int(p) if k % 2 else p for k, p in enumerate(parts)]


def _place_of_task(task: str) -> tuple[int, str]:
    return list(TASKS).index(task) if task in TASKS else len(TASKS), task


def _tasks_of(result: PolicyResult) -> set[tuple[str, str]]:
    return {(result.label, o.task) for e in result.evaluations for o in e.outcomes}


def _by_trial(outcomes: Iterable[EpisodeResult]) -> dict[Trial, EpisodeResult]:
    return {o.trial: o for o in sorted(outcomes, key=lambda o: o.trial)}


def _among(outcomes: _Tried, tasks: Sequence[str]) -> list[EpisodeResult]:
    return [o for o in outcomes.values() if o.task in tasks]


def _scopes(tasks: Sequence[str]) -> dict[str, list[str]]:
    """Tasks of all, of each difficulty that has some, and each alone."""
    groups: dict[str, list[str]] = {}
    for task in tasks:
        groups.setdefault(group_of(task), []).append(task)
    return {ALL: list(tasks), **groups, **{t: [t] for t in tasks}}


def _share(solved: Iterable[bool]) -> Proportion:
    values = list(solved)
    share = wilson(sum(values), len(values))
    return replace(share, low=round(share.low, _DIGITS), high=round(share.high, _DIGITS))


def _compare(pairs: Iterable[tuple[bool, bool]]) -> PairedComparison:
    paired = mcnemar(pairs)
    return replace(paired, p_value=round(paired.p_value, _DIGITS + 4))


def _mean_steps(outcomes: Iterable[EpisodeResult]) -> float | None:
    steps = [o.steps for o in outcomes if o.success]
    return round(fmean(steps), 2) if steps else None


def _on_task(label: str, task: str, outcomes: Sequence[EpisodeResult]) -> TaskSuccess:
    return TaskSuccess(
        label=label,
        task=task,
        group=group_of(task),
        success=_share(o.success for o in outcomes),
        success_dp3=_share(o.success_dp3 for o in outcomes),
        mean_steps=_mean_steps(outcomes),
        broken=sum(bool(o.note) for o in outcomes),
    )


def _groups(
    single: Sequence[TaskSuccess], tried: Mapping[str, _Tried], scopes: Mapping[str, Sequence[str]]
) -> Iterable[GroupSuccess]:
    for group in (g for g in (*GROUPS, "other") if g in scopes):
        for label, of_label in tried.items():
            mine = [s for s in single if s.label == label and s.task in scopes[group]]
            if not mine:
                continue
            outcomes = _among(of_label, scopes[group])
            yield GroupSuccess(
                label=label,
                group=group,
                tasks=tuple(s.task for s in mine),
                of=len(GROUPS.get(group, scopes[group])),
                success=_share(o.success for o in outcomes),
                success_dp3=_share(o.success_dp3 for o in outcomes),
                task_mean=round(fmean(s.success.share for s in mine), _DIGITS),
                task_mean_dp3=round(fmean(s.success_dp3.share for s in mine), _DIGITS),
                mean_steps=_mean_steps(outcomes),
            )


def _comparisons(tried: Mapping[str, _Tried], scopes: Mapping[str, Sequence[str]]) -> Iterable[Comparison]:
    for over, tasks in scopes.items():
        for first, second in combinations(tried, 2):
            both = [t for t in tried[first] if t.task in tasks and t in tried[second]]
            if both:
                yield Comparison(
                    first=first,
                    second=second,
                    over=over,
                    tasks=len({t.task for t in both}),
                    paired=_compare((tried[first][t].success, tried[second][t].success) for t in both),
                )


def _foresight(tried: Mapping[str, _Tried], scopes: Mapping[str, Sequence[str]]) -> Iterable[FlowAccuracy]:
    for over, tasks in scopes.items():
        for label, of_label in tried.items():
            errors = [o.flow for o in _among(of_label, tasks) if o.flow is not None]
            if errors:
                yield FlowAccuracy(label=label, over=over, episodes=len(errors), error=pool_flow(errors))


def _curve(result: PolicyResult) -> Iterable[CurvePoint]:
    """Of a policy whose earlier checkpoints were evaluated too."""
    usual = result.training.settings["n_action_steps"]
    steps = {e.step: _by_trial(e.outcomes) for e in result.evaluations if e.n_action_steps == usual and e.outcomes}
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
                    success=_share(steps[step][t].success for t in common or trials),
                )


def _strides(results: Sequence[PolicyResult], scopes: Mapping[str, Sequence[str]]) -> Iterable[ActionStepsComparison]:
    pairs: dict[tuple[str, int, int], list[tuple[EpisodeResult, EpisodeResult]]] = {}
    for r in results:
        usual = r.training.settings["n_action_steps"]
        newest: dict[int, Evaluation] = {e.n_action_steps: e for e in r.evaluations if e.step == r.evaluations[-1].step}
        if usual not in newest:
            continue
        mine = _by_trial(newest[usual].outcomes)
        for other in sorted(newest.keys() - {usual}):
            theirs = _by_trial(newest[other].outcomes)
            pairs.setdefault((r.label, usual, other), []).extend((mine[t], theirs[t]) for t in mine if t in theirs)
    for over, tasks in scopes.items():
        for (label, usual, other), of_label in pairs.items():
            if met := [(a.success, b.success) for a, b in of_label if a.task in tasks]:
                yield ActionStepsComparison(
                    label=label,
                    over=over,
                    usual=usual,
                    other=other,
                    usual_success=_share(a for a, _ in met),
                    other_success=_share(b for _, b in met),
                    paired=_compare(met),
                )


def _broken(results: Sequence[PolicyResult]) -> Iterable[BrokenEpisode]:
    for r in results:
        for e in r.evaluations:
            for o in _by_trial(e.outcomes).values():
                if o.note:
                    yield BrokenEpisode(
                        label=r.label, trial=o.trial, step=e.step, n_action_steps=e.n_action_steps, note=o.note
                    )
