"""Grades as one picture: how errors are distributed, and whether stated errors can be believed."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from flowlab.grading.calibration import Calibration
from flowlab.grading.metrics import CURVE_MM, TrackMetrics
from flowlab.viz.plot_style import (
    INK,
    QUIET,
    SERIES,
    label_text,
    new_figure,
    plain_style,
    save_png,
    set_title,
    style_axes,
)

GROUPS = {
    "all": "all visible points",
    "moving": "visible, have moved",
    "object": "… of these, on objects",
    "occluded": "out of sight, have moved",
}
"""The panels of error curves, as far as there are such points."""
RELIABILITY_POINTS = 30
"""Bins with fewer pairs are not drawn: their percentile would be chance."""
_PANEL_IN = 3.3
_TICKS_MM = (1, 5, 10, 20, 40, 100, 500)
_SIGMA_TICKS_MM = (1, 2, 5, 10, 20, 50, 100)


def draw_grades(metrics: Mapping[str, TrackMetrics], path: Path, *, title: str, about: str = "") -> None:
    """Write a PNG for the mean metrics of each tracker, by name. ``path`` is either absent, as before, or whole."""
    save_png(plot_grades(metrics, title, about), path)


@plain_style()
def plot_grades(metrics: Mapping[str, TrackMetrics], title: str, about: str = "") -> Figure:
    """The figure of :func:`draw_grades`: a panel of cumulative error curves for each group there is, then the
    reliability of sigma, if any is stated; a line for each tracker."""
    groups = [g for g in GROUPS if any(getattr(m, g) is not None for m in metrics.values())]
    stated = any(m.calibration is not None for m in metrics.values())
    panels = len(groups) + stated
    figure = new_figure(max(panels, 2) * _PANEL_IN + 0.4, 4.6)
    colors = {name: SERIES[k % len(SERIES)] for k, name in enumerate(metrics)}
    axes = figure.subplots(1, max(panels, 1), squeeze=False)[0]
    for panel, group in zip(axes, groups, strict=False):
        _draw_curves(panel, group, metrics, colors)
    if stated:
        _draw_reliability(axes[-1], {n: m.calibration for n, m in metrics.items() if m.calibration}, colors)
    axes[0].set_ylabel("share of points and frames", color=QUIET, fontsize=9)
    width, height = figure.get_size_inches()
    figure.subplots_adjust(0.6 / width, 0.78 / height, 1 - 0.15 / width, 1 - 0.92 / height, wspace=0.22)
    set_title(figure, title)
    figure.text(
        1 - 0.15 / width, 0.2 / height, label_text(about, 120), fontsize=9, color=QUIET, va="center", ha="right"
    )
    lines = [Line2D([], [], color=color, linewidth=2.2, label=label_text(name)) for name, color in colors.items()]
    figure.legend(
        handles=lines, loc="lower left", bbox_to_anchor=(0.15 / width, 0.08 / height), ncols=len(lines),
        frameon=False, fontsize=9.5, labelcolor=INK, handlelength=1.4, borderpad=0, borderaxespad=0,
    )  # fmt: skip
    return figure


def _draw_curves(axes: Axes, group: str, metrics: Mapping[str, TrackMetrics], colors: Mapping[str, str]) -> None:
    """The cumulative errors of every tracker in one group of points."""
    for name, of_tracker in metrics.items():
        errors = getattr(of_tracker, group)
        if errors is not None:
            axes.plot(CURVE_MM, errors.curve, color=colors[name], linewidth=1.8, zorder=3)
    axes.set(xscale="log", xlim=(CURVE_MM[0], CURVE_MM[-1]), ylim=(0, 1.005))
    axes.set_yticks(np.linspace(0, 1, 6))
    axes.set_xlabel("error [mm]", color=QUIET, fontsize=9)
    _style_panel(axes, GROUPS[group], _TICKS_MM)


def _draw_reliability(axes: Axes, calibrations: Mapping[str, Calibration], colors: Mapping[str, str]) -> None:
    """True error that 68 % stay below, over stated error; markers grow with the share of pairs in a bin."""
    axes.plot([0.01, 1e4], [0.01, 1e4], color=QUIET, linewidth=1, linestyle=(0, (4, 3)), zorder=2)
    drawn = [1.0, 20.0]
    for name, c in calibrations.items():
        count, stated, true = (np.array(v, float) for v in (c.count, c.stated_mm, c.true_mm))
        known = (count >= RELIABILITY_POINTS) & (stated > 0) & (true > 0)
        size = 8 + 150 * np.sqrt(count[known] / c.n)
        axes.plot(stated[known], true[known], color=colors[name], linewidth=1.2, alpha=0.7, zorder=3)
        axes.scatter(stated[known], true[known], size, color=colors[name], linewidths=0, alpha=0.8, zorder=4)
        drawn += [*stated[known], *true[known]]
    limits = min(drawn) / 1.5, max(drawn) * 1.5
    axes.set(xscale="log", yscale="log", xlim=limits, ylim=limits)
    axes.set_yticks(_SIGMA_TICKS_MM, [str(t) for t in _SIGMA_TICKS_MM])
    axes.set_xlabel("stated error σ [mm]", color=QUIET, fontsize=9)
    _style_panel(axes, "σ: true error, 68 % are below [mm]", _SIGMA_TICKS_MM)
    axes.set_ylim(limits)


def _style_panel(axes: Axes, heading: str, ticks_mm: tuple[int, ...]) -> None:
    """A panel's grid, heading and ticks on an axis of millimeters."""
    limits = axes.get_xlim()
    axes.set_xticks(ticks_mm, [str(t) for t in ticks_mm])
    axes.set_xlim(limits)
    axes.minorticks_off()
    style_axes(axes, heading, axes.get_ylabel())
