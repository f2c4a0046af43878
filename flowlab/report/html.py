"""A report of evaluations: one page to read, and the numbers behind it as JSON and CSV."""

import base64
import csv
import io
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from jinja2 import Environment, StrictUndefined

from flowlab.benchmark.paper import CURVE_TASKS, compare_with_paper, differences, paper_share
from flowlab.benchmark.results import PolicyResult, TrainingRecord
from flowlab.benchmark.statistics import Proportion
from flowlab.benchmark.summary import ALL, GroupSuccess, Summary, disambiguate, summarize
from flowlab.errors import DataError
from flowlab.evaluation.trials import RolloutFlowError
from flowlab.files import write_atomically, write_json
from flowlab.version import __version__
from flowlab.viz.success_figure import (
    DPI,
    FlowBars,
    LearningCurve,
    Mark,
    SuccessPanel,
    draw_curves,
    draw_flow,
    draw_success,
    policy_colors,
)

if TYPE_CHECKING:
    from flowlab.benchmark.robot_trials import RobotTrial

FIGURES = "figures"
_BASELINES = ("_zero", "_hold", "_constant")
"""Endings of held-out errors of what needs no training; the first is enough here."""
_Rows = Iterable[Sequence[object]]


def write_report(
    folder: Path, results: Sequence[PolicyResult], *, films: Sequence[Path] = (), scored: Sequence["RobotTrial"] = ()
) -> None:
    """Write ``report.html``, which holds its figures, and beside it ``report.json``, ``report.csv``, ``episodes.csv``
    and the figures as PNG. Each file is replaced in one step; the same results, in any order, give the same bytes.

    ``films`` are linked from the page. ``scored`` are trials on a robot that somebody scored. Raises
    :class:`DataError` where there are neither results nor such trials.
    """
    if not results and not scored:
        raise DataError("there is nothing to report; evaluate a policy first, with: flowlab eval RUN")
    summary = summarize(results)
    by_hand = _scored_tables(scored)
    folder.mkdir(parents=True, exist_ok=True)
    figures = draw_figures(folder / FIGURES, summary)
    values = {
        "flowlab": __version__,
        "summary": summary.model_dump(mode="json"),
        "paper": [table.model_dump(mode="json") for table in compare_with_paper(summary)],
        "scored": [{"title": title, "columns": columns, "rows": rows} for title, columns, rows in by_hand],
    }
    write_json(folder / "report.json", values)
    write_atomically(folder / "report.csv", _csv(_REPORT_COLUMNS, _report_rows(summary)))
    write_atomically(folder / "episodes.csv", _csv(_EPISODE_COLUMNS, _episode_rows(results)))
    links = [(film.name, quote(Path(os.path.relpath(film, folder)).as_posix())) for film in films]
    write_atomically(folder / "report.html", render(summary, figures, links, by_hand))


def draw_figures(folder: Path, summary: Summary) -> dict[str, Path]:
    """Draw what there is to draw, by the name of the figure; figures of an earlier report go."""
    success, curves, flow = success_panels(summary), _curves(summary), _prediction(summary)
    paths = {name: folder / f"{name}.png" for name in ("success", "curves", "flow")}
    if success:
        draw_success(success, summary.labels, paths["success"])
    if curves:
        draw_curves(curves, summary.labels, paths["curves"])
    if flow:
        draw_flow(flow, summary.labels, paths["flow"])
    drawn = {"success": bool(success), "curves": bool(curves), "flow": bool(flow)}
    for name, path in paths.items():
        if not drawn[name]:
            path.unlink(missing_ok=True)
    return {name: path for name, path in paths.items() if drawn[name]}


def render(
    summary: Summary,
    figures: Mapping[str, Path],
    films: Sequence[tuple[str, str]] = (),
    scored: Sequence[tuple[str, Sequence[str], _Rows]] = (),
) -> str:
    """The page, which needs no other file and no network. ``films`` are names and relative addresses."""
    environment = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=StrictUndefined)
    environment.filters |= {"percent": _percent, "p": _p_value, "number": _number, "short": _short}
    tables = compare_with_paper(summary)
    template = environment.from_string(files("flowlab.report").joinpath("report.html.j2").read_text("utf-8"))
    return template.render(
        s=summary,
        ALL=ALL,
        success=success_rows(summary),
        episodes_each=episodes_each(summary),
        held_out=held_out(summary),
        machines=sorted({_machine(f.training) for f in summary.training}),
        colors=policy_colors(summary.labels),
        paper=tables,
        curve_tasks=CURVE_TASKS,
        differences=differences(summary) if tables else [],
        figures={name: _Image.of(path.read_bytes()) for name, path in figures.items()},
        films=films,
        scored=scored,
        version=__version__,
    )


