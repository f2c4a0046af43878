"""A training run as one picture: losses, errors on held-out demonstrations beside what costs nothing, learning rate."""

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from flowlab.errors import DataError
from flowlab.files import temporary_path

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

_COLORS = ("#2a6fbb", "#e07b1a", "#2f9e6e")
_POLICY, _BASELINES = "#2a6fbb", {"zero": "#6d737c", "hold": "#b8438a", "constant": "#7b5bb8"}
_INK, _QUIET, _GRID = "#22262c", "#747b85", "#e6e8ec"
_DPI, _HEIGHT_IN, _PANEL_IN, _LABELS_IN = 150, 4.9, 2.9, 1.5
_LEFT_IN, _TOP_IN, _BOTTOM_IN = 0.65, 1.0, 0.55
_LABEL_PT = 8.5


@dataclass(frozen=True, slots=True)
class Line:
    """A line of ``metrics.jsonl``."""

    kind: str
    step: int
    values: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class End:
    """What stands right of a panel, where a line ends."""

    height: float
    """On the panel's axis."""
    text: str
    color: str


Series = tuple[Float[np.ndarray, "K"], Float[np.ndarray, "K"]]
"""Steps, and the value at each."""


def draw_curve(metrics: Path, png: Path) -> None:
    """Write a PNG of a training run's ``metrics.jsonl``. ``png`` is either absent, as before, or whole.

    Raises :class:`DataError` where there is nothing to draw, or a line is damaged; the last line may be cut off.
    """
    temporary = temporary_path(png)
    figure = compose(read_metrics(metrics), metrics.absolute().parent.name)
    png.parent.mkdir(parents=True, exist_ok=True)
    try:
        figure.savefig(temporary, format="png", facecolor="white")
        os.replace(temporary, png)
    finally:
        temporary.unlink(missing_ok=True)


def read_metrics(path: Path) -> list[Line]:
    """The lines of a run's metrics, at least one. A last line that a kill cut off is left out."""
    try:
        *whole, _ = path.read_bytes().split(b"\n")
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror}); a training run writes it") from error
    lines = [_parse(path, number, text) for number, text in enumerate(whole, 1)]
    if not lines:
        raise DataError(f"{path}: holds no whole line yet; a training run adds the first after some steps")
    return lines


def _parse(path: Path, number: int, text: bytes) -> Line:
    try:
        values = json.loads(text)
        kind, step = str(values.pop("kind")), int(values.pop("step"))
        return Line(kind, step, {name: float(value) for name, value in values.items()})
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise DataError(
            f"{path}: line {number} is damaged (expected a JSON object of numbers with kind and step, found "
            f"{text[:60].decode(errors='replace')!r}); delete the line"
        ) from error


def compose(lines: Sequence[Line], title: str) -> Figure:
    """The figure of :func:`draw_curve`: a column for training, if lines tell of it, and for each of :data:`COLUMNS`
    that validation lines tell of."""
    training = _only(lines, "train")
    validation = _only(lines, "validation")
    told = {name for line in validation for name in line.values}
    columns = [[p for p in column if p.key in told] for column in COLUMNS]
    columns = [column for column in columns if column]
    count = max(len(columns) + bool(training), 1)
    figure = Figure(figsize=(count * (_LEFT_IN + _PANEL_IN + _LABELS_IN), _HEIGHT_IN), dpi=_DPI)
    FigureCanvasAgg(figure)
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
    figure.text(0.15 / width, 1 - 0.33 / height, title, fontsize=15, weight="bold", color=_INK, va="center")
    figure.text(0.15 / width, 1 - 0.6 / height, _about(lines), fontsize=9, color=_QUIET, va="center")
    return figure


def _only(lines: Sequence[Line], kind: str) -> list[Line]:
    return [line for line in lines if line.kind == kind]


def _series(lines: Sequence[Line], name: str) -> Series:
    """Steps and values of the lines that tell the value."""
    pairs = [(line.step, line.values[name]) for line in lines if name in line.values]
    steps, values = np.array(pairs, float).reshape(-1, 2).T
    return steps, values


def _about(lines: Sequence[Line]) -> str:
    """How long the run has taken so far, and how fast it was."""
    last = lines[-1].values
    facts = [f"{max(line.step for line in lines):,} steps".replace(",", " ")]
    for name, what in (("cpu_s", "of CPU time"), ("wall_s", "by the clock")):
        if name in last:
            minutes = last[name] / 60
            facts.append(f"{minutes:.1f} min {what}" if minutes >= 2 else f"{last[name]:.0f} s {what}")
    _, rates = _series(lines, "samples_per_s")
    if len(rates):
        facts.append(f"{np.median(rates):,.0f} samples/s".replace(",", " "))
    return "   ·   ".join(facts)


