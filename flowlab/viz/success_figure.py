"""How often policies succeed, as a picture: task by task, with intervals."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter

from flowlab.viz.plot_style import INK, QUIET, plain_style, policy_colors, save_png, style_axes
from flowlab.viz.row_chart import (
    AXIS_IN,
    HEADING_IN,
    MARGIN_IN,
    add_axes,
    each_mark,
    lay_out_rows,
    line_handles,
    percent,
    row_height,
    titled_figure,
    width_of,
)

_PLOT_IN, _WIDE_IN = 3.3, 3.9
_PITCH_IN = 0.105
_ONE_COLUMN = 16
"""More rows than so many are set in two columns."""
_MEAN = "mean of tasks"


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


def draw_success(panels: Sequence[SuccessPanel], labels: Sequence[str], png: Path) -> None:
    """Write a PNG of :func:`plot_success`; ``png`` is either as before, or whole."""
    save_png(plot_success(panels, labels), png)


@plain_style()
def plot_success(panels: Sequence[SuccessPanel], labels: Sequence[str]) -> Figure:
    """Policies side by side in every task: a dot, its interval, and a diamond for what the paper reports."""
    colors = policy_colors(labels)
    columns = _split(panels)
    plot = _PLOT_IN if len(columns) > 1 else _WIDE_IN
    names = width_of(task for panel in panels for task in _rows(panel))
    heights = [sum(map(_panel_height, column)) for column in columns]
    drawn = [m for p in panels for marks in (*p.rows.values(), p.mean) for m in marks.values()]
    diamond = Line2D([], [], color=QUIET, marker="D", markersize=4, markerfacecolor="white", linestyle="")
    handles = line_handles(colors) | ({"paper": diamond} if any(m.paper is not None for m in drawn) else {})
    figure, above = titled_figure("Episodes solved", handles, len(columns) * (names + plot + MARGIN_IN), max(heights))
    for k, column in enumerate(columns):
        top = above
        for panel in column:
            left = k * (names + plot + MARGIN_IN) + names
            size = (plot, _panel_height(panel) - HEADING_IN - AXIS_IN)
            _draw_panel(add_axes(figure, left, top + HEADING_IN, *size), panel, colors)
            top += _panel_height(panel)
    return figure


def _split(panels: Sequence[SuccessPanel]) -> list[Sequence[SuccessPanel]]:
    """One column, or two where rows are many, of heights as alike as can be."""
    if sum(len(p.rows) for p in panels) <= _ONE_COLUMN or len(panels) == 1:
        return [panels]
    heights = [_panel_height(p) for p in panels]
    cut = min(range(1, len(panels)), key=lambda k: max(sum(heights[:k]), sum(heights[k:])))
    return [panels[:cut], panels[cut:]]


def _rows(panel: SuccessPanel) -> dict[str, Mapping[str, Mark]]:
    """A panel's tasks, and below them their mean."""
    return {**panel.rows, **({_MEAN: panel.mean} if panel.mean else {})}


def _panel_height(panel: SuccessPanel) -> float:
    """Of a panel with heading and axis [in]."""
    return sum(row_height(marks, _PITCH_IN) for marks in _rows(panel).values()) + HEADING_IN + AXIS_IN


def _draw_panel(axes: Axes, panel: SuccessPanel, colors: Mapping[str, str]) -> None:
    """The tasks of a group, policy by policy."""
    rows = _rows(panel)
    style_axes(axes, panel.heading)
    places = lay_out_rows(axes, rows, _PITCH_IN)
    axes.set(xlim=(-0.02, 1.02), xticks=np.linspace(0, 1, 6))
    axes.xaxis.set_major_formatter(FuncFormatter(percent))
    for (label, mark), y in zip(each_mark(rows, list(colors)), places, strict=True):
        _draw_mark(axes, mark, y, colors[label])
    if panel.mean:
        axes.get_yticklabels()[-1].set(color=INK, fontweight="bold")


def _draw_mark(axes: Axes, mark: Mark, y: float, color: str) -> None:
    """A dot, its interval, and a diamond for the paper's number."""
    axes.plot([mark.low, mark.high], [y, y], color=color, linewidth=1.3, alpha=0.6, zorder=3, solid_capstyle="butt")
    axes.plot([mark.share], [y], color=color, marker="o", markersize=4.2, linestyle="", zorder=5, clip_on=False)
    if mark.paper is not None:
        axes.plot(
            [mark.paper], [y], marker="D", markersize=4, markerfacecolor="white", markeredgecolor=color,
            markeredgewidth=0.9, linestyle="", zorder=4, clip_on=False,
        )  # fmt: skip