@dataclass(frozen=True, slots=True)
class _Image:
    """A figure within the page."""

    content: str
    width: int
    """On a screen, where lengths count 96 to the inch."""

    @classmethod
    def of(cls, png: bytes) -> "_Image":
        """A PNG has its width behind its signature and the name of the first chunk."""
        return cls(base64.b64encode(png).decode(), round(int.from_bytes(png[16:20]) * 96 / DPI))


@dataclass(frozen=True, slots=True)
class SuccessCell:
    """A policy's success in a row of the page's table."""

    share: float
    """Of a group, the mean over its tasks."""
    episodes: Proportion
    note: str
    best: bool
    """Highest of the row, among those of the same tasks."""


@dataclass(frozen=True, slots=True)
class SuccessRow:
    """A task, or the group that the tasks above it belong to."""

    name: str
    sums_up: bool
    cells: tuple[SuccessCell | None, ...]
    """By policy."""


def success_rows(summary: Summary) -> list[SuccessRow]:
    """Policies side by side: every task, after them their group where they are several, in the end all."""
    rows = []
    for group in dict.fromkeys(g.group for g in summary.groups):
        of_group = {g.label: g for g in summary.groups if g.group == group}
        tasks = list(dict.fromkeys(x.task for x in summary.successes if x.group == group))
        for task in tasks:
            on_task = {x.label: x.success for x in summary.successes if x.task == task}
            shares = {x: (s.share, s, "" if episodes_each(summary) else f"n {s.n}") for x, s in on_task.items()}
            rows.append(_row(summary, task, False, shares, set(shares)))
        if len(tasks) > 1 or (group == ALL and len(summary.tasks) > 1):
            most = max((g.tasks for g in of_group.values()), key=len)
            shares = {x: (g.task_mean, g.success, f"{len(g.tasks)} of {g.of} tasks") for x, g in of_group.items()}
            rows.append(_row(summary, group, True, shares, {x for x, g in of_group.items() if g.tasks == most}))
    return rows


def episodes_each(summary: Summary) -> int | None:
    """Episodes of each task and policy, if they are as many everywhere."""
    counts = {x.success.n for x in summary.successes}
    return counts.pop() if len(counts) == 1 else None


def _row(
    summary: Summary,
    name: str,
    sums_up: bool,
    shares: Mapping[str, tuple[float, Proportion, str]],
    comparable: set[str],
) -> SuccessRow:
    """A row in which the best of the comparable ones is marked, if they are not all the same."""
    found = {shares[label][0] for label in comparable}
    top = max(found) if len(found) > 1 else None
    cells = {
        x: SuccessCell(share, of, note, x in comparable and share == top) for x, (share, of, note) in shares.items()
    }
    return SuccessRow(name, sums_up, tuple(cells.get(label) for label in summary.labels))


def held_out(summary: Summary) -> dict[str, list[tuple[str, float, float | None]]]:
    """Errors on held-out demonstrations by the name of the result: each with that of predicting nothing."""
    return {
        fact.name: [
            (name, value, fact.training.held_out.get(f"{name}_zero"))
            for name, value in sorted(fact.training.held_out.items())
            if not name.endswith(_BASELINES)
        ]
        for fact in summary.training
    }


def _machine(training: TrainingRecord) -> str:
    versions = ", ".join(f"{name} {version}" for name, version in sorted(training.versions.items()))
    return f"{training.processor}: {versions}"


_REPORT_COLUMNS = (
    "label", "task", "difficulty", "successes", "episodes", "success", "low", "high", "successes_dp3", "success_dp3",
    "mean_steps_to_success", "broke_down", "training_steps", "training_cpu_s",
)  # fmt: skip


def _report_rows(summary: Summary) -> _Rows:
    trained = {(f.label, task): f.training for f in summary.training for task in f.tasks}
    for x in summary.successes:
        training = trained.get((x.label, x.task))
        about = (training.steps, training.cpu_s) if training else ("", "")
        s, d = x.success, x.success_dp3
        shares = (s.successes, s.n, round(s.share, 6), s.low, s.high, d.successes, round(d.share, 6))
        yield (x.label, x.task, x.group, *shares, x.mean_steps, x.broken, *about)


