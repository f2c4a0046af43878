"""Success over training time, as a picture: a panel for each task."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator

from flowlab.viz.plot_style import QUIET, plain_style, policy_colors, save_png, style_axes
from flowlab.viz.row_chart import HEADING_IN, MARGIN_IN, add_axes, line_handles, percent, titled_figure
from flowlab.viz.success_figure import Mark

_FEW_CURVES = 12


@dataclass(frozen=True, slots=True)
class LearningCurve:
    """Success of a policy at its checkpoints, in order."""

    minutes: tuple[float, ...]
    """CPU minutes of training up to each."""
    marks: tuple[Mark, ...]


def draw_learning_curves(curves: Mapping[str, Mapping[str, LearningCurve]], labels: Sequence[str], png: Path) -> None:
    """Write a PNG of :func:`plot_learning_curves`; ``png`` is either as before, or whole."""
    save_png(plot_learning_curves(curves, labels), png)


@plain_style()
def plot_learning_curves(curves: Mapping[str, Mapping[str, LearningCurve]], labels: Sequence[str]) -> Figure:
    """Success over CPU minutes of training: a panel for each task, a line with its interval for each policy."""
    colors = {x: c for x, c in policy_colors(labels).items() if any(x in of_task for of_task in curves.values())}
    across = min(len(curves), 3 if len(curves) <= _FEW_CURVES else 4)
    down = -(-len(curves) // across)
    width, height = 3.1, 2.5
    size = max(across * width + MARGIN_IN, 4.2), down * height
    figure, above = titled_figure("Episodes solved while training", line_handles(colors), *size)
    last = max(m for of_task in curves.values() for c in of_task.values() for m in c.minutes)
    for k, (task, of_task) in enumerate(curves.items()):
        left, top = (k % across) * width + 0.6, above + (k // across) * height + HEADING_IN
        axes = add_axes(figure, left, top, width - 0.65, height - HEADING_IN - 0.5)
        for label, curve in sorted(of_task.items(), key=lambda item: labels.index(item[0])):
            _draw_curve(axes, curve, colors[label])
        axes.set(xlim=(0, 1.03 * last), ylim=(-0.03, 1.03), yticks=np.linspace(0, 1, 6))
        axes.xaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
        axes.yaxis.set_major_formatter(FuncFormatter(percent))
        if k + across >= len(curves):
            axes.set_xlabel("CPU minutes of training", color=QUIET, fontsize=9)
        style_axes(axes, task)
    return figure


def _draw_curve(axes: Axes, curve: LearningCurve, color: str) -> None:
    """One policy's success at its checkpoints, with a band for the interval."""
    low, high = ([getattr(m, name) for m in curve.marks] for name in ("low", "high"))
    axes.fill_between(curve.minutes, low, high, color=color, alpha=0.13, linewidth=0, zorder=2)
    axes.plot(
        curve.minutes, [m.share for m in curve.marks], color=color, linewidth=1.8, marker="o", markersize=3.8,
        zorder=4, clip_on=False,
    )  # fmt: skip
