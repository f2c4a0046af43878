"""An episode as one picture: where things are at first, and where they go."""

import os
from pathlib import Path
from textwrap import shorten

import numpy as np
from jaxtyping import Float, Int
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from matplotlib.typing import ColorType

from flowlab.records import Episode
from flowlab.storage.files import temporary_path
from flowlab.viz.colours import SIGMA_LIMIT, cloud_rgb_at, role_rgb, sigma_rgb
from flowlab.viz.facts import caption, moving, role_name
from flowlab.viz.upright import hangs, in_camera_frame, up_from_world, upright_pixels

TIME_COLOURS = LinearSegmentedColormap.from_list("time", ["#3b1f8f", "#a3218e", "#e2486a", "#f58a3c", "#f7bf3a"])
"""From the first step to the last: distinct from grey and readable on white."""
TRAILS_PER_ROLE = 24
"""More trails than this hide each other."""
_LEFT = 0.025
_INK, _QUIET, _ALARM = "#22262c", "#747b85", "#c2263b"
_SIZE_IN = (12.0, 6.4)
_DPI = 150
_BOXES = {"camera": (_LEFT, 0.145, 0.43, 0.70), "side": (0.525, 0.145, 0.40, 0.70), "bar": (0.945, 0.145, 0.009, 0.70)}
"""Left, bottom, width and height of each panel, as shares of the picture."""


def draw_still(episode: Episode, path: Path, *, title: str, note: str = "") -> None:
    """Write a PNG of 1800 x 960 pixels. ``path`` is either absent, as before, or whole.

    ``note`` stands below the title, in red.
    """
    temporary = temporary_path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        compose(episode, title, note).savefig(temporary, format="png", facecolor="white")
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def compose(episode: Episode, title: str, note: str = "") -> Figure:
    """The figure of :func:`draw_still`. Its first two axes are the camera's view, in pixels of the camera
    turned upright, and the side view, in metres of the world frame."""
    figure = Figure(figsize=_SIZE_IN, dpi=_DPI)
    FigureCanvasAgg(figure)
    _draw_camera_view(figure.add_axes(_BOXES["camera"]), episode)
    _draw_side_view(figure.add_axes(_BOXES["side"]), episode)
    _draw_legend(figure, episode)
    seconds = Normalize(0, max(episode.time_s[-1], 1e-9))
    bar = figure.colorbar(
        ScalarMappable(seconds, TIME_COLOURS), cax=figure.add_axes(_BOXES["bar"]), ticks=MaxNLocator(6)
    )
    bar.outline.set_visible(False)
    bar.set_label("time [s]", color=_QUIET, fontsize=9)
    bar.ax.tick_params(length=0, labelsize=8.5, labelcolor=_QUIET)
    figure.text(_LEFT, 0.955, title, fontsize=17, weight="bold", color=_INK, va="center")
    figure.text(_LEFT, 0.91, shorten(note, 170, placeholder=" …"), fontsize=10, color=_ALARM, va="center")
    figure.text(_LEFT, 0.038, caption(episode, len(_drawn_trails(episode))), fontsize=9.5, color=_QUIET, va="center")
    return figure


def _drawn_trails(episode: Episode) -> Int[np.ndarray, "K"]:
    """Moving query points whose trails are drawn: the first few of each role, which lie far apart."""
    role = episode.query_role[: episode.queries.count]
    moves = moving(episode)
    return np.concatenate([np.flatnonzero(moves & (role == r))[:TRAILS_PER_ROLE] for r in np.unique(role)])


def _draw_camera_view(axes: Axes, episode: Episode) -> None:
    cloud = episode.point_cloud[0, : episode.point_count[0]]
    depth = episode.camera.project(cloud)[1]
    tracks = upright_pixels(episode.camera, episode.tracks.xyz_world[:, : episode.queries.count])
    _draw_scene(axes, episode, upright_pixels(episode.camera, cloud), depth, tracks)
    axes.invert_yaxis()
    axes.set_xticks([])
    axes.set_yticks([])
    _head(axes, "first cloud and tracks, from the camera" + (" (turned upright)" if hangs(episode.camera) else ""))


