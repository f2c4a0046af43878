"""What stills are made of: a camera's view and a side view, a legend of time, and the marks in them."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from matplotlib.typing import ColorType

from flowlab.geometry.camera import Camera
from flowlab.records import Episode
from flowlab.viz.captions import role_name
from flowlab.viz.colors import role_rgb
from flowlab.viz.orientation import up_from_world, world_is_camera_frame
from flowlab.viz.plot_style import GRID, INK, LABEL_PT, QUIET, TICK_PT, hide_frame, label_text, new_figure

TIME_COLORS = LinearSegmentedColormap.from_list("time", ["#3b1f8f", "#a3218e", "#e2486a", "#f58a3c", "#f7bf3a"])
"""From the first step to the last: distinct from gray and readable on white."""
LEFT = 0.025
_SIZE_IN = (12.0, 6.4)
_BOXES = {"camera": (LEFT, 0.145, 0.43, 0.70), "side": (0.525, 0.145, 0.40, 0.70)}
BAR = (0.945, 0.145, 0.009, 0.70)
"""Left, bottom, width and height of each panel, as shares of the picture."""


def two_panels(title: str, caption: str) -> tuple[Figure, Axes, Axes]:
    """A figure with a title, a caption, and room for a camera's view and a side view."""
    figure = new_figure(*_SIZE_IN)
    figure.text(LEFT, 0.955, label_text(title, 120), fontsize=17, weight="bold", color=INK, va="center")
    figure.text(LEFT, 0.032, label_text(caption, 250), fontsize=9.5, color=QUIET, va="center")
    return figure, figure.add_axes(_BOXES["camera"]), figure.add_axes(_BOXES["side"])


def style_as_picture(axes: Axes) -> None:
    """Let y point down, as pixels are counted, and leave out their numbers."""
    axes.invert_yaxis()
    axes.set_xticks([])
    axes.set_yticks([])


class SideView:
    """Parallel projection along the world's x or y axis, whichever hides less of the motion of ``moved``, from the
    side of ``tracks`` that the camera is on; in the camera's own frame along x, since the camera looks along z."""

    def __init__(self, camera: Camera, tracks: Float[np.ndarray, "T M 3"], moved: Float[np.ndarray, "T K 3"]) -> None:
        self._R_world_up = R_world_up = up_from_world(camera).T
        self._names = ("x", "z", "−y") if world_is_camera_frame(camera) else ("x", "y", "z")
        reach = np.ptp(moved @ R_world_up, axis=0).max(0)
        self._across, self._along = (1, 0) if reach[1] >= reach[0] or world_is_camera_frame(camera) else (0, 1)
        place = camera.T_world_cam[:3, 3] @ R_world_up
        self._side = 1 if place[self._along] >= np.median((tracks[0] @ R_world_up)[:, self._along]) else -1

    @property
    def name(self) -> str:
        """The axis that one looks from, such as ``+x``."""
        return f"{'+' if self._side == 1 else '−'}{self._names[self._along]}"

    def project(self, xyz_world: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 2"]:
        """Across and up [m]."""
        flat: np.ndarray = (xyz_world @ self._R_world_up)[..., [self._across, 2]]
        return flat

    def depth(self, xyz_world: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch"]:
        """How far away [m] points are, against each other."""
        distance: np.ndarray = -self._side * (xyz_world @ self._R_world_up)[..., self._along]
        return distance

    def label(self, axes: Axes) -> None:
        """Turn axes as one sees them from here, and say what they are."""
        if (self._across == 1) != (self._side == 1):  # from -x, y points left; from +y, x does
            axes.invert_xaxis()
        axes.set_xlabel(f"{self._names[self._across]} [m]", color=QUIET, fontsize=LABEL_PT)
        axes.set_ylabel(f"{self._names[2]} [m]", color=QUIET, fontsize=LABEL_PT)
        axes.tick_params(length=0, labelsize=TICK_PT, labelcolor=QUIET)
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10]))
        axes.grid(color=GRID, linewidth=0.8)


