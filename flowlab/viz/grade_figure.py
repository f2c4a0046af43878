"""Grades as one picture: how errors are distributed, and whether stated errors can be believed."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.lines import Line2D

from flowlab.grading.calibration import CONFIDENTLY_WRONG, Calibration
from flowlab.grading.metrics import CURVE_MM, TrackMetrics
from flowlab.viz.plot_style import (
    INK,
    QUIET,
    SERIES,
    fit_names,
    fit_text,
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
_PANEL_IN, _AXES_IN, _ABOVE_IN, _MARGIN_IN = 3.3, 2.9, 1.18, 0.15
"""Width of a panel with its margin, height of its axes, room for the title, empty edges."""
_LINE_IN, _WORDS_IN = 0.22, 0.18
"""Height of a tracker's line, and of the middle of the line below all of them."""
_TITLE_PT = 13.0
_TICKS_MM = (1, 5, 10, 20, 40, 100, 500)
_SIGMA_TICKS_MM = (1, 2, 5, 10, 20, 50, 100)


def draw_grades(
    metrics: Mapping[str, TrackMetrics], path: Path, *, graded: Sequence[str], about: Sequence[str] = ()
) -> None:
    """Write a PNG for the mean metrics of each tracker, by name. ``path`` is either absent, as before, or whole."""
    save_png(plot_grades(metrics, graded, about), path)


@plain_style()
def plot_grades(metrics: Mapping[str, TrackMetrics], graded: Sequence[str], about: Sequence[str] = ()) -> Figure:
    """The figure of :func:`draw_grades`: a panel of cumulative error curves for each group there is, then the
    reliability of sigma, if any is stated; a line for each tracker.

    ``graded`` names the tasks, families of scenes or recordings, ``about`` says with what they were recorded.
    """
    groups = [g for g in GROUPS if any(getattr(m, g) is not None for m in metrics.values())]
    stated = any(m.calibration is not None for m in metrics.values())
    panels = len(groups) + stated
    width, below = max(panels, 2) * _PANEL_IN + 0.4, 0.8 + _LINE_IN * len(metrics)
    height = _ABOVE_IN + _AXES_IN + below
    figure = new_figure(width, height)
    colors = {name: SERIES[k % len(SERIES)] for k, name in enumerate(metrics)}
    axes = figure.subplots(1, max(panels, 1), squeeze=False)[0]
    for panel, group in zip(axes, groups, strict=False):
        _draw_curves(panel, group, metrics, colors)
    if stated:
        _draw_reliability(axes[-1], {n: m.calibration for n, m in metrics.items() if m.calibration}, colors)
    axes[0].set_ylabel("share of points and frames", color=QUIET, fontsize=9)
    figure.subplots_adjust(0.6 / width, below / height, 1 - 0.15 / width, 1 - _ABOVE_IN / height, wspace=0.22)
    _write_title(figure, graded, about)
    _write_trackers(figure, metrics, colors)
    return figure


def _write_title(figure: Figure, graded: Sequence[str], about: Sequence[str]) -> None:
    """What was graded, and what it was recorded with, at the top, as far as it fits."""
    width, height = figure.get_size_inches()
    room, bold = width - 2 * _MARGIN_IN, FontProperties(size=_TITLE_PT, weight="bold")
    set_title(figure, fit_names(figure, "error of tracks: ", graded, room, bold), size=_TITLE_PT)
    facts = fit_text(figure, label_text("   ·   ".join(about), 1000), room, FontProperties(size=9))
    figure.text(_MARGIN_IN / width, 1 - 0.62 / height, facts, fontsize=9, color=QUIET, va="center")


def _write_trackers(figure: Figure, metrics: Mapping[str, TrackMetrics], colors: Mapping[str, str]) -> None:
    """A line for each tracker at the bottom: its color, its name, and how often it is confidently wrong."""
    (width, height), left, font = figure.get_size_inches(), _MARGIN_IN, FontProperties(size=9.5)
    for k, (name, of_tracker) in enumerate(metrics.items()):
        y, wrong = (_WORDS_IN + _LINE_IN * (len(metrics) - k)) / height, of_tracker.confidently_wrong
        says = ": states no errors" if wrong is None or np.isnan(wrong) else f": {wrong:.2%} confidently wrong"
        text = fit_text(figure, label_text(name), width - left - 0.6, font, end=says)
        figure.add_artist(Line2D([left / width, (left + 0.22) / width], [y, y], color=colors[name], linewidth=2.2))
        figure.text((left + 0.3) / width, y, text, fontsize=9.5, color=INK, va="center")
    least_m, sigmas = CONFIDENTLY_WRONG
    words = f"confidently wrong: in sight, true error above {1000 * least_m:.0f} mm and above {sigmas:.0f} σ"
    figure.text(left / width, _WORDS_IN / height, words, fontsize=9, color=QUIET, va="center")


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
