"""How often policies succeed, as pictures: by task, over training time; and how well they foresaw motion."""

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, MaxNLocator

from flowlab.files import temporary_path
from flowlab.viz.curve_figure import style_axes


@dataclass(frozen=True, slots=True)
class Mark:
    """A share of episodes solved, from 0 to 1, with its interval."""

    share: float
    low: float
    high: float
    paper: float | None = None
    """What the paper reports, if it does."""


@dataclass(frozen=True, slots=True)
class SuccessPanel:
    """The tasks of a group, below each other."""

    heading: str
    rows: Mapping[str, Mapping[str, Mark]]
    """By task, then by policy."""
    mean: Mapping[str, Mark]
    """Over all of these tasks, by policy; empty where one task is all."""


@dataclass(frozen=True, slots=True)
class LearningCurve:
    """Success of a policy at its checkpoints, in order."""

    minutes: tuple[float, ...]
    """CPU minutes of training up to each."""
    marks: tuple[Mark, ...]


@dataclass(frozen=True, slots=True)
class FlowBars:
    """Errors of predicted flow [mm] beside those of predicting no motion."""

    ade: float
    zero_ade: float
    fde: float
    zero_fde: float


_KNOWN = {
    "dp3": "#e07b1a", "mba": "#2f9e6e", "fdp": "#2a6fbb", "fdp-m50": "#86b4e3", "fdp-m200": "#173f73",
    "fdp-object": "#7b5bb8", "fdp-stratified": "#b8438a", "fdp-auxiliary": "#8a7a5c",
}  # fmt: skip
_FURTHER = ("#c2453d", "#2a9aa8", "#6b7a2e", "#a05a2c", "#5b6ee0", "#4a4f57")
_INK, _QUIET, _BAND, _ZERO = "#22262c", "#747b85", "#f5f6f8", "#d3d6db"
DPI = 150
"""Of the pictures."""
_PLOT_IN, _WIDE_IN, _MARGIN_IN, _LETTER_IN = 3.3, 3.9, 0.3, 0.074
_TITLE_IN, _LEGEND_IN, _HEADING_IN, _AXIS_IN = 0.5, 0.22, 0.42, 0.34
_ROW_IN, _POLICY_IN = 0.13, 0.105
_ONE_COLUMN = 16
"""More rows than so many are set in two columns."""
_FEW_CURVES = 12
_MEAN = "mean of tasks"
_Drawn = TypeVar("_Drawn")


def policy_colors(labels: Sequence[str]) -> dict[str, str]:
    """A color for every policy; those of the paper always have the same."""
    further = (_FURTHER[k % len(_FURTHER)] for k in range(len(labels)))
    return {label: _KNOWN.get(label) or next(further) for label in labels}


def draw_success(panels: Sequence[SuccessPanel], labels: Sequence[str], png: Path) -> None:
    """Write a PNG of :func:`compose_success`; ``png`` is either as before, or whole."""
    _save(compose_success(panels, labels), png)


def draw_curves(curves: Mapping[str, Mapping[str, LearningCurve]], labels: Sequence[str], png: Path) -> None:
    """Write a PNG of :func:`compose_curves`, likewise."""
    _save(compose_curves(curves, labels), png)


def draw_flow(errors: Mapping[str, Mapping[str, FlowBars]], labels: Sequence[str], png: Path) -> None:
    """Write a PNG of :func:`compose_flow`, likewise."""
    _save(compose_flow(errors, labels), png)


def compose_success(panels: Sequence[SuccessPanel], labels: Sequence[str]) -> Figure:
    """Policies side by side in every task: a dot, its interval, and a diamond for what the paper reports."""
    colors = policy_colors(labels)
    columns = _split(panels)
    plot = _PLOT_IN if len(columns) > 1 else _WIDE_IN
    names = _width_of(task for panel in panels for task in _rows(panel))
    heights = [sum(map(_panel_height, column)) for column in columns]
    drawn = [m for p in panels for marks in (*p.rows.values(), p.mean) for m in marks.values()]
    diamond = Line2D([], [], color=_QUIET, marker="D", markersize=4, markerfacecolor="white", linestyle="")
    handles = _handles(colors) | ({"paper": diamond} if any(m.paper is not None for m in drawn) else {})
    figure, head = _figure("Episodes solved", handles, len(columns) * (names + plot + _MARGIN_IN), max(heights))
    for k, column in enumerate(columns):
        top = head
        for panel in column:
            left = k * (names + plot + _MARGIN_IN) + names
            size = (plot, _panel_height(panel) - _HEADING_IN - _AXIS_IN)
            _draw_panel(_axes(figure, left, top + _HEADING_IN, *size), panel, colors)
            top += _panel_height(panel)
    return figure