def fit_limits(axes: Axes, points: Float[np.ndarray, "K 2"], margin: float) -> None:
    """Limits that hold all points, with the same scale both ways; but the ``margin`` percent on either side only
    if they are near the rest."""
    low, high = np.nanpercentile(points, [margin, 100 - margin], axis=0)
    near = 0.2 * (high - low)
    low, high = np.maximum(np.nanmin(points, 0), low - near), np.minimum(np.nanmax(points, 0), high + near)
    panel = axes.get_window_extent()
    size = np.array([panel.width, panel.height])
    half = size * max(float(((high - low) / size).max()), 1e-6) * 0.54
    (left, bottom), (right, top) = (low + high) / 2 - half, (low + high) / 2 + half
    axes.set(xlim=(left, right), ylim=(bottom, top))


def draw_cloud(
    axes: Axes,
    cloud: Float[np.ndarray, "P 2"],
    depth: Float[np.ndarray, "P"],
    rgb: UInt8[np.ndarray, "P 3"],
    size: float = 6.0,
) -> None:
    """Points in the plane of the axes, far ones first, pale and small: ``size`` is the least area [pt²]."""
    hide_frame(axes)
    axes.set_axisbelow(True)
    order = np.argsort(-depth)
    nearness = 1 - (depth - depth.min()) / max(float(np.ptp(depth)), 1e-9)
    pale = 1 - (1 - rgb / 255) * (0.5 + 0.3 * nearness)[:, None]
    area = size * (1 + 7 / 6 * nearness)
    axes.scatter(cloud[order, 0], cloud[order, 1], s=area[order], c=pale[order], linewidths=0, zorder=2)


def trail_lines(track: Float[np.ndarray, "T 2"], width: float = 1.2) -> LineCollection:
    """One track, colored by time; ``width`` is in points."""
    colors = TIME_COLORS(np.linspace(0, 1, max(len(track) - 1, 1)))
    pieces = np.stack([track[:-1], track[1:]], 1)
    return LineCollection(list(pieces), colors=colors, linewidths=width, capstyle="round", zorder=4)


def draw_time_bar(figure: Figure, end: float, label: str, *, whole: bool = False) -> None:
    """The legend of :data:`TIME_COLORS`, from 0 to ``end``, with ``whole`` numbers or any."""
    times = ScalarMappable(Normalize(0, max(end, 1e-9)), TIME_COLORS)
    bar = figure.colorbar(times, cax=figure.add_axes(BAR), ticks=MaxNLocator(6, integer=whole))
    bar.outline.set_visible(False)
    bar.set_label(label, color=QUIET, fontsize=LABEL_PT)
    bar.ax.tick_params(length=0, labelsize=TICK_PT, labelcolor=QUIET)


def draw_legend(figure: Figure, entries: Sequence[Line2D], length: float = 0.8, *, bottom: float = 0.078) -> None:
    """One line between panels and caption, from ``bottom`` up; lines in it are ``length`` letters long."""
    figure.legend(
        handles=entries, loc="lower left", bbox_to_anchor=(LEFT, bottom), ncols=len(entries), frameon=False,
        fontsize=9.5, labelcolor=INK, handlelength=length, handletextpad=0.5, columnspacing=1.7, borderpad=0,
        borderaxespad=0,
    )  # fmt: skip


def role_dots(episode: Episode) -> list[Line2D]:
    """A legend's entry for the role of every query point."""
    roles = np.unique(episode.query_role[: episode.queries.count])
    return [dot(role_name(role), tuple(role_rgb(role) / 255), "none") for role in roles]


def dot(label: str, color: ColorType, edge: str) -> Line2D:
    """A legend's entry of a round mark."""
    return Line2D([], [], linestyle="", marker="o", markersize=6, color=color, markeredgecolor=edge, label=label)