_FLOW_COLUMNS = tuple(RolloutFlowError.model_fields)
_EPISODE_COLUMNS = (
    "label", "result", "step", "n_action_steps", "task", "seed", "episode", "scene_seed", "success", "success_dp3", "steps",
    "note", *_FLOW_COLUMNS,
)  # fmt: skip


def _episode_rows(results: Sequence[PolicyResult]) -> _Rows:
    """Of all checkpoints, however many steps they executed."""
    for r in sorted(disambiguate(results), key=lambda r: r.name):
        for e in r.evaluations:
            for o in sorted(e.outcomes, key=lambda o: o.trial):
                flow = [None if o.flow is None else getattr(o.flow, name) for name in _FLOW_COLUMNS]
                yield (
                    r.label, r.name, e.step, e.n_action_steps, o.task, o.seed, o.episode, o.scene_seed, int(o.success),
                    int(o.success_dp3), o.steps, o.note, *flow,
                )  # fmt: skip


def _csv(columns: Sequence[str], rows: _Rows) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)
    return text.getvalue()


def _scored_tables(scored: Sequence["RobotTrial"]) -> list[tuple[str, list[str], list[list[Any]]]]:
    if not scored:
        return []
    from flowlab.benchmark.robot_trials import robot_trial_tables

    return [(title, list(columns), [list(row) for row in rows]) for title, columns, rows in robot_trial_tables(scored)]


def success_panels(summary: Summary) -> list[SuccessPanel]:
    """A panel for each difficulty, its mean beside what the paper has."""
    panels = []
    for group in dict.fromkeys(x.group for x in summary.successes):
        mine = [x for x in summary.successes if x.group == group]
        of_group = [g for g in summary.groups if g.group == group]
        tasks = dict.fromkeys(x.task for x in mine)
        rows = {t: {x.label: _mark(x.success, x.label, t) for x in mine if x.task == t} for t in tasks}
        means = {g.label: _mean_mark(g) for g in of_group if len(g.tasks) == len(tasks)}
        heading = f"{group} ({len(tasks)} of {of_group[0].of})"
        panels.append(SuccessPanel(heading, rows, means if len(tasks) > 1 else {}))
    return panels


def _mark(share: Proportion, label: str, over: str) -> Mark:
    return Mark(share.share, share.low, share.high, paper_share(label, over))


def _mean_mark(group: GroupSuccess) -> Mark:
    """With the paper's number only if ours is of the same tasks."""
    mark = _mark(group.success, group.label, group.group)
    return replace(mark, share=group.task_mean, paper=mark.paper if len(group.tasks) == group.of else None)


def _curves(summary: Summary) -> dict[str, dict[str, LearningCurve]]:
    curves: dict[str, dict[str, LearningCurve]] = {}
    for task in summary.tasks:
        for label in summary.labels:
            if points := [p for p in summary.curves if (p.task, p.label) == (task, label)]:
                marks = tuple(Mark(p.success.share, p.success.low, p.success.high) for p in points)
                curves.setdefault(task, {})[label] = LearningCurve(tuple(p.cpu_min for p in points), marks)
    return curves


def _prediction(summary: Summary) -> dict[str, dict[str, FlowBars]]:
    errors: dict[str, dict[str, FlowBars]] = {}
    for f in summary.flow:
        if f.over in summary.tasks and f.error.pairs:
            e = f.error
            errors.setdefault(f.over, {})[f.label] = FlowBars(e.ade_mm, e.zero_ade_mm, e.fde_mm, e.zero_fde_mm)
    return errors


def _percent(share: float, digits: int = 1) -> str:
    return f"{100 * share:.{digits}f}"


def _p_value(p: float) -> str:
    return "< 0.001" if p < 0.001 else f"{p:.3f}" if p < 0.1 else f"{p:.2f}"


def _number(value: float | None, digits: int = 1) -> str:
    """With narrow spaces between thousands, where no line breaks; a dash where there is none."""
    return "–" if value is None else f"{value:,.{digits}f}".replace(",", "\u202f")


def _short(value: float) -> str:
    return f"{value:.3g}"
