"""An episode as one picture: where things are at first, and where they go."""

from pathlib import Path
from textwrap import shorten

import numpy as np
from jaxtyping import Float, Int
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from flowlab.records import Episode
from flowlab.viz.captions import caption, moving
from flowlab.viz.colors import cloud_rgb_at, role_rgb
from flowlab.viz.error_marks import draw_error_circles, draw_share_bar, error_color, error_legend, error_trail
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
from flowlab.viz.plot_style import ALARM, INK, QUIET, label_text, plain_style, save_png, set_heading
from flowlab.viz.stated_error import COARSE_M, MOST_DRAWN_M, stated_sigma

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
    if (sigma := stated_sigma(episode)) is None:
        draw_time_bar(figure, float(episode.time_s[-1]), "time [s]")
    else:
        draw_share_bar(figure, sigma)
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
    end_z = episode.camera.project(episode.tracks.xyz_world[-1, : episode.queries.count])[1]
    unit = episode.camera.K[0, 0] / np.where(end_z > 0, end_z, np.nan)
    _draw_scene(axes, episode, project_upright(episode.camera, cloud), depth, tracks, unit)
    style_as_picture(axes)
    turned = " (turned upright)" if is_upside_down(episode.camera) else ""
    set_heading(axes, f"first cloud and tracks, from the camera{turned}")


def _draw_side_view(axes: Axes, episode: Episode) -> None:
    """The same from the side that shows most of the motion."""
    cloud = episode.point_cloud[0, : episode.point_count[0]]
    tracks = episode.tracks.xyz_world[:, : episode.queries.count]
    moves = moving(episode)
    view = SideView(episode.camera, tracks, tracks[:, moves] if moves.any() else tracks)
    _draw_scene(axes, episode, view.project(cloud), view.depth(cloud), view.project(tracks), np.ones(tracks.shape[1]))
    view.label(axes)
    set_heading(axes, f"the same, seen from {view.name}")


def _draw_scene(
    axes: Axes,
    episode: Episode,
    cloud: Float[np.ndarray, "P 2"],
    depth: Float[np.ndarray, "P"],
    tracks: Float[np.ndarray, "T M 2"],
    unit: Float[np.ndarray, "M"],
) -> None:
    """The first cloud, far points first, and the tracks, in the plane of the axes, where a meter at the end of each
    track has a length ``unit``."""
    sigma = stated_sigma(episode)
    margin = 0.0 if sigma is None else 0.5  # a point that got lost shall not shrink the rest
    fit_limits(axes, np.concatenate([cloud, tracks.reshape(-1, 2)]), margin)
    draw_cloud(axes, cloud, depth, cloud_rgb_at(episode, 0))
    still = ~moving(episode)
    axes.scatter(tracks[0, still, 0], tracks[0, still, 1], 6, c=_ink(episode)[still], linewidths=0, zorder=3)
    if sigma is None:
        _draw_exact_trails(axes, episode, tracks)
    else:
        _draw_estimated_trails(axes, episode, tracks, sigma, unit)


def _draw_exact_trails(axes: Axes, episode: Episode, tracks: Float[np.ndarray, "T M 2"]) -> None:
    """The trails of points that move, colored by time."""
    drawn = _drawn_trails(episode)
    (start_u, start_v), (end_u, end_v) = tracks[0, drawn].T, tracks[-1, drawn].T
    for k in drawn:
        axes.add_collection(trail_lines(tracks[:, k]), autolim=False)
    axes.scatter(start_u, start_v, 14, c="white", edgecolors=_ink(episode)[drawn], linewidths=1, zorder=5)
    axes.scatter(end_u, end_v, 17, color=TIME_COLORS(1.0), edgecolors="white", linewidths=0.6, zorder=6)


def _draw_estimated_trails(
    axes: Axes,
    episode: Episode,
    tracks: Float[np.ndarray, "T M 2"],
    sigma: Float[np.ndarray, "T M"],
    unit: Float[np.ndarray, "M"],
) -> None:
    """The trails of points that move, colored by stated error; where that is large, a circle around their ends."""
    drawn, visible = _drawn_trails(episode), episode.tracks.visible
    for k in drawn:
        axes.add_collection(error_trail(tracks[:, k], sigma[:, k], visible[:, k]), autolim=False)
    draw_error_circles(
        axes, tracks[-1, drawn], np.minimum(sigma[-1, drawn], MOST_DRAWN_M) * unit[drawn], sigma[-1, drawn]
    )
    (start_u, start_v), (end_u, end_v) = tracks[0, drawn].T, tracks[-1, drawn].T
    axes.scatter(start_u, start_v, 10, c="white", edgecolors=QUIET, linewidths=0.8, zorder=5)
    seen, ink = visible[-1, drawn], error_color(sigma[-1, drawn])
    axes.scatter(end_u[seen], end_v[seen], 20, c=ink[seen], edgecolors="white", linewidths=1, zorder=6)
    axes.scatter(end_u[~seen], end_v[~seen], 16, c="white", edgecolors=ink[~seen], linewidths=1, zorder=6)


def _ink(episode: Episode) -> Float[np.ndarray, "M 3"]:
    """The color of every distinct query point's dot: by its median stated error, or by role."""
    sigma = stated_sigma(episode)
    if sigma is not None:
        return error_color(np.median(sigma, axis=0))
    return role_rgb(episode.query_role[: episode.queries.count]) / 255 * 0.8


def _draw_legend(figure: Figure, episode: Episode) -> None:
    """What marks and colors mean."""
    sigma = stated_sigma(episode)
    if sigma is None:
        draw_legend(figure, [*role_dots(episode), dot("start", "white", QUIET), dot("end", TIME_COLORS(1.0), "none")])
        return
    marks = [dot("start", "white", QUIET), dot("end", INK, "none"), dot("end, out of sight", "white", INK)]
    circle = dot(f"radius σ, {1000 * COARSE_M:.0f} to {1000 * MOST_DRAWN_M:.0f} mm", "none", INK)
    circle.set_markersize(11)
    draw_legend(figure, [*error_legend(sigma), *marks, circle], bottom=0.06)
