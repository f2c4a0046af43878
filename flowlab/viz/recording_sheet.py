"""A sheet of a recording before it is labeled: pictures with depth edges, cloud from above, streams, verdicts."""

import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib.patheffects as effects
import numpy as np
from jaxtyping import Float64
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon

from flowlab.perception.observer import Box
from flowlab.recordings.preview import CloudPreview, PicturePreview, RecordingPreview, StreamPreview
from flowlab.recordings.sync import sampling_rate
from flowlab.recordings.verdicts import Check, Verdict
from flowlab.viz.orientation import up_from_world
from flowlab.viz.plot_style import (
    ALARM,
    BLUE,
    GREEN,
    GRID,
    INK,
    LABEL_PT,
    ORANGE,
    PURPLE,
    QUIET,
    TICK_PT,
    label_text,
    new_figure,
    plain_style,
    save_png,
    set_heading,
    set_title,
    style_axes,
)

_WIDTH_IN, _MARGIN_IN, _GUTTER_IN = 15.0, 0.3, 0.25
_TITLE_IN, _HEADING_IN, _AXIS_IN = 0.75, 0.4, 0.6
_CLOUD_IN, _LABELS_IN, _TEXT_LEFT_IN = 5.6, 1.9, 6.6
_LINE_IN, _STREAM_IN = 0.165, 0.27
_VERDICT_IN, _ABOUT_IN = 0.85, 1.45
_CHARACTERS = 108
"""Of a line of what checks say."""
_MOST_LINES = 60
_MOST_STREAMS = 12
_MOST_MARKS = 2500
"""Samples of a stream that are nearer to each other than the axis can show are drawn as one."""
_EDGE_RGB = (255, 40, 200)
_COLORS = {Verdict.REFUSED: ALARM, Verdict.DOUBTFUL: ORANGE, Verdict.ASSUMED: BLUE, Verdict.OK: GREEN}
_ORDER = tuple(reversed(Verdict))
"""The worst first."""
_AXES_M = 0.15
_FAR_M = 4.0
"""What is farther from the middle of the cloud is left out of the picture."""


@dataclass(frozen=True, slots=True)
class _Row:
    """One row of text about the checks."""

    verdict: Verdict
    about: str
    lines: tuple[str, ...]


def draw_recording_sheet(
    preview: RecordingPreview,
    path: Path,
    *,
    title: str,
    checks: Sequence[Check] = (),
    problem: str | None = None,
    crop: Box | None = None,
) -> None:
    """Write a PNG of :func:`plot_recording_sheet`; ``path`` is either absent, as before, or whole."""
    save_png(plot_recording_sheet(preview, title, checks, problem, crop), path)


@plain_style()
def plot_recording_sheet(
    preview: RecordingPreview, title: str, checks: Sequence[Check], problem: str | None, crop: Box | None
) -> Figure:
    """The figure of a recording, as far as it could be read.

    Args:
        preview: What can be shown of it.
        title: What is said above.
        checks: What was looked at; the worst is said first.
        problem: Why it cannot be used, if it cannot.
        crop: The workspace, in the world frame.
    """
    rows = list(_rows(checks, problem))
    streams = preview.streams[:_MOST_STREAMS]
    picture_in = _picture_height(preview.pictures)
    middle_in = max(4.6 if preview.cloud else 0.8, _LINE_IN * sum(len(r.lines) + 0.35 for r in rows))
    parts = [_TITLE_IN, picture_in + _HEADING_IN, middle_in + _HEADING_IN + _AXIS_IN]
    parts.append(_STREAM_IN * len(streams) + _HEADING_IN + _AXIS_IN if streams else 0.15)
    figure = new_figure(_WIDTH_IN, sum(parts))
    set_title(figure, title)
    tops = np.cumsum(parts) - parts
    for k, picture in enumerate(preview.pictures):
        wide = _panel_width()
        left = _MARGIN_IN + k * (wide + _GUTTER_IN)
        _draw_picture(_place(figure, left, tops[1] + _HEADING_IN, wide, picture_in), picture)
    if preview.cloud is not None:
        _draw_cloud(_place(figure, 0.75, tops[2] + _HEADING_IN, _CLOUD_IN - 0.45, middle_in), preview.cloud, crop)
    _write_checks(figure, rows, tops[2] + 0.12, _TEXT_LEFT_IN if preview.cloud is not None else _MARGIN_IN)
    if streams:
        wide = _WIDTH_IN - _LABELS_IN - _MARGIN_IN
        axes = _place(figure, _LABELS_IN, tops[3] + _HEADING_IN, wide, _STREAM_IN * len(streams))
        _draw_streams(axes, streams, len(preview.streams))
    return figure


