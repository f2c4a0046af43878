"""A sheet of a recording before it is labeled: pictures with depth edges, cloud from above, streams, verdicts."""

import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from flowlab.perception.observer import Box
from flowlab.recordings.preview import PicturePreview, RecordingPreview, StreamPreview
from flowlab.recordings.sync import sampling_rate
from flowlab.recordings.verdicts import Check, Verdict, worst_first
from flowlab.viz.cloud_from_above import draw_cloud_from_above
from flowlab.viz.plot_style import (
    ALARM,
    BLUE,
    GREEN,
    GRID,
    INK,
    LABEL_PT,
    ORANGE,
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
_TITLE_IN, _HEADING_IN, _AXIS_IN = 0.55, 0.4, 0.6
_CLOUD_IN, _LABELS_IN, _TEXT_LEFT_IN = 5.6, 1.9, 6.6
_LINE_IN, _STREAM_IN = 0.165, 0.27
_VERDICT_IN, _SAYS_IN, _CHARACTER_IN = 0.75, 2.15, 0.066
_LONGEST = 900
"""Characters of what a check says."""
_MOST_LINES = 60
_MOST_STREAMS = 12
_MOST_MARKS = 2500
"""Samples of a stream that are nearer to each other than the axis can show are drawn as one."""
_EDGE_RGB = (255, 40, 200)
_COLORS = {Verdict.REFUSED: ALARM, Verdict.DOUBTFUL: ORANGE, Verdict.ASSUMED: BLUE, Verdict.OK: GREEN}


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
    text_left = _TEXT_LEFT_IN if preview.cloud is not None else _MARGIN_IN
    rows = list(_rows(checks, problem, int((_WIDTH_IN - _MARGIN_IN - text_left - _SAYS_IN) / _CHARACTER_IN)))
    streams = preview.streams[:_MOST_STREAMS]
    picture_in = _picture_height(preview.pictures)
    middle_in = max(4.6 if preview.cloud else 0.8, _LINE_IN * sum(len(r.lines) + 0.35 for r in rows))
    parts = [_TITLE_IN, picture_in + _HEADING_IN, middle_in + _HEADING_IN + _AXIS_IN]
    parts.append(_STREAM_IN * len(streams) + _HEADING_IN + _AXIS_IN if streams else 0.15)
    figure = new_figure(_WIDTH_IN, sum(parts))
    set_title(figure, title)
    if any(p.edges is not None for p in preview.pictures):
        where = 1 - _MARGIN_IN / _WIDTH_IN, 1 - 0.32 / sum(parts)
        pink = np.array(_EDGE_RGB) / 255
        figure.text(*where, "edges of depth", color=pink, fontsize=LABEL_PT, weight="bold", ha="right", va="center")
    tops = np.cumsum(parts) - parts
    for k, picture in enumerate(preview.pictures):
        wide = _panel_width()
        left = _MARGIN_IN + k * (wide + _GUTTER_IN)
        _draw_picture(_place(figure, left, tops[1] + _HEADING_IN, wide, picture_in), picture)
    if preview.cloud is not None:
        draw_cloud_from_above(
            _place(figure, 0.75, tops[2] + _HEADING_IN, _CLOUD_IN - 0.45, middle_in), preview.cloud, crop
        )
    _write_checks(figure, rows, tops[2] + 0.12, text_left)
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


# --- checks -----------------------------------------------------------------------------------------------


def _rows(checks: Sequence[Check], problem: str | None, width: int) -> Iterator[_Row]:
    """What is said of the checks, the worst first, in lines of so many characters, as much as there is room for."""
    refused = [c.says for c in checks if c.verdict is Verdict.REFUSED]
    told = worst_first(checks)
    if problem and not any(says in problem for says in refused):
        told.insert(0, Check("problem", Verdict.REFUSED, problem))
    room = _MOST_LINES
    for k, check in enumerate(told):
        lines = tuple(textwrap.wrap(label_text(check.says, _LONGEST), width)) or ("",)
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
        where = (left + _SAYS_IN) / wide, 1 - y / tall
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
