"""One look for all figures: colors, axes, headings, and how they are written."""

import colorsys
import warnings
from bisect import bisect_left
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import matplotlib
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties

from flowlab.files import output_file
from flowlab.text import cut

INK, QUIET, ALARM = "#22262c", "#747b85", "#c2263b"
"""Of text: what is read first, what explains it, what warns."""
GRID = "#e6e8ec"
BLUE, ORANGE, GREEN, PINK, PURPLE, GRAY = "#2a6fbb", "#e07b1a", "#2f9e6e", "#b8438a", "#7b5bb8", "#6d737c"
SERIES = (BLUE, ORANGE, GREEN, PINK, PURPLE, GRAY)
"""Of lines in one plot, in turn; told apart by people who confuse red with green, too."""
DPI = 150
HEADING_PT, TICK_PT, LABEL_PT = 10.5, 8.5, 9.0
_PAPER_COLORS = {
    "dp3": ORANGE, "mba": GREEN, "fdp": BLUE, "fdp-m50": "#86b4e3", "fdp-m200": "#173f73", "fdp-object": PURPLE,
    "fdp-stratified": PINK, "fdp-auxiliary": "#8a7a5c",
}  # fmt: skip
_FURTHER = ("#c2453d", "#2a9aa8", "#6b7a2e", "#a05a2c", "#5b6ee0", "#4a4f57")
_MOST_NAMES = 40
"""No line holds more."""
_LONGEST_LABEL = 60
"""Characters of a name in a figure, which grows with its longest."""
_GOLDEN = 0.61803398875
"""Hues that are this share of the circle apart never come close soon."""


@contextmanager
def plain_style() -> Iterator[None]:
    """Matplotlib as it comes, whatever a ``matplotlibrc`` says, and no text is a formula: names are shown as they are.

    Everything that makes or writes a figure is decorated with it.
    """
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams["text.parse_math"] = False
        yield


def label_text(text: str, limit: int = _LONGEST_LABEL) -> str:
    """Text from a file as a figure shows it: one line, no longer than that."""
    short = cut(text, limit)
    return f" {short}" if short.startswith("_") else short  # legends leave out what begins so


def policy_colors(labels: Sequence[str]) -> dict[str, str]:
    """A color of its own for every policy; those of the paper's tables always have the same."""
    further = _further_colors()
    return {label: _PAPER_COLORS.get(label) or next(further) for label in labels}


def new_figure(width: float, height: float) -> Figure:
    """An empty figure of a size [in], which needs no window."""
    figure = Figure(figsize=(width, height), dpi=DPI)
    FigureCanvasAgg(figure)
    return figure


def set_title(figure: Figure, text: str, *, size: float = 15.0) -> None:
    """The title in a figure's upper left corner; ``size`` is in points."""
    width, height = figure.get_size_inches()
    text = label_text(text, 200)
    figure.text(0.15 / width, 1 - 0.32 / height, text, fontsize=size, weight="bold", color=INK, va="center")


def fit_text(figure: Figure, text: str, width: float, font: FontProperties, *, end: str = "") -> str:
    """Text and its ``end``, which is kept, shortened so that they are no wider than ``width`` [in]."""
    if _fits(figure, text + end, width, font):
        return text + end
    cuts = range(len(text))
    most = bisect_left(cuts, True, key=lambda k: not _fits(figure, f"{text[:k]}…{end}", width, font))
    return f"{text[: max(most - 1, 0)].rstrip()}…{end}"


def fit_names(figure: Figure, start: str, names: Sequence[str], width: float, font: FontProperties) -> str:
    """A line's ``start`` and as many names as ``width`` [in] holds; how many more there are."""
    shown = [label_text(name) for name in names[:_MOST_NAMES]]
    for count in range(len(shown), 0, -1):
        rest = len(names) - count
        end = f" and {rest} more" if rest else ""
        text = start + ", ".join(shown[:count])
        if count == 1 or _fits(figure, text + end, width, font):
            return fit_text(figure, text, width, font, end=end)
    return start


def _fits(figure: Figure, text: str, width: float, font: FontProperties) -> bool:
    """Whether a line of text is no wider than so many inches."""
    renderer = cast(Any, figure.canvas).get_renderer()  # matplotlib does not say its types
    with _quiet_glyphs():
        across, _, _ = renderer.get_text_width_height_descent(text, font, ismath=False)
    return bool(across <= width * figure.dpi)


def set_heading(axes: Axes, text: str) -> None:
    """Say above a panel what it shows."""
    axes.set_title(label_text(text), loc="left", fontsize=HEADING_PT, color=INK, pad=8)


def style_axes(axes: Axes, heading: str, ylabel: str = "") -> None:
    """A panel's grid, ticks and heading."""
    axes.grid(color=GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.tick_params(length=0, which="both", labelsize=TICK_PT, labelcolor=QUIET)
    hide_frame(axes)
    set_heading(axes, heading)
    axes.set_ylabel(ylabel, color=QUIET, fontsize=LABEL_PT)


def hide_frame(axes: Axes) -> None:
    """Draw no lines around a panel."""
    for spine in axes.spines.values():
        spine.set_visible(False)


@plain_style()
def save_png(figure: Figure, path: Path) -> None:
    """Write a figure as PNG, the same bytes for the same figure. ``path`` is either absent, as before, or whole."""
    with output_file(path) as temporary, _quiet_glyphs():
        figure.savefig(temporary, format="png", facecolor="white", metadata={"Software": None})


@contextmanager
def _quiet_glyphs() -> Iterator[None]:
    """Names in other scripts show as boxes, and that is all."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph")
        yield


def _further_colors() -> Iterator[str]:
    """Colors without end, each another."""
    yield from _FURTHER
    hue = 0.0
    while True:
        hue = (hue + _GOLDEN) % 1
        red, green, blue = (round(255 * c) for c in colorsys.hls_to_rgb(hue, 0.45, 0.5))
        yield f"#{red:02x}{green:02x}{blue:02x}"
