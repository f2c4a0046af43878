"""How often policies succeed, as pictures: by task, over training time; and how well they foresaw motion."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, MaxNLocator

from flowlab.storage.files import temporary_path


@dataclass(frozen=True, slots=True)
class Mark:
    """A share of episodes solved, from 0 to 1, with its interval."""

    share: float
    low: float
    high: float
    paper: float | None = None
    """What the paper reports, if it does."""


@dataclass(frozen=True, slots=True)
class Panel:
    """The tasks of a group, below each other."""

    heading: str
    rows: Mapping[str, Mapping[str, Mark]]
    """By task, then by policy."""
    mean: Mapping[str, Mark]
    """Over the group, by policy; empty where one task is all."""


@dataclass(frozen=True, slots=True)
class Curve:
    """Success of a policy at its checkpoints, in order."""

    minutes: tuple[float, ...]
    """CPU minutes of training up to each."""
    marks: tuple[Mark, ...]


@dataclass(frozen=True, slots=True)
class Foreseen:
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
_INK, _QUIET, _GRID, _BAND, _ZERO = "#22262c", "#747b85", "#e6e8ec", "#f5f6f8", "#d3d6db"
_DPI = 150
_NAMES_IN, _PLOT_IN, _WIDE_IN, _MARGIN_IN = 1.75, 3.3, 4.9, 0.3
_HEAD_IN, _HEADING_IN, _AXIS_IN = 0.9, 0.42, 0.34
_ROW_IN, _POLICY_IN = 0.13, 0.105
_ONE_COLUMN = 16
"""More rows than so many are set in two columns."""
_MEAN = "mean of tasks"


def policy_colours(labels: Sequence[str]) -> dict[str, str]:
    """A colour for every policy; those of the paper always have the same."""
    further = (_FURTHER[k % len(_FURTHER)] for k in range(len(labels)))
    return {label: _KNOWN.get(label) or next(further) for label in labels}


def draw_success(panels: Sequence[Panel], labels: Sequence[str], png: Path) -> None:
    """Write a PNG of :func:`compose_success`; ``png`` is either as before, or whole."""
    _save(compose_success(panels, labels), png)


def draw_curves(curves: Mapping[str, Mapping[str, Curve]], labels: Sequence[str], png: Path) -> None:
    """Write a PNG of :func:`compose_curves`, likewise."""
    _save(compose_curves(curves, labels), png)


def draw_flow(errors: Mapping[str, Mapping[str, Foreseen]], labels: Sequence[str], png: Path) -> None:
    """Write a PNG of :func:`compose_flow`, likewise."""
    _save(compose_flow(errors, labels), png)


def compose_success(panels: Sequence[Panel], labels: Sequence[str]) -> Figure:
    """Policies side by side in every task: a dot, its interval, and a diamond for what the paper reports."""
    colours = policy_colours(labels)
    row = _ROW_IN + _POLICY_IN * len(labels)
    columns = _split(panels)
    plot = _PLOT_IN if len(columns) > 1 else _WIDE_IN
    heights = [sum(_panel_height(p, row) for p in column) for column in columns]
    figure = _figure(len(columns) * (_NAMES_IN + plot + _MARGIN_IN), _HEAD_IN + max(heights))
    for k, column in enumerate(columns):
        top = _HEAD_IN
        for panel in column:
            left = k * (_NAMES_IN + plot + _MARGIN_IN) + _NAMES_IN
            size = (plot, _panel_height(panel, row) - _HEADING_IN - _AXIS_IN)
            _draw_panel(_axes(figure, left, top + _HEADING_IN, *size), panel, colours)
            top += _panel_height(panel, row)
    drawn = [m for p in panels for marks in (*p.rows.values(), p.mean) for m in marks.values()]
    diamond = Line2D([], [], color=_QUIET, marker="D", markersize=4, markerfacecolor="white", linestyle="")
    more = {"paper": diamond} if any(m.paper is not None for m in drawn) else {}
    _write_head(figure, "Episodes solved", _handles(colours) | more)
    return figure


def compose_curves(curves: Mapping[str, Mapping[str, Curve]], labels: Sequence[str]) -> Figure:
    """Success over CPU minutes of training: a panel for each task, a line with its interval for each policy."""
    colours = policy_colours(labels)
    across = min(len(curves), 3)
    down = -(-len(curves) // across)
    width, height = 3.1, 2.75
    figure = _figure(max(across * width + _MARGIN_IN, 4.2), _HEAD_IN + down * height)
    last = max(m for of_task in curves.values() for c in of_task.values() for m in c.minutes)
    for k, (task, of_task) in enumerate(curves.items()):
        left, top = (k % across) * width + 0.6, _HEAD_IN + (k // across) * height + _HEADING_IN
        axes = _axes(figure, left, top, width - 0.65, height - _HEADING_IN - 0.55)
        for label in (x for x in labels if x in of_task):
            _draw_curve(axes, of_task[label], colours[label])
        axes.set(xlim=(0, 1.03 * last), ylim=(-0.03, 1.03), yticks=np.linspace(0, 1, 6))
        axes.xaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
        axes.yaxis.set_major_formatter(FuncFormatter(_percent))
        if k + across >= len(curves):
            axes.set_xlabel("CPU minutes of training", color=_QUIET, fontsize=9)
        _dress(axes, task)
    shown = {x: c for x, c in colours.items() if any(x in of_task for of_task in curves.values())}
    _write_head(figure, "Episodes solved while training", _handles(shown))
    return figure


def compose_flow(errors: Mapping[str, Mapping[str, Foreseen]], labels: Sequence[str]) -> Figure:
    """Errors of predicted flow: a bar for each policy, before a pale one of predicting no motion on its episodes."""
    shown = [x for x in labels if any(x in of_task for of_task in errors.values())]
    colours = {x: c for x, c in policy_colours(labels).items() if x in shown}
    row = _ROW_IN + 0.15 * len(shown)
    plot = 2.9
    figure = _figure(_NAMES_IN + 2 * (plot + _MARGIN_IN), _HEAD_IN + _HEADING_IN + row * len(errors) + 0.55)
    for k, (name, heading) in enumerate((("ade", "mean error"), ("fde", "error at the last step"))):
        left = _NAMES_IN + k * (plot + _MARGIN_IN)
        axes = _axes(figure, left, _HEAD_IN + _HEADING_IN, plot, row * len(errors))
        _dress(axes, f"{heading} [mm]")
        _lay_rows(axes, list(errors) if k == 0 else [""] * len(errors), len(shown))
        for y, of_task in enumerate(errors.values()):
            for label, offset in zip(shown, _offsets(len(shown)), strict=True):
                if label in of_task:
                    e, wide = of_task[label], 0.62 / len(shown)
                    axes.barh(y + offset, getattr(e, f"zero_{name}"), 1.25 * wide, color=_ZERO, zorder=2)
                    axes.barh(y + offset, getattr(e, name), 0.75 * wide, color=colours[label], zorder=3)
        axes.set_xlim(0, None)
        axes.xaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
    handles = {label: Patch(color=colour) for label, colour in colours.items()} | {"no motion": Patch(color=_ZERO)}
    _write_head(figure, "Predicted flow of moving points", handles)
    return figure


def _split(panels: Sequence[Panel]) -> list[Sequence[Panel]]:
    """One column, or two where rows are many, of heights as alike as can be."""
    rows = [len(p.rows) + bool(p.mean) + 3 for p in panels]
    if sum(len(p.rows) for p in panels) <= _ONE_COLUMN or len(panels) == 1:
        return [panels]
    cut = min(range(1, len(panels)), key=lambda k: max(sum(rows[:k]), sum(rows[k:])))
    return [panels[:cut], panels[cut:]]


def _panel_height(panel: Panel, row: float) -> float:
    return row * (len(panel.rows) + bool(panel.mean)) + _HEADING_IN + _AXIS_IN


def _draw_panel(axes: Axes, panel: Panel, colours: Mapping[str, str]) -> None:
    rows = {**panel.rows, **({_MEAN: panel.mean} if panel.mean else {})}
    _dress(axes, panel.heading)
    _lay_rows(axes, list(rows), len(colours))
    axes.set(xlim=(-0.02, 1.02), xticks=np.linspace(0, 1, 6))
    axes.xaxis.set_major_formatter(FuncFormatter(_percent))
    for y, marks in enumerate(rows.values()):
        for (label, colour), offset in zip(colours.items(), _offsets(len(colours)), strict=True):
            if label in marks:
                _draw_mark(axes, marks[label], y + offset, colour)
    if panel.mean:
        axes.get_yticklabels()[-1].set(color=_INK, fontweight="bold")


def _draw_mark(axes: Axes, mark: Mark, y: float, colour: str) -> None:
    axes.plot([mark.low, mark.high], [y, y], color=colour, linewidth=1.3, alpha=0.6, zorder=3, solid_capstyle="butt")
    axes.plot([mark.share], [y], color=colour, marker="o", markersize=4.2, linestyle="", zorder=5, clip_on=False)
    if mark.paper is not None:
        axes.plot(
            [mark.paper], [y], marker="D", markersize=4, markerfacecolor="white", markeredgecolor=colour,
            markeredgewidth=0.9, linestyle="", zorder=4, clip_on=False,
        )  # fmt: skip


def _draw_curve(axes: Axes, curve: Curve, colour: str) -> None:
    low, high = ([getattr(m, name) for m in curve.marks] for name in ("low", "high"))
    axes.fill_between(curve.minutes, low, high, color=colour, alpha=0.13, linewidth=0, zorder=2)
    axes.plot(
        curve.minutes, [m.share for m in curve.marks], color=colour, linewidth=1.8, marker="o", markersize=3.8,
        zorder=4, clip_on=False,
    )  # fmt: skip


def _offsets(count: int) -> list[float]:
    """Where in its row each policy is, as a share of the row."""
    step = 0.78 / count
    return [(k - (count - 1) / 2) * step for k in range(count)]


def _lay_rows(axes: Axes, names: Sequence[str], policies: int) -> None:
    """A row for each name, the first on top; every other row is shaded."""
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.set_yticks(range(len(names)), names)
    axes.tick_params(axis="y", labelsize=9 if policies > 1 else 8.5, labelcolor=_INK, pad=6)
    axes.grid(visible=False, axis="y")
    for y in range(0, len(names), 2):
        axes.axhspan(y - 0.5, y + 0.5, color=_BAND, linewidth=0, zorder=0)


def _figure(width: float, height: float) -> Figure:
    figure = Figure(figsize=(width, height), dpi=_DPI)
    FigureCanvasAgg(figure)
    return figure


def _axes(figure: Figure, left: float, top: float, width: float, height: float) -> Axes:
    """Axes by their place in inches from the upper left corner."""
    across, down = figure.get_size_inches()
    return figure.add_axes((left / across, 1 - (top + height) / down, width / across, height / down))


def _handles(colours: Mapping[str, str]) -> dict[str, Line2D | Patch]:
    return {
        label: Line2D([], [], color=colour, marker="o", markersize=5, linewidth=1.6)
        for label, colour in colours.items()
    }


def _write_head(figure: Figure, title: str, handles: Mapping[str, Line2D | Patch]) -> None:
    """The title, and what colours mean, in lines that fit the figure's width."""
    width, height = figure.get_size_inches()
    figure.text(0.15 / width, 1 - 0.28 / height, title, fontsize=14, weight="bold", color=_INK, va="center")
    figure.legend(
        handles.values(), handles.keys(), loc="upper left", bbox_to_anchor=(0.08 / width, 1 - 0.46 / height),
        ncols=min(len(handles), max(int(width / 1.25), 1)), frameon=False, fontsize=9, labelcolor=_INK,
        handlelength=1.4, columnspacing=1.4, handletextpad=0.6, borderpad=0.2, borderaxespad=0,
    )  # fmt: skip


def _percent(share: float, _: object = None) -> str:
    return f"{100 * share:.0f} %"


def _dress(axes: Axes, heading: str) -> None:
    axes.grid(color=_GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.tick_params(length=0, which="both", labelsize=8.5, labelcolor=_QUIET)
    for spine in axes.spines.values():
        spine.set_visible(False)
    axes.set_title(heading, loc="left", fontsize=10.5, color=_INK, pad=8)


def _save(figure: Figure, png: Path) -> None:
    temporary = temporary_path(png)
    png.parent.mkdir(parents=True, exist_ok=True)
    try:
        figure.savefig(temporary, format="png", facecolor="white", metadata={"Software": None})
        os.replace(temporary, png)
    finally:
        temporary.unlink(missing_ok=True)