def _make_axes(figure: Figure, column: int, columns: int, heights: Sequence[float]) -> list[Axes]:
    """Panels below each other in a column, with room for labels to their right."""
    width, height = figure.get_size_inches()
    left = (column * width / columns + _LEFT_IN) / width
    grid = figure.add_gridspec(
        len(heights), 1, height_ratios=heights, hspace=0.42, left=left, right=left + _PANEL_IN / width,
        bottom=_BOTTOM_IN / height, top=1 - _TOP_IN / height,
    )  # fmt: skip
    return [figure.add_subplot(grid[k]) for k in range(len(heights))]


def _draw_losses(axes: Axes, training: Sequence[Line]) -> None:
    told = [name for name in LOSSES if any(name in line.values for line in training)]
    if "motion_loss" not in told:
        told = told[:1]  # the loss is the action's
    ends = []
    for name, color in zip(told, _COLORS, strict=False):
        steps, values = _series(training, name)
        _plot(axes, steps, values, color)
        ends.append(End(values[-1], f"{LOSSES[name]} {values[-1]:.3g}", color))
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{y:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
    style_axes(axes, "training", "loss")
    _label_ends(axes, ends)


def _draw_rate(axes: Axes, training: Sequence[Line]) -> None:
    steps, values = _series(training, "lr")
    _plot(axes, steps, values, _QUIET)
    highest = float(values.max(initial=0))
    axes.set_ylim(0, 1.1 * highest or 1)
    axes.set_yticks([0, highest], ["0", f"{highest:.3g}"])
    style_axes(axes, "learning rate", "")


def _plot(axes: Axes, steps: np.ndarray, values: np.ndarray, color: str) -> None:
    """A line of training; a single point has no line to be seen by."""
    marker = "o" if len(steps) == 1 else ""
    axes.plot(steps, values, color=color, linewidth=1.4, marker=marker, markersize=3.5, zorder=3, clip_on=False)


def _draw_errors(axes: Axes, panel: CurvePanel, validation: Sequence[Line]) -> None:
    """The policy's error at every look, and dashed what its baselines have."""
    steps, values = _series(validation, panel.key)
    found = {s: _series(validation, f"{panel.key}_{s}")[1] for s in panel.baselines}
    baselines = {suffix: float(v[-1]) for suffix, v in found.items() if len(v)}
    rest = max([*values, *sorted(baselines.values())[:1]])
    top = 1.1 * max([rest, *(v for v in baselines.values() if v <= FAR * rest)]) or 1.0
    axes.plot(steps, values, color=_POLICY, linewidth=1.8, marker="o", markersize=3.5, zorder=4, clip_on=False)
    ends = [End(values[-1], f"policy {values[-1]:.3g}", _POLICY)]
    for suffix, value in baselines.items():
        text, color = f"{panel.baselines[suffix]} {value:.3g}", _BASELINES[suffix]
        if value > FAR * rest:
            ends.append(End(top, f"{text} ↑", color))
            continue
        axes.axhline(value, color=color, linewidth=1.2, linestyle=(0, (4, 3)), zorder=2)
        ends.append(End(value, text, color))
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
        axes.set_xlabel("training step", color=_QUIET, fontsize=9)


def _label_ends(axes: Axes, ends: Sequence[End]) -> None:
    """Name lines right of the panel, each where it ends, or as near as the others allow."""
    gap = 1.3 * _LABEL_PT * _DPI / 72 / axes.get_window_extent().height
    ordered = sorted(ends, key=lambda end: end.height)
    to_share = axes.transData + axes.transAxes.inverted()
    wanted = [float(to_share.transform((0, end.height))[1]) for end in ordered]
    for place, end in zip(_spread(wanted, gap), ordered, strict=True):
        axes.text(
            1.03, place, end.text, transform=axes.transAxes, fontsize=_LABEL_PT, color=end.color,
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


def style_axes(axes: Axes, heading: str, ylabel: str = "") -> None:
    """A panel's grid, ticks and heading."""
    axes.grid(color=_GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.tick_params(length=0, which="both", labelsize=8.5, labelcolor=_QUIET)
    for spine in axes.spines.values():
        spine.set_visible(False)
    axes.set_title(heading, loc="left", fontsize=10.5, color=_INK, pad=8)
    axes.set_ylabel(ylabel, color=_QUIET, fontsize=9)
