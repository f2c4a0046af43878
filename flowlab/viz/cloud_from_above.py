"""The first cloud of a recording from above: with it workspace, world axes, camera, and path of the gripper."""

from collections.abc import Sequence

import matplotlib.patheffects as effects
import numpy as np
from jaxtyping import Bool, Float64, UInt8
from matplotlib.axes import Axes
from matplotlib.patches import Polygon

from flowlab.perception.observer import Box
from flowlab.recordings.preview import CloudPreview
from flowlab.viz.orientation import up_from_world
from flowlab.viz.plot_style import INK, LABEL_PT, ORANGE, PURPLE, QUIET, TICK_PT, label_text, style_axes

_AXES_M = 0.15
_AROUND = 0.5
"""So much of the workspace's length is shown around it."""
_FAR_M = 4.0
"""What is farther from the middle of the cloud, and than the cloud is wide, is left out of the picture."""


def draw_cloud_from_above(axes: Axes, cloud: CloudPreview, crop: Box | None) -> None:
    """Draw the cloud with workspace, world axes, camera and gripper.

    Args:
        axes: Where to draw.
        cloud: The cloud.
        crop: The workspace, in the world frame; points outside are pale.
    """
    up = up_from_world(cloud.camera)
    xyz = cloud.xyz_world @ up.T
    heading, inside, near = "first cloud from above", np.ones(len(xyz), bool), xyz[:, :2]
    shown = [_draw_world(axes, up), _draw_camera(axes, cloud, up)]
    if crop is not None:
        low, high = np.array(crop.low), np.array(crop.high)
        inside = np.logical_and(cloud.xyz_world > low, cloud.xyz_world < high).all(axis=1, out=inside)
        heading += f", {inside.mean() if len(inside) else 0:.0%} of it in the workspace"
        shown.append(_draw_workspace(axes, np.array([low, high]) @ up.T))
        if inside.any():
            near = _around(near, shown[-1])
    _draw_points(axes, xyz, cloud.rgb, inside)
    if cloud.gripper_world is not None:
        shown.append(_draw_gripper(axes, cloud.gripper_world @ up.T, cloud.gripper_names))
    style_axes(axes, heading)
    names = ("x", "y") if up[1, 1] else ("x", "z, away from the camera")
    axes.set_xlabel(f"{names[0]} [m]", color=QUIET, fontsize=LABEL_PT)
    axes.set_ylabel(f"{names[1]} [m]", color=QUIET, fontsize=LABEL_PT)
    _set_limits(axes, [near, *shown])


def _draw_points(
    axes: Axes, xyz: Float64[np.ndarray, "P 3"], rgb: UInt8[np.ndarray, "P 3"], inside: Bool[np.ndarray, "P"]
) -> None:
    """The points, those outside of the workspace pale."""
    order = np.argsort(xyz[:, 2], kind="stable")  # what is higher hides what is below it
    drawn = np.where(inside[:, None], rgb, 255 - (255 - rgb.mean(1, keepdims=True)) * 0.3) / 255
    axes.scatter(xyz[order, 0], xyz[order, 1], 1.5, drawn[order], linewidths=0, rasterized=True)


def _draw_workspace(axes: Axes, corners: Float64[np.ndarray, "2 3"]) -> Float64[np.ndarray, "2 2"]:
    """The box of the workspace."""
    (x0, y0), (x1, y1) = corners.min(0)[:2], corners.max(0)[:2]
    box = [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]
    axes.add_patch(Polygon(box, fill=False, edgecolor=INK, linewidth=1.3, zorder=4))
    return np.array([(x0, y0), (x1, y1)])


def _around(places: Float64[np.ndarray, "P 2"], box: Float64[np.ndarray, "2 2"]) -> Float64[np.ndarray, "N 2"]:
    """Those in a box and around it, by as much as it is wide."""
    margin = np.ptp(box, axis=0).max() * _AROUND
    return places[((places > box[0] - margin) & (places < box[1] + margin)).all(1)]