def _place(figure: Figure, left: float, top: float, width: float, height: float) -> Axes:
    """Axes at a place that is measured from the upper left corner [in]."""
    wide, tall = figure.get_size_inches()
    return figure.add_axes((left / wide, 1 - (top + height) / tall, width / wide, height / tall))


# --- pictures ---------------------------------------------------------------------------------------------


def _panel_width() -> float:
    return (_WIDTH_IN - 2 * _MARGIN_IN - 2 * _GUTTER_IN) / 3


def _picture_height(pictures: Sequence[PicturePreview]) -> float:
    """As high as the highest picture at full width, within reason."""
    if not pictures:
        return 0.0
    return float(min(5.0, _panel_width() * max(p.rgb.shape[0] / p.rgb.shape[1] for p in pictures)))


def _draw_picture(axes: Axes, picture: PicturePreview) -> None:
    """A color picture, depth edges over it."""
    drawn = picture.rgb.copy()
    if picture.edges is not None:
        drawn[picture.edges] = _EDGE_RGB
    axes.imshow(drawn, interpolation="nearest", aspect="equal")
    axes.set_axis_off()
    when = "" if picture.time_s is None else f"{picture.time_s:.2f} s   "
    edges = "" if picture.edges is not None else "   (no depth drawn over)"
    set_heading(axes, f"{when}{picture.name}{edges}")


# --- cloud ------------------------------------------------------------------------------------------------


def _draw_cloud(axes: Axes, cloud: CloudPreview, crop: Box | None) -> None:
    """The cloud from above, with workspace, world axes, camera and gripper."""
    up = up_from_world(cloud.camera)
    xyz = cloud.xyz_world @ up.T
    inside = np.ones(len(xyz), bool)
    shown = [xyz[:, :2]]
    if crop is not None:
        low, high = np.array(crop.low), np.array(crop.high)
        inside = ((cloud.xyz_world > low) & (cloud.xyz_world < high)).all(1)
    order = np.argsort(xyz[:, 2], kind="stable")  # what is higher hides what is below it
    rgb = np.where(inside[:, None], cloud.rgb, 255 - (255 - cloud.rgb.mean(1, keepdims=True)) * 0.3) / 255
    axes.scatter(xyz[order, 0], xyz[order, 1], 1.2, rgb[order], linewidths=0, rasterized=True)
    if crop is not None:
        corners = np.array([[low[0], low[1], low[2]], [high[0], high[1], high[2]]]) @ up.T
        (x0, y0), (x1, y1) = corners.min(0)[:2], corners.max(0)[:2]
        axes.add_patch(
            Polygon([(x0, y0), (x1, y0), (x1, y1), (x0, y1)], fill=False, edgecolor=INK, linewidth=1.3, zorder=4)
        )
        shown.append(np.array([(x0, y0), (x1, y1)]))
    shown += [_draw_world(axes, up), _draw_camera(axes, cloud, up)]
    if cloud.gripper_world is not None:
        shown.append(_draw_gripper(axes, cloud.gripper_world @ up.T, cloud.gripper_names))
    heading = "first cloud from above"
    if crop is not None:
        heading += f"; {inside.mean() if len(inside) else 0:.0%} of its points are in the workspace"
    style_axes(axes, heading)
    names = ("x", "y") if up[1, 1] else ("x", "z, away from the camera")
    axes.set_xlabel(f"{names[0]} [m]", color=QUIET, fontsize=LABEL_PT)
    axes.set_ylabel(f"{names[1]} [m]", color=QUIET, fontsize=LABEL_PT)
    _set_limits(axes, shown)


