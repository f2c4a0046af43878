"""An episode as one picture: where things are at first, and where they go."""

from pathlib import Path
from textwrap import shorten

import numpy as np
from jaxtyping import Float, Int
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from flowlab.records import Episode
from flowlab.viz.captions import caption, moving
from flowlab.viz.colors import SIGMA_LIMIT, cloud_rgb_at, role_rgb, sigma_rgb
from flowlab.viz.orientation import is_upside_down, project_upright
from flowlab.viz.panels import (
    LEFT,
    TIME_COLORS,
    SideView,
    dot,
    draw_cloud,
    draw_legend,
    draw_time_bar,
    fit_limits,
    role_dots,
    style_as_picture,
    trail_lines,
    two_panels,
)
from flowlab.viz.plot_style import ALARM, QUIET, label_text, plain_style, save_png, set_heading

TRAILS_PER_ROLE = 24
"""More trails than this hide each other."""


def draw_still(episode: Episode, path: Path, *, title: str, note: str = "") -> None:
    """Write a PNG of 1800 x 960 pixels. ``path`` is either absent, as before, or whole.

    ``note`` stands below the title, in red.
    """
    save_png(plot_still(episode, title, note), path)


@plain_style()
def plot_still(episode: Episode, title: str, note: str = "") -> Figure:
    """The figure of :func:`draw_still`. Its first two axes are the camera's view, in pixels of the camera
    turned upright, and the side view, in meters of the world frame."""
    figure, camera, side = two_panels(title, caption(episode, len(_drawn_trails(episode))))
    _draw_camera_view(camera, episode)
    _draw_side_view(side, episode)
    _draw_legend(figure, episode)
    draw_time_bar(figure, float(episode.time_s[-1]), "time [s]")
    figure.text(
        LEFT, 0.91, label_text(shorten(note, 170, placeholder=" …"), 180), fontsize=10, color=ALARM, va="center"
    )
    return figure


def _drawn_trails(episode: Episode) -> Int[np.ndarray, "K"]:
    """Moving query points whose trails are drawn: the first few of each role, which lie far apart."""
    role = episode.query_role[: episode.queries.count]
    moves = moving(episode)
    return np.concatenate([np.flatnonzero(moves & (role == r))[:TRAILS_PER_ROLE] for r in np.unique(role)])


def _draw_camera_view(axes: Axes, episode: Episode) -> None:
    """The first cloud and the tracks as the camera sees them."""
    cloud = episode.point_cloud[0, : episode.point_count[0]]
    depth = episode.camera.project(cloud)[1]
    tracks = project_upright(episode.camera, episode.tracks.xyz_world[:, : episode.queries.count])
    _draw_scene(axes, episode, project_upright(episode.camera, cloud), depth, tracks)
    style_as_picture(axes)
    turned = " (turned upright)" if is_upside_down(episode.camera) else ""
    set_heading(axes, f"first cloud and tracks, from the camera{turned}")


def _draw_side_view(axes: Axes, episode: Episode) -> None:
    """The same from the side that shows most of the motion."""
    cloud = episode.point_cloud[0, : episode.point_count[0]]
    tracks = episode.tracks.xyz_world[:, : episode.queries.count]
    moves = moving(episode)
    view = SideView(episode.camera, tracks, tracks[:, moves] if moves.any() else tracks)
    _draw_scene(axes, episode, view.project(cloud), view.depth(cloud), view.project(tracks))
    view.label(axes)
    set_heading(axes, f"the same, seen from {view.name}")


def _draw_scene(
    axes: Axes,
    episode: Episode,
    cloud: Float[np.ndarray, "P 2"],
    depth: Float[np.ndarray, "P"],
    tracks: Float[np.ndarray, "T M 2"],
) -> None:
    """The first cloud, far points first, and the tracks, in the plane of the axes."""
    margin = 0.0 if episode.tracks.quality is None else 0.5  # a point that got lost shall not shrink the rest
    fit_limits(axes, np.concatenate([cloud, tracks.reshape(-1, 2)]), margin)
    draw_cloud(axes, cloud, depth, cloud_rgb_at(episode, 0))
    still, drawn = ~moving(episode), _drawn_trails(episode)
    ink = _ink(episode)
    start, end = tracks[0].T, tracks[-1].T
    axes.scatter(start[0, still], start[1, still], 6, c=ink[still], linewidths=0, zorder=3)
    for k in drawn:
        axes.add_collection(trail_lines(tracks[:, k]), autolim=False)
    axes.scatter(start[0, drawn], start[1, drawn], 14, c="white", edgecolors=ink[drawn], linewidths=1, zorder=5)
    axes.scatter(end[0, drawn], end[1, drawn], 17, color=TIME_COLORS(1.0), edgecolors="white", linewidths=0.6, zorder=6)


def _ink(episode: Episode) -> Float[np.ndarray, "M 3"]:
    """The color of every distinct query point's dot: by its median stated error, or by role."""
    count, quality = episode.queries.count, episode.tracks.quality
    rgb = role_rgb(episode.query_role) if quality is None else sigma_rgb(np.median(quality.sigma, axis=0))
    return rgb[:count] / 255 * 0.8


def _draw_legend(figure: Figure, episode: Episode) -> None:
    """What marks and colors mean."""
    dots = role_dots(episode)
    if episode.tracks.quality is not None:
        sigmas = np.array([0, 0.5, 1]) * SIGMA_LIMIT
        names = [f"σ = {1000 * x:.0f} mm" for x in sigmas[:2]] + [f"≥ {1000 * SIGMA_LIMIT:.0f} mm"]
        dots = [dot(name, tuple(0.8 * sigma_rgb(x) / 255), "none") for name, x in zip(names, sigmas, strict=True)]
    dots += [dot("start", "white", QUIET), dot("end", TIME_COLORS(1.0), "none")]
    draw_legend(figure, dots)
