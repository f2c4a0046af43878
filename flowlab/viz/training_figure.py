"""A training run as one picture: losses, learning rate, errors on held-out demonstrations beside baselines."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from flowlab.viz.plot_style import (
    BLUE,
    DPI,
    GRAY,
    PINK,
    PURPLE,
    QUIET,
    SERIES,
    TICK_PT,
    new_figure,
    plain_style,
    save_png,
    set_title,
    style_axes,
)
from flowlab.viz.training_metrics import MetricsLine, lines_of_kind, read_metrics, series

LOSSES = {"loss": "total", "action_loss": "action", "motion_loss": "motion"}
"""What training lines say, and how it is labeled."""


@dataclass(frozen=True, slots=True)
class CurvePanel:
    """One error on held-out demonstrations."""

    key: str
    """Of validation lines; its baselines have suffixes."""
    heading: str
    unit: str
    baselines: Mapping[str, str]
    """What needs no training, by suffix, and how it is labeled."""


_OF_ACTION = {"zero": "no action", "hold": "last action again"}
_OF_MOTION = {"zero": "no motion", "constant": "same velocity"}
COLUMNS = (
    (CurvePanel("action_l1", "held-out actions", "mean error [unit of the data]", _OF_ACTION),),
    (
        CurvePanel("flow_moving_mm", "held-out flow, moving points", "mean error [mm]", _OF_MOTION),
        CurvePanel("flow_static_mm", "held-out flow, still points", "mean error [mm]", _OF_MOTION),
    ),
    (CurvePanel("pose_mm", "held-out positions of the object", "mean error [mm]", _OF_MOTION),),
)
"""Columns of panels, beside that of training."""
FAR = 2.0
"""A baseline more than so many times as high as the rest is not drawn: its label alone says how bad it is."""

_BASELINE_COLORS = {"zero": GRAY, "hold": PINK, "constant": PURPLE}
_HEIGHT_IN, _PANEL_IN, _LABELS_IN = 4.9, 2.9, 1.5
_LEFT_IN, _TOP_IN, _BOTTOM_IN = 0.65, 1.0, 0.55


@dataclass(frozen=True, slots=True)
class LineEnd:
    """What stands right of a panel, where a line ends."""

    height: float
    """On the panel's axis."""
    text: str
    color: str


def draw_training(metrics: Path, png: Path) -> None:
    """Write a PNG of a training run's ``metrics.jsonl``. ``png`` is either absent, as before, or whole.

    Raises:
        DataError: There is nothing to draw, or a line is damaged; the last line may be cut off.
    """
    save_png(plot_training(read_metrics(metrics), metrics.absolute().parent.name), png)


@plain_style()
def plot_training(lines: Sequence[MetricsLine], title: str) -> Figure:
    """The figure of :func:`draw_training`: a column for training, if lines tell of it, and for each of :data:`COLUMNS`
    that validation lines tell of."""
    training = lines_of_kind(lines, "train")
    validation = lines_of_kind(lines, "validation")
    known = {name for line in validation for name in line.values}
    columns = [[p for p in column if p.key in known] for column in COLUMNS]
    columns = [column for column in columns if column]
    count = max(len(columns) + bool(training), 1)
    figure = new_figure(count * (_LEFT_IN + _PANEL_IN + _LABELS_IN), _HEIGHT_IN)
    last_step = max(line.step for line in lines)
    if training:
        losses, rate = _make_axes(figure, 0, count, (3.2, 1))
        _draw_losses(losses, training)
        _draw_rate(rate, training)
    for k, column in enumerate(columns, count - len(columns)):
        for axes, panel in zip(_make_axes(figure, k, count, (1,) * len(column)), column, strict=True):
            _draw_errors(axes, panel, validation)
    for axes in figure.axes:
        _draw_steps(axes, last_step)
    width, height = figure.get_size_inches()
    set_title(figure, title)
    figure.text(0.15 / width, 1 - 0.6 / height, _describe_run(lines), fontsize=9, color=QUIET, va="center")
    return figure


def _describe_run(lines: Sequence[MetricsLine]) -> str:
    """How long the run has taken so far, and how fast it was."""
    last = lines[-1].values
    parts = [f"{max(line.step for line in lines):,} steps".replace(",", " ")]
    for name, what in (("cpu_s", "of CPU time"), ("wall_s", "by the clock")):
        if name in last:
            minutes = last[name] / 60
            parts.append(f"{minutes:.1f} min {what}" if minutes >= 2 else f"{last[name]:.0f} s {what}")
    _, rates = series(lines, "samples_per_s")
    if len(rates):
        parts.append(f"{np.median(rates):,.0f} samples/s".replace(",", " "))
    return "   ·   ".join(parts)


