"""Pyramidal Lucas-Kanade: every point is followed by the look of its surroundings, without any download."""

from collections.abc import Iterator
from typing import Any, ClassVar

import cv2
import numpy as np
from jaxtyping import Float32
from pydantic import Field

from flowlab.records import Clip, Tracks2D
from flowlab.tracking.base import Tracker

PATCH_RADIUS = 7
"""Of the square around a point whose look is compared between frames [px]."""
BACKWARD_SCALE_PX = 2.0
"""Forward-backward error at which confidence has fallen to 0.6 of what the look of the point gives."""
FINE_LEVELS = 1
"""Levels of the pyramid that are used where the answer is known to within some pixels."""


class LucasKanade(Tracker):
    """OpenCV's pyramidal Lucas-Kanade, frame to frame, and held to the look of the point where it was asked for.

    After each step the point is aligned again to its first patch, which stops drift; the alignment is taken if the
    patch there is the more similar one. A point that was lost is searched where it was last seen, too.
    """

    name: ClassVar[str] = "lucas-kanade"
    license: ClassVar[str] = "OpenCV, Apache-2.0; no weights"

    window: int = Field(default=21, ge=3)
    """Side of the square whose motion is a point's motion [px]."""
    levels: int = Field(default=3, ge=0, le=8)
    """How many times the picture is halved: each doubles the motion that can be followed."""
    pull_px: float = Field(default=4.0, gt=0)
    """How far alignment to the first patch may move a point [px]."""
    forward_backward_px: float = Field(default=1.0, gt=0)
    """A step that does not lead back to within this distance [px] loses the point."""
    similarity: float = Field(default=0.2, ge=0, lt=1)
    """Correlation with its first patch below which a point counts as lost ..."""
    similarity_again: float = Field(default=0.6, ge=0, lt=1)
    """... and above which a lost point counts as found."""

    def open(self, clip: Clip) -> "LucasKanadeSession":
        """Get ready to track points of a clip."""
        return LucasKanadeSession(clip, self)


