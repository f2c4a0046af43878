"""The bar below the pictures of a video: whose they are, the step, and what marks and colors mean."""

from textwrap import wrap
from typing import Any, cast

import numpy as np
from jaxtyping import UInt8
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.text import Text
from matplotlib.typing import ColorType

from flowlab.records import Episode
from flowlab.text import cut
from flowlab.viz.captions import role_name, sigma_summary, tracker_name
from flowlab.viz.colors import PREDICTED_RGB, SIGMA_LIMIT, role_rgb, sigma_rgb
from flowlab.viz.plot_style import label_text, plain_style

_DPI = 128
"""A power of two, so that sizes in inches are whole pixels."""
_BACKGROUND, _INK, _QUIET, _ALARM = "#14171c", "#e9ecf0", "#9aa3ae", "#ff8190"
_WIDTH, _HEIGHT, _NOTE_HEIGHT = 640, 84, 18
"""What all lengths here are for [px]; a wider picture has a larger bar."""
_PROGRESS_HEIGHT = 5
_TO_COME_LIGHT = 0.3


class CaptionBar:
    """Draws the bar of every step. Along its top runs how far the video is, in the color of that step's
    median stated error where there is one."""

    @plain_style()
    def __init__(self, episode: Episode, width: int, title: str, note: str, *, predicted: bool = False) -> None:
        self._episode = episode
        self._scale = max(1.0, width / _WIDTH)
        self._width = width / self._scale
        lines = wrap(cut(note, 1000), int(self._width / 6.4), max_lines=3, placeholder=" …")
        self._height = _HEIGHT + _NOTE_HEIGHT * len(lines)
        size = width / _DPI, round(self._height * self._scale) / _DPI
        self._figure = Figure(size, dpi=_DPI, facecolor=_BACKGROUND)
        self._canvas = canvas = cast(Any, FigureCanvasAgg(self._figure))  # matplotlib does not say its types
        self._write(14, 24, title, size=14, weight="bold")
        if tracker_name(episode):
            self._write(self._width - 14, 46, f"tracker {tracker_name(episode)}", size=11, color=_QUIET, ha="right")
        for k, line in enumerate(lines):
            self._write(14, _HEIGHT + 6 + _NOTE_HEIGHT * k, line, size=12, color=_ALARM)
        self._draw_marks(predicted)
        self._draw_colors()
        self._step = self._write(self._width - 14, 24, "", size=12, ha="right")
        self._state = self._write(14, 46, "", size=12, color=_QUIET)
        canvas.draw()
        self._background = canvas.copy_from_bbox(self._figure.bbox)
        self._progress = self._draw_progress(width)

    def draw(self, t: int) -> UInt8[np.ndarray, "H W 3"]:
        """The bar of step t."""
        episode, count = self._episode, self._episode.queries.count
        self._canvas.restore_region(self._background)
        self._step.set_text(f"step {t} / {len(episode) - 1}    {episode.time_s[t]:.2f} s")
        seen = f"{episode.tracks.visible[t, :count].sum()} of {count} points in sight"
        stated = "" if episode.tracks.quality is None else f"    {sigma_summary(episode, t)}"
        self._state.set_text(seen + stated)
        for text in (self._step, self._state):
            self._figure.draw_artist(text)
        picture = np.asarray(self._canvas.buffer_rgba())[..., :3].copy()
        height, _, _ = self._progress.shape
        to_come = np.arange(picture.shape[1]) > t / max(len(episode) - 1, 1) * picture.shape[1]
        picture[:height] = self._progress * np.where(to_come, _TO_COME_LIGHT, 1)[:, None]
        return picture

    def _write(self, x: float, y: float, text: str, *, size: float, color: str = _INK, **style: Any) -> Text:
        """Put a line of text in the middle of whose height is y, ``size`` pixels high."""
        place = x / self._width, 1 - y / self._height
        points = size * self._scale * 72 / _DPI
        return self._figure.text(*place, label_text(text, 120), fontsize=points, color=color, va="center", **style)

    def _draw_marks(self, predicted: bool) -> None:
        """The legend of the marks: disc, ring, cross; and the line of a predicted path."""
        marks = [("in sight", "o", _INK), ("out of sight", "o", "none")]
        if self._episode.tracks.quality is not None:
            marks.append(("filled in", "x", _INK))
        x = 18.0
        for name, marker, face in marks:
            self._dot(x, marker, face, _INK)
            self._write(x + 10, 69, name, size=11, color=_QUIET)
            x += 24 + 6.2 * len(name)
        if predicted:
            self._draw_path(x - 6)
            self._write(x + 24, 69, "predicted", size=11, color=_QUIET)

    def _draw_colors(self) -> None:
        """The legend of the colors: the scale of stated errors, or the roles."""
        if self._episode.tracks.quality is not None:
            box = (self._width - 210) / self._width, 1 - 74 / self._height, 140 / self._width, 10 / self._height
            axes = self._figure.add_axes(box)
            axes.imshow(sigma_rgb(np.linspace(0, SIGMA_LIMIT, 256))[None], aspect="auto")
            axes.set_axis_off()
            self._write(self._width - 216, 69, "stated error σ   0", size=11, color=_QUIET, ha="right")
            self._write(self._width - 14, 69, f"≥ {1000 * SIGMA_LIMIT:.0f} mm", size=11, color=_QUIET, ha="right")
            return
        x = self._width - 14
        for role in np.unique(self._episode.query_role[: self._episode.queries.count])[::-1]:
            name = role_name(role)
            self._write(x, 69, name, size=11, color=_QUIET, ha="right")
            x -= 10 + 6.4 * len(name)
            self._dot(x, "o", tuple(role_rgb(role) / 255), "none")
            x -= 16

    def _dot(self, x: float, marker: str, face: ColorType, edge: ColorType) -> None:
        """A round mark in the legend."""
        points = self._scale * 72 / _DPI
        mark = Line2D(
            [x / self._width], [1 - 69 / self._height], marker=marker, markersize=8 * points, markerfacecolor=face,
            markeredgecolor=edge, markeredgewidth=1.5 * points,
        )  # fmt: skip
        self._figure.add_artist(mark)

    def _draw_path(self, x: float) -> None:
        """A line that ends in a dot."""
        y, rgb, points = 1 - 69 / self._height, tuple(np.array(PREDICTED_RGB) / 255), self._scale * 72 / _DPI
        line = Line2D(
            [x / self._width, (x + 20) / self._width], [y, y], color=rgb, linewidth=1.6 * points, marker="o",
            markersize=5.5 * points, markevery=[1], markeredgewidth=0,
        )  # fmt: skip
        self._figure.add_artist(line)

    def _draw_progress(self, width: int) -> UInt8[np.ndarray, "h W 3"]:
        """The line of progress at the end of the video, in color."""
        quality, count = self._episode.tracks.quality, self._episode.queries.count
        step = np.arange(width) * len(self._episode) // width
        rgb = np.full((width, 3), 170, np.uint8)
        if quality is not None:
            rgb = sigma_rgb(np.median(quality.sigma[:, :count], axis=1))[step]
        return np.tile(rgb, (round(_PROGRESS_HEIGHT * self._scale), 1, 1))
