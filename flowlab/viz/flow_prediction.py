"""Predicted flow as one picture: where a policy's plan predicts points to go, and where they went."""

from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from flowlab.errors import DataError
from flowlab.records import Episode, FlowPrediction, Role
from flowlab.viz.colors import cloud_rgb_at, role_rgb
from flowlab.viz.orientation import is_upside_down, project_upright
from flowlab.viz.panels import (
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
from flowlab.viz.plan_predictions import PlanPrediction, largest_predicted_motion, plan_predictions
from flowlab.viz.plot_style import INK, QUIET, plain_style, save_png, set_heading

PATHS_PER_ROLE = 30
"""More paths than this hide each other."""
_AROUND_ALL, _AROUND_OBJECTS = 0.08, 0.45
"""How much is shown around the paths on every side, as a share of their extent."""


def draw_flow_prediction(
    episode: Episode, prediction: FlowPrediction, path: Path, *, title: str, plan: int | None = None
) -> None:
    """Write a PNG of 1800 x 960 pixels. ``path`` is either absent, as before, or whole.

    ``plan`` counts the plans of the episode from 0; by default it is the one that predicts the objects to move
    farthest. Raises :class:`DataError` where there is no such plan.
    """
    save_png(plot_flow_prediction(episode, prediction, title, plan), path)


@plain_style()
def plot_flow_prediction(episode: Episode, prediction: FlowPrediction, title: str, plan: int | None = None) -> Figure:
    """The figure of :func:`draw_flow_prediction`. Its first two axes are the camera's view, in pixels of the camera
    turned upright, and the side view, in meters of the world frame."""
    plans = plan_predictions(episode, prediction)
    if not -1 < (plan or 0) < len(plans):
        raise DataError(
            f"{episode.task}, seed {episode.seed}: no plan {plan or 0}; there are {len(plans)}, counted from 0"
        )
    shown = plans[largest_predicted_motion(episode, plans) if plan is None else plan]
    drawn = _drawn_paths(episode, shown)
    figure, camera, side = two_panels(title, _caption(episode, shown, len(drawn)))
    cloud = episode.point_cloud[shown.step, : episode.point_count[shown.step]]

    pixels = [project_upright(episode.camera, x) for x in (cloud, shown.predicted_world, shown.true_world)]
    _fit_to(camera, pixels, drawn, _AROUND_ALL)
    _draw_scene(camera, episode, shown, drawn, pixels, episode.camera.project(cloud)[1])
    style_as_picture(camera)
    turned = " (turned upright)" if is_upside_down(episode.camera) else ""
    set_heading(camera, f"cloud of step {shown.step} and predicted flow, from the camera{turned}")

    near = drawn[episode.query_role[drawn] == Role.OBJECT]
    close = near if len(near) else drawn
    paths = shown.predicted_world
    view = SideView(episode.camera, paths, paths[:, close] if len(close) else paths)
    flat = [view.project(x) for x in (cloud, paths, shown.true_world)]
    _fit_to(side, flat, close, _AROUND_OBJECTS)
    _draw_scene(side, episode, shown, drawn, flat, view.depth(cloud), 1.6)
    view.label(side)
    set_heading(side, f"{'close-up of the objects' if len(near) else 'the same'}, seen from {view.name}")

    _draw_legend(figure, episode)
    draw_time_bar(figure, len(shown.predicted_world) - 1, "steps after the plan", whole=True)
    return figure


def _drawn_paths(episode: Episode, plan: PlanPrediction) -> Int[np.ndarray, "N"]:
    """Points predicted to move whose paths are drawn: the first few of each role, which lie far apart."""
    role = episode.query_role[: episode.queries.count]
    return np.concatenate(
        [np.flatnonzero(plan.predicted_moving & (role == r))[:PATHS_PER_ROLE] for r in np.unique(role)]
    )


def _caption(episode: Episode, plan: PlanPrediction, shown: int) -> str:
    """A plan in one line: its errors, and how much of it is shown."""
    moves, n_action_steps = int(plan.moving.sum()), len(plan.true_world) - 1
    error = f"ADE {1000 * plan.error.mean():.1f} mm, FDE {1000 * plan.error[-1].mean():.1f} mm" if moves else ""
    parts = [
        f"{episode.task}, seed {episode.seed}",
        f"plan of step {plan.step}, {n_action_steps} of its {len(plan.predicted_world) - 1} steps executed",
        f"{error} over {moves} moving points" if moves else "no point moves",
        f"{shown} of {int(plan.predicted_moving.sum())} predicted paths shown",
    ]
    return "   ·   ".join(parts)


def _fit_to(axes: Axes, flat: list[Float[np.ndarray, "..."]], points: Int[np.ndarray, "N"], around: float) -> None:
    """Let the predicted and true paths of some points fill the panel but for a share ``around``; or else the cloud."""
    cloud, predicted, true = flat
    paths = np.concatenate([predicted[:, points], true[:, points]]).reshape(-1, 2) if len(points) else cloud
    low, high = np.nanmin(paths, 0), np.nanmax(paths, 0)
    margin = around * (high - low).max()
    fit_limits(axes, np.stack([low - margin, high + margin]), 0)


def _draw_scene(
    axes: Axes,
    episode: Episode,
    plan: PlanPrediction,
    drawn: Int[np.ndarray, "N"],
    flat: list[Float[np.ndarray, "..."]],
    depth: Float[np.ndarray, "P"],
    enlarged: float = 1.0,
) -> None:
    """Cloud, predicted and true paths, which ``flat`` holds in the plane of the axes."""
    cloud, predicted, true = flat
    draw_cloud(axes, cloud, depth, cloud_rgb_at(episode, plan.step), 12 * enlarged**2)

    ink = role_rgb(episode.query_role[: episode.queries.count]) / 255 * 0.8
    still = ~plan.predicted_moving
    start, end, true_end = predicted[0].T, predicted[-1, drawn].T, true[-1, drawn].T
    axes.scatter(start[0, still], start[1, still], 9, c=ink[still], linewidths=0, zorder=3)
    for k in drawn:
        axes.add_collection(trail_lines(predicted[:, k], 3.2), autolim=False)
    for width, color in ((1.5, "white"), (0.8, INK)):
        taken = LineCollection([*true[:, drawn].swapaxes(0, 1)], colors=color, linewidths=width, zorder=5)
        axes.add_collection(taken, autolim=False)
    axes.scatter(start[0, drawn], start[1, drawn], 14, c="white", edgecolors=ink[drawn], linewidths=1, zorder=6)
    axes.scatter(end[0], end[1], 20, color=TIME_COLORS(1.0), edgecolors="white", linewidths=0.6, zorder=7)
    axes.scatter(true_end[0], true_end[1], 7, color=INK, linewidths=0, zorder=8)


def _draw_legend(figure: Figure, episode: Episode) -> None:
    """What marks and lines mean."""
    true = Line2D([], [], color=INK, linewidth=0.9, marker="o", markersize=3.5, markevery=[1], label="true path")
    marks = [dot("start", "white", QUIET), dot("predicted end", TIME_COLORS(1.0), "none")]
    draw_legend(figure, [*role_dots(episode), *marks, true], length=1.4)