def _set_limits(axes: Axes, shown: Sequence[Float64[np.ndarray, "N 2"]]) -> None:
    """Hold everything that is near the middle of the cloud, undistorted."""
    middle = np.median(shown[0], axis=0) if len(shown[0]) else np.zeros(2)
    places = np.concatenate([np.quantile(shown[0], [0.01, 0.99], axis=0) if len(shown[0]) else shown[0], *shown[1:]])
    near = places[np.abs(places - middle).max(1) < _FAR_M]
    low, high = (near.min(0), near.max(0)) if len(near) else (middle - 1, middle + 1)
    margin = 0.06 * float((high - low).max()) + 0.02
    axes.set(xlim=(low[0] - margin, high[0] + margin), ylim=(low[1] - margin, high[1] + margin))
    axes.set_aspect("equal", adjustable="datalim")


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
    _label(axes, "camera", middle[:2], PURPLE, above=True)
    return np.concatenate([middle[None, :2], ends[:, :2]])


def _draw_gripper(axes: Axes, path: Float64[np.ndarray, "T 3"], names: str) -> Float64[np.ndarray, "T 2"]:
    """The path of the gripper, from a ring to a dot."""
    halo = [effects.withStroke(linewidth=3.5, foreground="white")]
    axes.plot(path[:, 0], path[:, 1], color=ORANGE, linewidth=1.8, zorder=7, path_effects=halo)
    axes.plot(*path[0, :2], "o", markerfacecolor="white", markeredgecolor=ORANGE, markersize=6, zorder=8)
    axes.plot(*path[-1, :2], "o", color=ORANGE, markersize=6, zorder=8)
    _label(axes, f"gripper ({names})", path[-1, :2], ORANGE, above=True)
    return path[:, :2]


def _label(axes: Axes, text: str, place: Sequence[float], color: str, *, above: bool = False) -> None:
    """A word at a place, legible on anything, and never outside the panel."""
    halo = [effects.withStroke(linewidth=2.5, foreground="white")]
    axes.annotate(
        label_text(text, 40), place, (0, 7 if above else 0), textcoords="offset points", color=color, fontsize=TICK_PT,
        ha="center", va="bottom" if above else "center", zorder=9, path_effects=halo, annotation_clip=True, clip_on=True,
    )  # fmt: skip


# --- checks -----------------------------------------------------------------------------------------------


def _rows(checks: Sequence[Check], problem: str | None) -> Iterator[_Row]:
    """What is said of the checks, the worst first, as much of it as there is room for."""
    refused = [c.says for c in checks if c.verdict is Verdict.REFUSED]
    told = sorted(checks, key=lambda c: _ORDER.index(c.verdict))
    if problem and not any(says in problem for says in refused):
        told.insert(0, Check("problem", Verdict.REFUSED, problem))
    room = _MOST_LINES
    for k, check in enumerate(told):
        lines = tuple(textwrap.wrap(label_text(check.says, 8 * _CHARACTERS), _CHARACTERS)) or ("",)
        if room < len(lines):
            yield _Row(check.verdict, "", (f"and {len(told) - k} more; --json has all",))
            return
        room -= len(lines)
        yield _Row(check.verdict, check.about, lines)


