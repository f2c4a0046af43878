"""Errors of predicted flow, as a picture: beside those of predicting no motion."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from flowlab.viz.plot_style import plain_style, policy_colors, save_png, style_axes
from flowlab.viz.row_chart import (
    AXIS_IN,
    HEADING_IN,
    MARGIN_IN,
    add_axes,
    each_mark,
    lay_out_rows,
    row_height,
    titled_figure,
    width_of,
)

_ZERO = "#d3d6db"
_PLOT_IN, _PITCH_IN = 2.9, 0.15


@dataclass(frozen=True, slots=True)
class FlowBars:
    """Errors of predicted flow [mm] beside those of predicting no motion."""

    ade: float
    zero_ade: float
    fde: float
    zero_fde: float


def draw_flow_errors(errors: Mapping[str, Mapping[str, FlowBars]], labels: Sequence[str], png: Path) -> None:
    """Write a PNG of :func:`plot_flow_errors`; ``png`` is either as before, or whole."""
    save_png(plot_flow_errors(errors, labels), png)


@plain_style()
def plot_flow_errors(errors: Mapping[str, Mapping[str, FlowBars]], labels: Sequence[str]) -> Figure:
    """Errors of predicted flow: a bar for each policy, before a pale one of predicting no motion on its episodes."""
    colors = {x: c for x, c in policy_colors(labels).items() if any(x in of_task for of_task in errors.values())}
    handles = {label: Patch(color=color) for label, color in colors.items()} | {"no motion": Patch(color=_ZERO)}
    names = width_of(errors)
    tall = sum(row_height(of_task, _PITCH_IN) for of_task in errors.values())
    size = names + 2 * (_PLOT_IN + MARGIN_IN), HEADING_IN + tall + AXIS_IN
    figure, above = titled_figure("Predicted flow of moving points", handles, *size)
    for k, (name, heading) in enumerate((("ade", "mean error"), ("fde", "error at the last step"))):
        left = names + k * (_PLOT_IN + MARGIN_IN)
        axes = add_axes(figure, left, above + HEADING_IN, _PLOT_IN, tall)
        style_axes(axes, f"{heading} [mm]")
        for (label, e), y in zip(
            each_mark(errors, labels), lay_out_rows(axes, errors, _PITCH_IN, named=k == 0), strict=True
        ):
            axes.barh(y, getattr(e, f"zero_{name}"), 0.8 * _PITCH_IN, color=_ZERO, zorder=2)
            axes.barh(y, getattr(e, name), 0.45 * _PITCH_IN, color=colors[label], zorder=3)
        axes.set_xlim(0, None)
        axes.xaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
    return figure