def _draw_side_view(axes: Axes, episode: Episode) -> None:
    """Parallel projection along the world's x or y axis, whichever hides less of the motion, from the side
    that the camera is on; in the camera's own frame along x, since the other panel looks along z."""
    R_world_up = up_from_world(episode.camera).T
    names = ("x", "z", "−y") if in_camera_frame(episode.camera) else ("x", "y", "z")
    cloud = episode.point_cloud[0, : episode.point_count[0]] @ R_world_up
    tracks = episode.tracks.xyz_world[:, : episode.queries.count] @ R_world_up
    moved = np.ptp(tracks[:, moving(episode)] if moving(episode).any() else tracks, axis=0).max(0)
    across, along = (1, 0) if moved[1] >= moved[0] or in_camera_frame(episode.camera) else (0, 1)
    camera = episode.camera.T_world_cam[:3, 3] @ R_world_up
    side = 1 if camera[along] >= np.median(tracks[0, :, along]) else -1
    _draw_scene(axes, episode, cloud[:, [across, 2]], -side * cloud[:, along], tracks[..., [across, 2]])
    if (across == 1) != (side == 1):  # from -x, y points left; from +y, x does
        axes.invert_xaxis()
    axes.set_xlabel(f"{names[across]} [m]", color=_QUIET, fontsize=9)
    axes.set_ylabel(f"{names[2]} [m]", color=_QUIET, fontsize=9)
    axes.tick_params(length=0, labelsize=8.5, labelcolor=_QUIET)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10]))
    axes.grid(color="#eceef1", linewidth=0.8)
    _head(axes, f"the same, seen from {'+' if side == 1 else '−'}{names[along]}")


def _head(axes: Axes, text: str) -> None:
    axes.set_title(text, loc="left", fontsize=10.5, color=_INK, pad=10)


def _draw_scene(
    axes: Axes,
    episode: Episode,
    cloud: Float[np.ndarray, "P 2"],
    away: Float[np.ndarray, "P"],
    tracks: Float[np.ndarray, "T M 2"],
) -> None:
    """The first cloud, far points first, and the tracks, in the plane of the axes."""
    for spine in axes.spines.values():
        spine.set_visible(False)
    axes.set_axisbelow(True)
    margin = 0.0 if episode.tracks.quality is None else 0.5  # a point that got lost shall not shrink the rest
    _fit(axes, np.concatenate([cloud, tracks.reshape(-1, 2)]), margin)
    order = np.argsort(-away)
    nearness = 1 - (away - away.min()) / max(float(np.ptp(away)), 1e-9)
    rgb = 1 - (1 - cloud_rgb_at(episode, 0) / 255) * (0.5 + 0.3 * nearness)[:, None]
    axes.scatter(cloud[order, 0], cloud[order, 1], s=(6 + 7 * nearness)[order], c=rgb[order], linewidths=0, zorder=2)

    still, drawn = ~moving(episode), _drawn_trails(episode)
    ink = _ink(episode)
    start, end = tracks[0].T, tracks[-1].T
    axes.scatter(start[0, still], start[1, still], 6, c=ink[still], linewidths=0, zorder=3)
    for k in drawn:
        axes.add_collection(_trail(tracks[:, k]), autolim=False)
    axes.scatter(start[0, drawn], start[1, drawn], 14, c="white", edgecolors=ink[drawn], linewidths=1, zorder=5)
    axes.scatter(
        end[0, drawn], end[1, drawn], 17, color=TIME_COLOURS(1.0), edgecolors="white", linewidths=0.6, zorder=6
    )


def _ink(episode: Episode) -> Float[np.ndarray, "M 3"]:
    """The colour of every distinct query point's dot: by its median stated error, or by role."""
    count, quality = episode.queries.count, episode.tracks.quality
    rgb = role_rgb(episode.query_role) if quality is None else sigma_rgb(np.median(quality.sigma, axis=0))
    return rgb[:count] / 255 * 0.8


def _trail(track: Float[np.ndarray, "T 2"]) -> LineCollection:
    """One track, coloured by time."""
    colours = TIME_COLOURS(np.linspace(0, 1, max(len(track) - 1, 1)))
    pieces = np.stack([track[:-1], track[1:]], 1)
    return LineCollection(list(pieces), colors=colours, linewidths=1.2, capstyle="round", zorder=4)


def _fit(axes: Axes, points: Float[np.ndarray, "K 2"], margin: float) -> None:
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


def _draw_legend(figure: Figure, episode: Episode) -> None:
    roles = np.unique(episode.query_role[: episode.queries.count])
    dots = [_dot(role_name(role), tuple(role_rgb(role) / 255), "none") for role in roles]
    if episode.tracks.quality is not None:
        sigmas = np.array([0, 0.5, 1]) * SIGMA_LIMIT
        names = [f"σ = {1000 * x:.0f} mm" for x in sigmas[:2]] + [f"≥ {1000 * SIGMA_LIMIT:.0f} mm"]
        dots = [_dot(name, tuple(0.8 * sigma_rgb(x) / 255), "none") for name, x in zip(names, sigmas, strict=True)]
    dots += [_dot("start", "white", _QUIET), _dot("end", TIME_COLOURS(1.0), "none")]
    figure.legend(
        handles=dots, loc="lower left", bbox_to_anchor=(_LEFT, 0.078), ncols=len(dots), frameon=False,
        fontsize=9.5, labelcolor=_INK, handlelength=0.8, handletextpad=0.5, columnspacing=1.8, borderpad=0,
        borderaxespad=0,
    )  # fmt: skip


def _dot(label: str, colour: ColorType, edge: str) -> Line2D:
    return Line2D([], [], linestyle="", marker="o", markersize=6, color=colour, markeredgecolor=edge, label=label)