class LucasKanadeSession:
    """A clip whose frames are made gray as they are needed; those before the latest request are let go."""

    def __init__(self, clip: Clip, options: LucasKanade) -> None:
        self._clip = clip
        self._options = options
        self._gray: dict[int, np.ndarray] = {}

    def track(self, queries_txy: Float32[np.ndarray, "M 3"], start: int, stop: int) -> Tracks2D:
        """See :class:`~flowlab.tracking.base.Session`.

        Forward-backward error is how far from its query a point lands when it is aligned, from there, with the
        query's frame again; -1 before that frame, and where the way back is not found. Confidence is the
        correlation of the point's patches in both frames, less where that error is large.
        """
        self._gray = {t: g for t, g in self._gray.items() if t >= start}
        frame, shape = queries_txy[:, 0].astype(int), (stop - start, len(queries_txy))
        xy = np.broadcast_to(queries_txy[:, 1:].astype(np.float32), (*shape, 2)).copy()
        visible, confidence = np.zeros(shape, bool), np.zeros(shape, np.float32)
        forward_backward = np.full(shape, -1, np.float32)
        for first in np.unique(frame):
            mine, row = np.flatnonzero(frame == first), first - start
            visible[row, mine], confidence[row, mine], forward_backward[row, mine] = True, 1, 0
            for k, found in enumerate(self._follow(first, stop, xy[row, mine]), row + 1):
                xy[k, mine], visible[k, mine], confidence[k, mine], forward_backward[k, mine] = found
        return Tracks2D(xy, visible, confidence, forward_backward)

    def _follow(self, first: int, stop: int, origin: np.ndarray) -> Iterator[tuple[np.ndarray, ...]]:
        """Follow points from ``origin`` (M, 2) of frame ``first`` through the frames after it.

        Yields for each frame: xy (M, 2), and of every point visible, confidence, forward-backward error.
        """
        look, everyone = self._patches(first, origin), np.arange(len(origin))
        xy, last_seen, visible = origin.copy(), origin.copy(), np.ones(len(origin), bool)
        for t in range(first + 1, stop):
            xy, steady = self._step(t, xy)
            similar = _correlation(look, self._patches(t, xy))
            lost, held = np.flatnonzero(~visible), np.zeros(len(xy), bool)
            for guess, mine, enough in ((xy, everyone, -1.0), (last_seen, lost, self._options.similarity_again)):
                aligned, alike = self._align(first, t, origin[mine], look[mine], guess[mine])
                better = alike >= np.maximum(similar[mine], enough)
                xy[mine[better]], similar[mine[better]], held[mine[better]] = aligned[better], alike[better], True
            sure = held & (similar > self._options.similarity_again)
            visible = sure | (visible & steady & (similar > self._options.similarity))
            last_seen[visible] = xy[visible]
            back, found = self._flow(t, first, xy, origin)
            error = np.linalg.norm(back - origin, axis=1)
            confidence = similar.clip(0, 1) * np.exp(-0.5 * (error / BACKWARD_SCALE_PX) ** 2) * found
            yield xy, visible, confidence, np.where(found, error, -1)

    def _step(self, t: int, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """From the frame before to frame t; and whether the way back leads to where it began."""
        moved, found = self._flow(t - 1, t, xy)
        moved = np.where((found & self._inside(moved))[:, None], moved, xy)
        back, returned = self._flow(t, t - 1, moved)
        return moved, found & returned & (np.linalg.norm(back - xy, axis=1) < self._options.forward_backward_px)

    def _align(
        self, first: int, t: int, origin: np.ndarray, look: np.ndarray, guess: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Where points of frame ``first`` are in frame t near a guess, and how similar they look there; -1 if not."""
        xy, found = self._flow(first, t, origin, guess)
        near = found & self._inside(xy) & (np.linalg.norm(xy - guess, axis=1) < self._options.pull_px)
        return xy, np.where(near, _correlation(look, self._patches(t, xy)), -1)

    def _flow(self, a: int, b: int, xy: np.ndarray, guess: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Positions (M, 2) in frame b of points of frame a, and whether they were found. A guess spares levels."""
        if not len(xy):
            return xy, np.ones(0, bool)
        o = self._options
        start: Any = None if guess is None else guess.astype(np.float32)  # a copy: OpenCV writes into it
        moved, found, _ = cv2.calcOpticalFlowPyrLK(
            self._frame(a),
            self._frame(b),
            xy.astype(np.float32),
            start,
            winSize=(o.window, o.window),
            maxLevel=o.levels if guess is None else min(o.levels, FINE_LEVELS),
            criteria=(cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.01),
            minEigThreshold=1e-5,
            flags=0 if guess is None else cv2.OPTFLOW_USE_INITIAL_FLOW,
        )
        return moved, found[:, 0] > 0

    def _patches(self, t: int, xy: np.ndarray) -> np.ndarray:
        """The squares (M, P) around points of frame t, between pixels where the points are."""
        if not len(xy):
            return np.empty((0, (2 * PATCH_RADIUS + 1) ** 2), np.float32)
        dv, du = np.indices((2 * PATCH_RADIUS + 1,) * 2).reshape(2, -1).astype(np.float32) - PATCH_RADIUS
        u, v = xy[:, :1].astype(np.float32) + du, xy[:, 1:].astype(np.float32) + dv
        gray = self._frame(t).astype(np.float32)
        return cv2.remap(gray, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)

    def _frame(self, t: int) -> np.ndarray:
        """Frame t in gray."""
        if t not in self._gray:
            self._gray[t] = cv2.cvtColor(self._clip.rgb[t], cv2.COLOR_RGB2GRAY)
        return self._gray[t]

    def _inside(self, xy: np.ndarray) -> np.ndarray:
        """Whether points (M, 2) lie on the picture."""
        height, width = self._clip.rgb.shape[1:3]
        return np.all((xy >= 0) & (xy <= (width - 1, height - 1)), axis=1)


def _correlation(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Zero-mean normalized correlation (M,) of patches (M, P)."""
    a, b = a - a.mean(1, keepdims=True), b - b.mean(1, keepdims=True)
    return (a * b).sum(1) / np.sqrt((a * a).sum(1) * (b * b).sum(1) + 1)  # 1: a patch all of one gray is like none