def _make_axes(figure: Figure, column: int, columns: int, heights: Sequence[float]) -> list[Axes]:
    """Panels below each other in a column, with room for labels to their right."""
    width, height = figure.get_size_inches()
    left = (column * width / columns + _LEFT_IN) / width
    grid = figure.add_gridspec(
        len(heights), 1, height_ratios=heights, hspace=0.42, left=left, right=left + _PANEL_IN / width,
        bottom=_BOTTOM_IN / height, top=1 - _TOP_IN / height,
    )  # fmt: skip
    return [figure.add_subplot(grid[k]) for k in range(len(heights))]


def _draw_losses(axes: Axes, training: Sequence[MetricsLine]) -> None:
    """The losses of training, on a logarithmic axis."""
    known = [name for name in LOSSES if any(name in line.values for line in training)]
    if "motion_loss" not in known:
        known = known[:1]  # the loss is the action's
    ends = []
    for name, color in zip(known, SERIES, strict=False):
        steps, values = series(training, name)
        _plot(axes, steps, values, color)
        ends.append(LineEnd(values[-1], f"{LOSSES[name]} {values[-1]:.3g}", color))
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{y:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
    style_axes(axes, "training", "loss")
    _label_ends(axes, ends)


def _draw_rate(axes: Axes, training: Sequence[MetricsLine]) -> None:
    """The learning rate."""
    steps, values = series(training, "lr")
    _plot(axes, steps, values, QUIET)
    highest = float(values.max(initial=0))
    axes.set_ylim(0, 1.1 * highest or 1)
    axes.set_yticks([0, highest], ["0", f"{highest:.3g}"])
    style_axes(axes, "learning rate", "")


def _plot(axes: Axes, steps: np.ndarray, values: np.ndarray, color: str) -> None:
    """A line of training; a single point has no line to be seen by."""
    marker = "o" if len(steps) == 1 else ""
    axes.plot(steps, values, color=color, linewidth=1.4, marker=marker, markersize=3.5, zorder=3, clip_on=False)


def _draw_errors(axes: Axes, panel: CurvePanel, validation: Sequence[MetricsLine]) -> None:
    """The policy's error at every look, and dashed what its baselines have."""
    steps, values = series(validation, panel.key)
    found = {s: series(validation, f"{panel.key}_{s}")[1] for s in panel.baselines}
    baselines = {suffix: float(v[-1]) for suffix, v in found.items() if len(v)}
    rest = max([*values, *sorted(baselines.values())[:1]])
    top = 1.1 * max([rest, *(v for v in baselines.values() if v <= FAR * rest)]) or 1.0
    axes.plot(steps, values, color=BLUE, linewidth=1.8, marker="o", markersize=3.5, zorder=4, clip_on=False)
    ends = [LineEnd(values[-1], f"policy {values[-1]:.3g}", BLUE)]
    for suffix, value in baselines.items():
        text, color = f"{panel.baselines[suffix]} {value:.3g}", _BASELINE_COLORS[suffix]
        if value > FAR * rest:
            ends.append(LineEnd(top, f"{text} ↑", color))
            continue
        axes.axhline(value, color=color, linewidth=1.2, linestyle=(0, (4, 3)), zorder=2)
        ends.append(LineEnd(value, text, color))
    axes.set_ylim(0, top)
    axes.yaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
    style_axes(axes, panel.heading, panel.unit)
    _label_ends(axes, ends)


def _draw_steps(axes: Axes, last_step: int) -> None:
    """The axis of steps; only the lowest panel of a column says what it is."""
    axes.set_xlim(0, last_step)
    axes.xaxis.set_major_locator(MaxNLocator(4, integer=True))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x / 1000:g} k" if x >= 1000 else f"{x:g}"))
    spec = axes.get_subplotspec()
    assert spec is not None
    if spec.is_last_row():
        axes.set_xlabel("training step", color=QUIET, fontsize=9)


def _label_ends(axes: Axes, ends: Sequence[LineEnd]) -> None:
    """Name lines right of the panel, each where it ends, or as near as the others allow."""
    gap = 1.3 * TICK_PT * DPI / 72 / axes.get_window_extent().height
    ordered = sorted(ends, key=lambda end: end.height)
    to_share = axes.transData + axes.transAxes.inverted()
    wanted = [float(to_share.transform((0, end.height))[1]) for end in ordered]
    for place, end in zip(_spread(wanted, gap), ordered, strict=True):
        axes.text(
            1.03, place, end.text, transform=axes.transAxes, fontsize=TICK_PT, color=end.color,
            va="center_baseline",
        )  # fmt: skip


def _spread(wanted: Sequence[float], gap: float) -> list[float]:
    """Places in ascending order, at least ``gap`` apart and between 0 and 1, near those wanted."""
    places = list(np.clip(wanted, 0, 1))
    for k in range(1, len(places)):
        places[k] = max(places[k], places[k - 1] + gap)
    if places:
        places[-1] = min(places[-1], 1)
    for k in reversed(range(len(places) - 1)):
        places[k] = min(places[k], places[k + 1] - gap)
    return places