def _set_limits(axes: Axes, shown: Sequence[Float64[np.ndarray, "N 2"]]) -> None:
    """Hold everything that is near the middle of the cloud, undistorted."""
    middle = np.median(shown[0], axis=0) if len(shown[0]) else np.zeros(2)
    extent = np.quantile(shown[0], [0.01, 0.99], axis=0) if len(shown[0]) else np.zeros((0, 2))
    places = np.concatenate([extent, *shown[1:]])
    far = max(_FAR_M, 2 * float(np.ptp(extent, axis=0).max())) if len(extent) else _FAR_M
    near = places[np.abs(places - middle).max(1) < far]
    low, high = (near.min(0), near.max(0)) if len(near) else (middle - 1, middle + 1)
    panel = np.array([axes.bbox.width, axes.bbox.height])
    half = 0.56 * panel * float(((high - low) / panel).max()) + 0.02
    middle = (low + high) / 2
    axes.set(xlim=(middle[0] - half[0], middle[0] + half[0]), ylim=(middle[1] - half[1], middle[1] + half[1]))
    axes.set_aspect("equal")


def _draw_world(axes: Axes, up: Float64[np.ndarray, "3 3"]) -> Float64[np.ndarray, "N 2"]:
    """The world's axes at its origin, as far as they are seen from above."""
    for name, way, color in zip("xyz", up.T, ("#d62f2f", "#239b45", "#2b5fd0"), strict=True):
        end = _AXES_M * way[:2]
        if np.hypot(*end) > 0.5 * _AXES_M:
            axes.annotate("", end, (0, 0), arrowprops={"arrowstyle": "-|>", "color": color, "linewidth": 1.8}, zorder=6)
            _label(axes, name, 1.2 * end, color)
    return np.zeros((1, 2))


def _draw_camera(axes: Axes, cloud: CloudPreview, up: Float64[np.ndarray, "3 3"]) -> Float64[np.ndarray, "N 2"]:
    """Where the camera is, and the borders of what it sees."""
    camera = cloud.camera
    middle = camera.T_world_cam[:3, 3] @ up.T
    sides = np.array([[0.0, (camera.height - 1) / 2], [camera.width - 1.0, (camera.height - 1) / 2]])
    ends = camera.unproject(sides, np.full(2, 0.25)) @ up.T
    for end in ends:
        axes.plot([middle[0], end[0]], [middle[1], end[1]], color=PURPLE, linewidth=1.4, zorder=5)
    axes.plot(*middle[:2], "o", color=PURPLE, markersize=6, zorder=6)
    _label(axes, "camera", middle[:2], PURPLE, below_pt=6)
    path = middle[None] if cloud.camera_path_world is None else cloud.camera_path_world @ up.T
    axes.plot(*path[:, :2].T, color=PURPLE, linewidth=0.9, alpha=0.6, zorder=5)
    return np.concatenate([path[:, :2], ends[:, :2]])


def _draw_gripper(axes: Axes, path: Float64[np.ndarray, "T 3"], names: str) -> Float64[np.ndarray, "T 2"]:
    """The path of the gripper, from a ring to a dot."""
    halo = [effects.withStroke(linewidth=3.5, foreground="white")]
    axes.plot(path[:, 0], path[:, 1], color=ORANGE, linewidth=1.8, zorder=7, path_effects=halo)
    axes.plot(*path[0, :2], "o", markerfacecolor="white", markeredgecolor=ORANGE, markersize=6, zorder=8)
    axes.plot(*path[-1, :2], "o", color=ORANGE, markersize=6, zorder=8)
    _label(axes, f"gripper ({names})", path[-1, :2], ORANGE, below_pt=6)
    return path[:, :2]


def _label(axes: Axes, text: str, place: np.ndarray, color: str, *, below_pt: float = 0) -> None:
    """A word at a place, legible on anything, and never outside the panel."""
    halo = [effects.withStroke(linewidth=2.5, foreground="white")]
    axes.annotate(
        label_text(text, 40), (place[0], place[1]), (0, -below_pt), textcoords="offset points", color=color,
        fontsize=TICK_PT, ha="center", va="top" if below_pt else "center", zorder=9, path_effects=halo,
        annotation_clip=True, clip_on=True,
    )  # fmt: skip