def compose_curves(curves: Mapping[str, Mapping[str, LearningCurve]], labels: Sequence[str]) -> Figure:
    """Success over CPU minutes of training: a panel for each task, a line with its interval for each policy."""
    colors = {x: c for x, c in policy_colors(labels).items() if any(x in of_task for of_task in curves.values())}
    across = min(len(curves), 3 if len(curves) <= _FEW_CURVES else 4)
    down = -(-len(curves) // across)
    width, height = 3.1, 2.5
    size = max(across * width + _MARGIN_IN, 4.2), down * height
    figure, head = _figure("Episodes solved while training", _handles(colors), *size)
    last = max(m for of_task in curves.values() for c in of_task.values() for m in c.minutes)
    for k, (task, of_task) in enumerate(curves.items()):
        left, top = (k % across) * width + 0.6, head + (k // across) * height + _HEADING_IN
        axes = _axes(figure, left, top, width - 0.65, height - _HEADING_IN - 0.5)
        for label, curve in sorted(of_task.items(), key=lambda item: labels.index(item[0])):
            _draw_curve(axes, curve, colors[label])
        axes.set(xlim=(0, 1.03 * last), ylim=(-0.03, 1.03), yticks=np.linspace(0, 1, 6))
        axes.xaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
        axes.yaxis.set_major_formatter(FuncFormatter(_percent))
        if k + across >= len(curves):
            axes.set_xlabel("CPU minutes of training", color=_QUIET, fontsize=9)
        style_axes(axes, task)
    return figure


def compose_flow(errors: Mapping[str, Mapping[str, FlowBars]], labels: Sequence[str]) -> Figure:
    """Errors of predicted flow: a bar for each policy, before a pale one of predicting no motion on its episodes."""
    colors = {x: c for x, c in policy_colors(labels).items() if any(x in of_task for of_task in errors.values())}
    handles = {label: Patch(color=color) for label, color in colors.items()} | {"no motion": Patch(color=_ZERO)}
    names, plot, lane = _width_of(errors), 2.9, 0.15
    tall = sum(_row_height(of_task, lane) for of_task in errors.values())
    size = names + 2 * (plot + _MARGIN_IN), _HEADING_IN + tall + _AXIS_IN
    figure, head = _figure("Predicted flow of moving points", handles, *size)
    for k, (name, heading) in enumerate((("ade", "mean error"), ("fde", "error at the last step"))):
        left = names + k * (plot + _MARGIN_IN)
        axes = _axes(figure, left, head + _HEADING_IN, plot, tall)
        style_axes(axes, f"{heading} [mm]")
        for (_, label, e), y in zip(_each(errors, labels), _lay_rows(axes, errors, lane, named=k == 0), strict=True):
            axes.barh(y, getattr(e, f"zero_{name}"), 0.8 * lane, color=_ZERO, zorder=2)
            axes.barh(y, getattr(e, name), 0.45 * lane, color=colors[label], zorder=3)
        axes.set_xlim(0, None)
        axes.xaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
    return figure


def _width_of(names: Iterable[str]) -> float:
    """Room for the longest name, a gap, and no less than a column of figures looks well with [in]."""
    return max(_LETTER_IN * max(map(len, names)) + 0.2, 0.9)


def _split(panels: Sequence[SuccessPanel]) -> list[Sequence[SuccessPanel]]:
    """One column, or two where rows are many, of heights as alike as can be."""
    if sum(len(p.rows) for p in panels) <= _ONE_COLUMN or len(panels) == 1:
        return [panels]
    heights = [_panel_height(p) for p in panels]
    cut = min(range(1, len(panels)), key=lambda k: max(sum(heights[:k]), sum(heights[k:])))
    return [panels[:cut], panels[cut:]]


def _rows(panel: SuccessPanel) -> dict[str, Mapping[str, Mark]]:
    return {**panel.rows, **({_MEAN: panel.mean} if panel.mean else {})}


def _panel_height(panel: SuccessPanel) -> float:
    return sum(_row_height(marks, _POLICY_IN) for marks in _rows(panel).values()) + _HEADING_IN + _AXIS_IN


def _row_height(policies: Mapping[str, object], lane: float) -> float:
    """Of a task that these policies tried [in]."""
    return _ROW_IN + lane * len(policies)


def _draw_panel(axes: Axes, panel: SuccessPanel, colors: Mapping[str, str]) -> None:
    rows = _rows(panel)
    style_axes(axes, panel.heading)
    places = _lay_rows(axes, rows, _POLICY_IN)
    axes.set(xlim=(-0.02, 1.02), xticks=np.linspace(0, 1, 6))
    axes.xaxis.set_major_formatter(FuncFormatter(_percent))
    for (_, label, mark), y in zip(_each(rows, list(colors)), places, strict=True):
        _draw_mark(axes, mark, y, colors[label])
    if panel.mean:
        axes.get_yticklabels()[-1].set(color=_INK, fontweight="bold")


def _each(rows: Mapping[str, Mapping[str, _Drawn]], labels: Sequence[str]) -> Iterator[tuple[str, str, _Drawn]]:
    """Row, policy and what is drawn of it, from top to bottom."""
    for name, of_row in rows.items():
        for label in labels:
            if label in of_row:
                yield name, label, of_row[label]


def _draw_mark(axes: Axes, mark: Mark, y: float, color: str) -> None:
    axes.plot([mark.low, mark.high], [y, y], color=color, linewidth=1.3, alpha=0.6, zorder=3, solid_capstyle="butt")
    axes.plot([mark.share], [y], color=color, marker="o", markersize=4.2, linestyle="", zorder=5, clip_on=False)
    if mark.paper is not None:
        axes.plot(
            [mark.paper], [y], marker="D", markersize=4, markerfacecolor="white", markeredgecolor=color,
            markeredgewidth=0.9, linestyle="", zorder=4, clip_on=False,
        )  # fmt: skip


def _draw_curve(axes: Axes, curve: LearningCurve, color: str) -> None:
    low, high = ([getattr(m, name) for m in curve.marks] for name in ("low", "high"))
    axes.fill_between(curve.minutes, low, high, color=color, alpha=0.13, linewidth=0, zorder=2)
    axes.plot(
        curve.minutes, [m.share for m in curve.marks], color=color, linewidth=1.8, marker="o", markersize=3.8,
        zorder=4, clip_on=False,
    )  # fmt: skip


def _lay_rows(axes: Axes, rows: Mapping[str, Mapping[str, object]], lane: float, *, named: bool = True) -> list[float]:
    """A row for each name, the first on top, every other one shaded; where each policy of each row is. The axis is in
    inches."""
    places, centers, top = [], [], 0.0
    for k, of_row in enumerate(rows.values()):
        height = _row_height(of_row, lane)
        places += [top + _ROW_IN / 2 + (j + 0.5) * lane for j in range(len(of_row))]
        centers.append(top + height / 2)
        if k % 2 == 0:
            axes.axhspan(top, top + height, color=_BAND, linewidth=0, zorder=0)
        top += height
    axes.set_ylim(top, 0)
    axes.set_yticks(centers, list(rows) if named else [""] * len(rows))
    axes.tick_params(axis="y", labelsize=9, labelcolor=_INK, pad=6)
    axes.grid(visible=False, axis="y")
    return places


def _figure(title: str, handles: Mapping[str, Line2D | Patch], width: float, height: float) -> tuple[Figure, float]:
    """A figure with room of this size [in] below its head, and the head's height: the title, and what colors mean."""
    columns = max(int(width / (_width_of(handles) + 0.3)), 1)
    head = _TITLE_IN + _LEGEND_IN * -(-len(handles) // columns)
    height += head
    figure = Figure(figsize=(width, height), dpi=DPI)
    FigureCanvasAgg(figure)
    figure.text(0.15 / width, 1 - 0.28 / height, title, fontsize=14, weight="bold", color=_INK, va="center")
    figure.legend(
        handles.values(), handles.keys(), loc="upper left", bbox_to_anchor=(0.13 / width, 1 - 0.48 / height),
        ncols=columns, frameon=False, fontsize=9, labelcolor=_INK, handlelength=1.4, columnspacing=1.4,
        handletextpad=0.6, borderpad=0, borderaxespad=0,
    )  # fmt: skip
    return figure, head


def _axes(figure: Figure, left: float, top: float, width: float, height: float) -> Axes:
    """Axes by their place in inches from the upper left corner."""
    across, down = figure.get_size_inches()
    return figure.add_axes((left / across, 1 - (top + height) / down, width / across, height / down))


def _handles(colors: Mapping[str, str]) -> dict[str, Line2D | Patch]:
    return {
        label: Line2D([], [], color=color, marker="o", markersize=5, linewidth=1.6) for label, color in colors.items()
    }


def _percent(share: float, _: object = None) -> str:
    return f"{100 * share:.0f} %"


def _save(figure: Figure, png: Path) -> None:
    temporary = temporary_path(png)
    png.parent.mkdir(parents=True, exist_ok=True)
    try:
        figure.savefig(temporary, format="png", facecolor="white", metadata={"Software": None})
        os.replace(temporary, png)
    finally:
        temporary.unlink(missing_ok=True)