def _write_checks(figure: Figure, rows: Sequence[_Row], top: float, left: float) -> None:
    """The rows below each other, from a place [in]."""
    wide, tall = figure.get_size_inches()
    y = top + 0.1
    for row in rows:
        words = ((0.0, str(row.verdict), _COLORS[row.verdict], "bold"), (_VERDICT_IN, row.about, INK, "bold"))
        for at, text, color, weight in words:
            where = (left + at) / wide, 1 - y / tall
            figure.text(*where, label_text(text, 20), color=color, weight=weight, fontsize=TICK_PT, va="top")
        where = (left + _VERDICT_IN + _ABOUT_IN) / wide, 1 - y / tall
        figure.text(*where, "\n".join(row.lines), color=INK, fontsize=TICK_PT, va="top", linespacing=1.25)
        y += _LINE_IN * (len(row.lines) + 0.35)


# --- streams ----------------------------------------------------------------------------------------------


def _draw_streams(axes: Axes, streams: Sequence[StreamPreview], count: int) -> None:
    """A row of marks for every stream, on one time axis."""
    low, high = min(s.time_s[0] for s in streams), max(s.time_s[-1] for s in streams)
    for row, stream in enumerate(streams):
        for start, length in stream.gaps:
            axes.broken_barh([(start, length)], (row - 0.42, 0.84), facecolors="#f6d3d8", zorder=1)
        marks = ((stream.time_s, BLUE if row < 2 else QUIET, 0.55, 2), (stream.repeated_s, ORANGE, 0.8, 3),
                 (stream.skipped_s, ALARM, 0.9, 4))  # fmt: skip
        for time_s, color, length, order in marks:
            if time_s is not None and len(time_s):
                drawn = _apart(time_s, low, high)
                axes.eventplot(drawn, lineoffsets=row, linelengths=length, linewidths=1.0, colors=color, zorder=order)
    style_axes(axes, "streams" + (f" (the first {len(streams)} of {count})" if count > len(streams) else ""))
    axes.grid(visible=False, axis="y")
    axes.set_yticks(range(len(streams)), [_stream_label(s) for s in streams], color=INK)
    margin = 0.01 * (high - low) + 1e-3
    axes.set(xlim=(low - margin, high + margin), ylim=(len(streams) - 0.4, -0.6))
    axes.set_xlabel("since the first color frame [s]", color=QUIET, fontsize=LABEL_PT)
    _explain_marks(axes, streams)


def _apart(time_s: Float64[np.ndarray, "N"], low: float, high: float) -> Float64[np.ndarray, "M"]:
    """Of instants nearer than can be told apart on the axis, one."""
    if len(time_s) <= _MOST_MARKS or high <= low:
        return time_s
    place = ((time_s - low) / (high - low) * _MOST_MARKS).astype(int)
    return time_s[np.unique(place, return_index=True)[1]]


def _stream_label(stream: StreamPreview) -> str:
    return f"{label_text(stream.name, 14)}  {len(stream.time_s)} at {sampling_rate(stream.time_s):.3g}/s"


def _explain_marks(axes: Axes, streams: Sequence[StreamPreview]) -> None:
    """Say what marks mean, and how many there are of each."""
    gaps = sum(len(s.gaps) for s in streams)
    repeats, skipped = (sum(len(t) for s in streams if (t := getattr(s, name)) is not None)
                        for name in ("repeated_s", "skipped_s"))  # fmt: skip
    handles = [
        Line2D([], [], color=BLUE, linewidth=1.5, label="sample"),
        Patch(facecolor="#f6d3d8", label=f"gap ({gaps})"),
        Line2D([], [], color=ORANGE, linewidth=1.5, label=f"same picture as before ({repeats})"),
        Line2D([], [], color=ALARM, linewidth=1.5, label=f"skipped frame ({skipped})"),
    ]
    axes.legend(
        handles=handles, loc="lower right", bbox_to_anchor=(1, 1), ncols=4, frameon=False, fontsize=TICK_PT,
        labelcolor=QUIET, handlelength=1.2, borderaxespad=0.2, columnspacing=1.4,
    )  # fmt: skip
    axes.spines["bottom"].set_visible(True)
    axes.spines["bottom"].set_color(GRID)
