"""Figures of policies side by side in rows, a row for each task, and what they have in common."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TypeVar

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from flowlab.viz.plot_style import INK, label_text, new_figure

HEADING_IN, AXIS_IN, MARGIN_IN = 0.42, 0.34, 0.3
"""Room above a panel for its heading, below it for its axis, and beside it [in]."""
_LETTER_IN, _TITLE_IN, _LEGEND_IN, _ROW_IN = 0.074, 0.5, 0.22, 0.13
_BAND = "#f5f6f8"
_Drawn = TypeVar("_Drawn")


def width_of(names: Iterable[str]) -> float:
    """Room for the longest name, a gap, and no less than a column of figures looks well with [in]."""
    return max(_LETTER_IN * max(len(label_text(name)) for name in names) + 0.2, 0.9)


def row_height(policies: Mapping[str, object], pitch: float) -> float:
    """Of a task that these policies tried, which stand ``pitch`` apart [in]."""
    return _ROW_IN + pitch * len(policies)


def each_mark(rows: Mapping[str, Mapping[str, _Drawn]], labels: Sequence[str]) -> Iterator[tuple[str, _Drawn]]:
    """Policy and what is drawn of it, from top to bottom."""
    for of_row in rows.values():
        for label in labels:
            if label in of_row:
                yield label, of_row[label]


def lay_out_rows(
    axes: Axes, rows: Mapping[str, Mapping[str, object]], pitch: float, *, named: bool = True
) -> list[float]:
    """A row for each name, the first on top, every other one shaded; the axis is in inches.

    Returns:
        Where each policy of each row is.
    """
    places, centers, top = [], [], 0.0
    for k, of_row in enumerate(rows.values()):
        height = row_height(of_row, pitch)
        places += [top + _ROW_IN / 2 + (j + 0.5) * pitch for j in range(len(of_row))]
        centers.append(top + height / 2)
        if k % 2 == 0:
            axes.axhspan(top, top + height, color=_BAND, linewidth=0, zorder=0)
        top += height
    axes.set_ylim(top, 0)
    axes.set_yticks(centers, [label_text(name) if named else "" for name in rows])
    axes.tick_params(axis="y", labelsize=9, labelcolor=INK, pad=6)
    axes.grid(visible=False, axis="y")
    return places


def titled_figure(
    title: str, handles: Mapping[str, Line2D | Patch], width: float, height: float
) -> tuple[Figure, float]:
    """A figure with a title, a legend of what colors mean, and room of a size [in] below them.

    Returns:
        The figure, and how high title and legend are [in].
    """
    columns = max(int(width / (width_of(handles) + 0.3)), 1)
    above = _TITLE_IN + _LEGEND_IN * -(-len(handles) // columns)
    height += above
    figure = new_figure(width, height)
    figure.text(0.15 / width, 1 - 0.28 / height, title, fontsize=14, weight="bold", color=INK, va="center")
    figure.legend(
        handles.values(), map(label_text, handles), loc="upper left", bbox_to_anchor=(0.13 / width, 1 - 0.48 / height),
        ncols=columns, frameon=False, fontsize=9, labelcolor=INK, handlelength=1.4, columnspacing=1.4,
        handletextpad=0.6, borderpad=0, borderaxespad=0,
    )  # fmt: skip
    return figure, above


def add_axes(figure: Figure, left: float, top: float, width: float, height: float) -> Axes:
    """Axes by their place in inches from the upper left corner."""
    across, down = figure.get_size_inches()
    return figure.add_axes((left / across, 1 - (top + height) / down, width / across, height / down))


def line_handles(colors: Mapping[str, str]) -> dict[str, Line2D | Patch]:
    """A legend's entry for every policy: a line with a dot on it."""
    return {
        label: Line2D([], [], color=color, marker="o", markersize=5, linewidth=1.6) for label, color in colors.items()
    }


def percent(share: float, _: object = None) -> str:
    """A share from 0 to 1, as the ticks of an axis say it."""
    return f"{100 * share:.0f} %"
