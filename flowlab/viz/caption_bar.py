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
from flowlab.viz.captions import role_name, tracker_name
from flowlab.viz.colors import PREDICTED_RGB, role_rgb
from flowlab.viz.plot_style import label_text, plain_style
from flowlab.viz.stated_error import (
    COARSE_M,
    MOST_DRAWN_M,
    SIGMA_NAMES,
    SIGMA_RGB,
    class_shares,
    percent,
    shares_below,
    stated_sigma,
)

_DPI = 128
"""A power of two, so that sizes in inches are whole pixels."""
_BACKGROUND, _INK, _QUIET, _ALARM = "#14171c", "#e9ecf0", "#9aa3ae", "#ff8190"
_WIDTH, _HEIGHT, _ERROR_HEIGHT, _NOTE_HEIGHT = 640, 84, 24, 18
"""What all lengths here are for [px]; a wider picture has a larger bar."""
_TITLE_Y, _STATE_Y, _LEGEND_Y = 24, 46, 69
"""Middles of the lines of text, below the line of progress as it is where no errors are stated."""
_PROGRESS_HEIGHT, _SHARES_HEIGHT = 5, 14
"""Of the line of progress: plain, and with the shares of stated errors in it."""
_TO_COME_LIGHT = 0.3


class CaptionBar:
    """Draws the bar of every step. Along its top runs how far the video is: where errors are stated, as the shares of
    their classes at every step, the smallest at the bottom."""

    @plain_style()
    def __init__(self, episode: Episode, width: int, title: str, note: str, *, predicted: bool = False) -> None:
        self._episode = episode
        self._scale = max(1.0, width / _WIDTH)
        self._width = width / self._scale
        lines = wrap(cut(note, 1000), int(self._width / 6.4), max_lines=3, placeholder=" …")
        self._sigma = stated_sigma(episode)
        self._top = 0 if self._sigma is None else _SHARES_HEIGHT - _PROGRESS_HEIGHT
        above = _HEIGHT if self._sigma is None else _HEIGHT + _ERROR_HEIGHT
        self._height = self._top + above + _NOTE_HEIGHT * len(lines)
        size = width / _DPI, round(self._height * self._scale) / _DPI
        self._figure = Figure(size, dpi=_DPI, facecolor=_BACKGROUND)
        self._canvas = canvas = cast(Any, FigureCanvasAgg(self._figure))  # matplotlib does not say its types
        self._write(14, _TITLE_Y, title, size=14, weight="bold")
        tracker = tracker_name(episode)
        about = f"tracker {tracker}" if tracker else "exact tracks"
        self._write(self._width - 14, _STATE_Y, about, size=11, color=_QUIET, ha="right")
        for k, line in enumerate(lines):
            self._write(14, above + 6 + _NOTE_HEIGHT * k, line, size=12, color=_ALARM)
        self._draw_marks(predicted)
        self._shares = [] if self._sigma is None else self._draw_errors()
        if self._sigma is None:
            self._draw_roles()
        self._step = self._write(self._width - 14, _TITLE_Y, "", size=12, ha="right")
        self._state = self._write(14, _STATE_Y, "", size=12, color=_QUIET)
        canvas.draw()
        self._background = canvas.copy_from_bbox(self._figure.bbox)
        self._progress = self._draw_progress(width)

    def draw(self, t: int) -> UInt8[np.ndarray, "H W 3"]:
        """The bar of step t."""
        episode, count = self._episode, self._episode.queries.count
        self._canvas.restore_region(self._background)
        self._step.set_text(f"step {t} / {len(episode) - 1}    {episode.time_s[t]:.2f} s")
        self._state.set_text(f"{episode.tracks.visible[t, :count].sum()} of {count} points in sight")
        if self._sigma is not None:
            for text, share in zip(self._shares, shares_below(self._sigma[t]), strict=True):
                text.set_text(percent(share))
        for text in (self._step, self._state, *self._shares):
            self._figure.draw_artist(text)
        picture = np.asarray(self._canvas.buffer_rgba())[..., :3].copy()
        height, _, _ = self._progress.shape
        to_come = np.arange(picture.shape[1]) > t / max(len(episode) - 1, 1) * picture.shape[1]
        picture[:height] = self._progress * np.where(to_come, _TO_COME_LIGHT, 1)[:, None]
        return picture

    def _write(self, x: float, y: float, text: str, *, size: float, color: str = _INK, **style: Any) -> Text:
        """Put a line of text in the middle of whose height is y, ``size`` pixels high."""
        place = self._place(x, y)
        points = size * self._scale * 72 / _DPI
        return self._figure.text(*place, label_text(text, 120), fontsize=points, color=color, va="center", **style)

    def _place(self, x: float, y: float) -> tuple[float, float]:
        """A place in the figure, as shares of its width and height."""
        return x / self._width, 1 - (self._top + y) / self._height

    def _draw_marks(self, predicted: bool) -> None:
        """The legend of the marks: disc, ring, cross, circle; and the line of a predicted path."""
        marks = [("in sight", "o", _INK), ("out of sight", "o", "none")]
        if self._sigma is not None:
            marks.append(("filled in", "x", _INK))
        x = 18.0
        for name, marker, face in marks:
            self._dot(x, marker, face, _INK)
            self._write(x + 10, _LEGEND_Y, name, size=11, color=_QUIET)
            x += 24 + 6.2 * len(name)
        if self._sigma is not None:
            self._dot(x, "o", _INK, _INK, size=5)
            self._dot(x, "o", "none", _INK, size=13, edge_width=1)
            words = f"radius of the circle: σ, {1000 * COARSE_M:.0f} to {1000 * MOST_DRAWN_M:.0f} mm"
            self._write(x + 13, _LEGEND_Y, words, size=11, color=_QUIET)
        if predicted:
            self._draw_path(x - 6)
            self._write(x + 24, _LEGEND_Y, "predicted", size=11, color=_QUIET)

    def _draw_errors(self) -> list[Text]:
        """The legend of the stated errors' classes; the texts of their shares, which are still to be written."""
        y, shares = _LEGEND_Y + _ERROR_HEIGHT, []
        self._write(14, y, "stated error σ", size=11, color=_QUIET)
        for k, (name, rgb) in enumerate(zip(SIGMA_NAMES, SIGMA_RGB, strict=True)):
            x = 108 + 107 * k
            self._dot(x, "s", tuple(np.array(rgb) / 255), "none", y=y, size=10)
            self._write(x + 9, y, name, size=11, color=_QUIET)
            shares.append(self._write(x + 66, y, "", size=11))
        return shares

    def _draw_roles(self) -> None:
        """The legend of the roles' colors."""
        x = self._width - 14
        for role in np.unique(self._episode.query_role[: self._episode.queries.count])[::-1]:
            name = role_name(role)
            self._write(x, _LEGEND_Y, name, size=11, color=_QUIET, ha="right")
            x -= 10 + 6.4 * len(name)
            self._dot(x, "o", tuple(role_rgb(role) / 255), "none")
            x -= 16

    def _dot(
        self,
        x: float,
        marker: str,
        face: ColorType,
        edge: ColorType,
        *,
        y: float = _LEGEND_Y,
        size: float = 8,
        edge_width: float = 1.5,
    ) -> None:
        """A mark in the legend, in the row of the marks unless ``y`` says another."""
        points, (across, up) = self._scale * 72 / _DPI, self._place(x, y)
        mark = Line2D(
            [across], [up], marker=marker, markersize=size * points, markerfacecolor=face,
            markeredgecolor=edge, markeredgewidth=edge_width * points,
        )  # fmt: skip
        self._figure.add_artist(mark)

    def _draw_path(self, x: float) -> None:
        """A line that ends in a dot."""
        (start, up), (end, _) = self._place(x, _LEGEND_Y), self._place(x + 20, _LEGEND_Y)
        rgb, points = tuple(np.array(PREDICTED_RGB) / 255), self._scale * 72 / _DPI
        line = Line2D(
            [start, end], [up, up], color=rgb, linewidth=1.6 * points, marker="o",
            markersize=5.5 * points, markevery=[1], markeredgewidth=0,
        )  # fmt: skip
        self._figure.add_artist(line)

    def _draw_progress(self, width: int) -> UInt8[np.ndarray, "h W 3"]:
        """The line of progress at the end of the video, in color."""
        if self._sigma is None:
            return np.full((round(_PROGRESS_HEIGHT * self._scale), width, 3), 170, np.uint8)
        height, step = round(_SHARES_HEIGHT * self._scale), np.arange(width) * len(self._episode) // width
        below = np.cumsum([class_shares(row) for row in self._sigma], axis=1)[step, :-1]
        share = (height - 0.5 - np.arange(height)) / height
        return np.array(SIGMA_RGB, np.uint8)[(below <= share[:, None, None]).sum(-1)]
