"""How stated errors show in stills: in the color of trails, as circles, and as a bar of their shares."""

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from flowlab.viz.panels import BAR, dot
from flowlab.viz.plot_style import LABEL_PT, QUIET, TICK_PT, hide_frame
from flowlab.viz.stated_error import SIGMA_NAMES, SIGMA_RGB, class_shares, is_coarse, percent, shares_below, sigma_rgb

_FAINT = 0.3
_DARKER = 0.88
"""Colors on white, against those on pictures."""
_ON_WHITE = _DARKER * np.array(SIGMA_RGB) / 255


def error_color(sigma: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch 3"]:
    """The colors of stated errors on white."""
    return _DARKER * sigma_rgb(sigma) / 255


def error_trail(
    track: Float[np.ndarray, "T 2"], sigma: Float[np.ndarray, "T"], visible: Bool[np.ndarray, "T"]
) -> LineCollection:
    """One track in the colors of its stated errors; faint where they are large, or the point was out of sight."""
    sure = visible[1:] & ~is_coarse(sigma[1:])
    colors = np.column_stack([error_color(sigma[1:]), np.where(sure, 1.0, _FAINT)])
    pieces = list(np.stack([track[:-1], track[1:]], 1))
    return LineCollection(pieces, colors=list(colors), linewidths=1.6, capstyle="butt", zorder=4)


def draw_error_circles(
    axes: Axes, place: Float[np.ndarray, "K 2"], radius: Float[np.ndarray, "K"], sigma: Float[np.ndarray, "K"]
) -> None:
    """Circles of the radius of the stated errors, in the units of the axes, around those that are large."""
    shown = is_coarse(sigma) & np.isfinite(radius) & np.isfinite(place).all(1)
    size = 2 * radius[shown]
    circles = EllipseCollection(
        size, size, np.zeros(len(size)), units="x", offsets=place[shown], offset_transform=axes.transData,
        facecolors="none", edgecolors=list(error_color(sigma[shown])), linewidths=0.9, alpha=0.8, zorder=5.5,
    )  # fmt: skip
    axes.add_collection(circles, autolim=False)


def error_legend(sigma: Float[np.ndarray, "T M"]) -> list[Line2D]:
    """A legend's entries of the classes of stated errors, with the share of positions below the end of each."""
    named = zip(SIGMA_NAMES, shares_below(sigma), _ON_WHITE, strict=True)
    dots = [dot(f"{name}: {percent(share)}", tuple(color), "none") for name, share, color in named]
    dots[0].set_label(f"σ {dots[0].get_label()}")
    return dots


def draw_share_bar(figure: Figure, sigma: Float[np.ndarray, "T M"]) -> None:
    """How large a share of all positions is in each class of stated errors: a bar, the smallest at the bottom."""
    axes = figure.add_axes(BAR)
    bottom = 0.0
    for share, color in zip(class_shares(sigma), _ON_WHITE, strict=True):
        axes.bar(0, share, bottom=bottom, width=1, color=color)
        bottom += share
    axes.set(xlim=(-0.5, 0.5), ylim=(0, 1), xticks=[])
    axes.yaxis.tick_right()
    axes.set_yticks(np.linspace(0, 1, 6), [f"{x:.0%}" for x in np.linspace(0, 1, 6)])
    axes.tick_params(length=0, labelsize=TICK_PT, labelcolor=QUIET)
    axes.yaxis.set_label_position("right")
    axes.set_ylabel("share of positions, by stated error σ", color=QUIET, fontsize=LABEL_PT)
    hide_frame(axes)
