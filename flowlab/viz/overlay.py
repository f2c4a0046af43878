"""Query points, their trails and what a policy predicts of them, drawn over one enlarged picture of an episode."""

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from flowlab.records import Episode, FlowPrediction, PositionSource
from flowlab.viz.colors import PREDICTED_RGB, track_rgb
from flowlab.viz.orientation import is_upside_down, project_upright
from flowlab.viz.plan_predictions import PlanPrediction, plan_predictions
from flowlab.viz.stated_error import MOST_DRAWN_M, is_coarse, stated_sigma

_RIM = (16, 18, 22)
"""Around every mark, so that it shows on any picture."""
_HIDDEN_LIGHT = 0.75
_TRAIL_ALPHA = (0.9, 0.7, 0.45, 0.22)
"""How opaque a trail is, from its newest quarter to its oldest."""
_PATH_RIM_ALPHA = 0.5
"""How opaque the rim of a predicted path is: there are many, and they lie close."""
_ERROR_ALPHA = (0.9, 0.45)
"""How opaque the circle of a stated error is: of a point in sight, and of another."""
_SUBPIXEL = 4
"""Bits of OpenCV's fixed-point coordinates."""


class Overlay:
    """What is drawn over the pictures of an episode: a disc where a point is in sight, a ring where it is not,
    a cross where its position was filled in; around it a circle of the radius of its stated error, where that is
    large; behind each, its trail. Between the two lie the paths that the plan in force predicts, from where its points
    were when it was made.

    ``scale`` is how many canvas pixels a pixel of the picture has, ``trail`` (at least 1) how many steps a trail
    goes back.
    """

    def __init__(self, episode: Episode, scale: int, trail: int, prediction: FlowPrediction | None = None) -> None:
        M, quality = episode.queries.count, episode.tracks.quality
        self._episode, self._scale = episode, scale
        self._uv, self._there = self._paths_on_canvas(episode.tracks.xyz_world[:, :M])
        self._visible = episode.tracks.visible[:, :M]
        self._filled = (
            np.zeros_like(self._visible) if quality is None else quality.source[:, :M] == PositionSource.FILLED
        )
        self._rgb = track_rgb(episode)
        sigma = stated_sigma(episode)
        self._coarse = np.zeros_like(self._visible) if sigma is None else is_coarse(sigma)
        self._radius = np.zeros(self._visible.shape) if sigma is None else self._error_radii(sigma)
        self._trail = trail
        self._size = max(1.0, episode.camera.width * scale / 640)
        self._plans = [] if prediction is None else plan_predictions(episode, prediction)

    def draw(self, canvas: UInt8[np.ndarray, "H W 3"], t: int) -> None:
        """Draw trails, predicted paths, stated errors and points of step t onto the canvas."""
        self._draw_trails(canvas, t)
        self._draw_errors(canvas, t)
        in_force = [plan for plan in self._plans if plan.step <= t]
        if in_force:
            self._draw_prediction(canvas, in_force[-1], t)
        there, visible, filled = self._there[t], self._visible[t], self._filled[t]
        for k in np.flatnonzero(there & filled):
            self._draw_cross(canvas, t, int(k))
        for k in np.flatnonzero(there & ~filled & ~visible):
            self._draw_ring(canvas, t, int(k))
        for k in np.flatnonzero(there & ~filled & visible):
            self._draw_disc(canvas, t, int(k))

    def _paths_on_canvas(
        self, xyz_world: Float32[np.ndarray, "T M 3"]
    ) -> tuple[Int[np.ndarray, "T M 2"], Bool[np.ndarray, "T M"]]:
        """Where points are on the canvas of every step, which are others where the camera moves."""
        if self._episode.T_world_cam is None:
            return self._on_canvas(xyz_world, 0)
        uv, there = zip(*(self._on_canvas(row, t) for t, row in enumerate(xyz_world)), strict=True)
        return np.stack(uv), np.stack(there)

    def _on_canvas(
        self, xyz_world: Float32[np.ndarray, "*batch 3"], t: int
    ) -> tuple[Int[np.ndarray, "*batch 2"], Bool[np.ndarray, "*batch"]]:
        """Where points are on the canvas of a step, in OpenCV's fixed point, and whether they are anywhere near it."""
        camera, scale = self._episode.camera_at(t), self._scale
        uv = project_upright(camera, xyz_world, is_upside_down(self._episode.camera))
        canvas_uv = (uv + 0.5) * scale - 0.5  # the center of a pixel, enlarged
        far = 8 * max(camera.width, camera.height) * scale  # OpenCV counts in 32 bits
        there = np.all(np.abs(canvas_uv) < far, axis=-1)
        return np.round(np.where(there[..., None], canvas_uv, 0) * 2**_SUBPIXEL).astype(np.int32), there

    def _error_radii(self, sigma: Float32[np.ndarray, "T M"]) -> Float[np.ndarray, "T M"]:
        """How long every stated error is on the canvas [px], seen from the front; as far as that can be drawn."""
        episode, scale = self._episode, self._scale
        xyz_world = episode.tracks.xyz_world[:, : episode.queries.count]
        z = np.stack([episode.camera_at(t).project(row)[1] for t, row in enumerate(xyz_world)])
        radius = np.minimum(sigma, MOST_DRAWN_M) * episode.camera.K[0, 0] * scale / np.maximum(z, 1e-6)
        return np.nan_to_num(radius, nan=np.inf).clip(0, 2 * scale * episode.camera.width)

    def _draw_prediction(self, canvas: UInt8[np.ndarray, "H W 3"], plan: PlanPrediction, t: int) -> None:
        """Thin bright lines, each with a dot at its end, as far as they can be seen from the camera."""
        import cv2

        uv, there = self._on_canvas(plan.predicted_world[:, plan.predicted_moving], t)
        paths, ends = [path[ok] for path, ok in zip(uv.swapaxes(0, 1), there.T, strict=True)], uv[-1][there[-1]]
        for width, radius, rgb, alpha in ((2.6, 3.2, _RIM, _PATH_RIM_ALPHA), (1.0, 2.4, PREDICTED_RGB, 1.0)):
            layer = canvas.copy()
            cv2.polylines(layer, paths, False, rgb, self._px(width), cv2.LINE_AA, _SUBPIXEL)
            for end in ends.tolist():
                cv2.circle(layer, end, self._sub(radius), rgb, -1, cv2.LINE_AA, _SUBPIXEL)
            cv2.addWeighted(layer, alpha, canvas, 1 - alpha, 0, dst=canvas)

    def _draw_trails(self, canvas: UInt8[np.ndarray, "H W 3"], t: int) -> None:
        """The last steps of every point as pieces from step to step, the older the fainter; faint where the
        point was out of sight, or its stated error is large."""
        import cv2

        first = max(0, t - self._trail)
        pieces = np.stack([self._uv[first:t], self._uv[first + 1 : t + 1]], 2)
        there = self._there[first:t] & self._there[first + 1 : t + 1]
        red, green, blue = np.moveaxis(self._rgb[first + 1 : t + 1].astype(int), -1, 0)
        color = np.where(there, red << 16 | green << 8 | blue, -1)
        quarter = len(_TRAIL_ALPHA) * np.arange(t - first - 1, -1, -1) // self._trail
        sure = self._visible[first + 1 : t + 1] & ~self._coarse[first + 1 : t + 1]
        quarter = np.where(sure, quarter[:, None], len(_TRAIL_ALPHA) - 1)
        for age, alpha in reversed(list(enumerate(_TRAIL_ALPHA))):
            layer = canvas.copy()
            mine, of_color = pieces[quarter == age], color[quarter == age]
            for c in np.unique(of_color[of_color >= 0]).tolist():
                lines, rgb = list(mine[of_color == c]), (c >> 16, c >> 8 & 255, c & 255)
                cv2.polylines(layer, lines, False, rgb, self._px(1.6), cv2.LINE_AA, _SUBPIXEL)
            cv2.addWeighted(layer, alpha, canvas, 1 - alpha, 0, dst=canvas)

    def _draw_errors(self, canvas: UInt8[np.ndarray, "H W 3"], t: int) -> None:
        """Circles of the radius of the stated errors that are large, those of points out of sight fainter."""
        import cv2

        shown = self._there[t] & self._coarse[t]
        for sight, alpha in zip((False, True), reversed(_ERROR_ALPHA), strict=True):
            layer = canvas.copy()
            for k in np.flatnonzero(shown & (self._visible[t] == sight)).tolist():
                radius = round(self._radius[t, k] * 2**_SUBPIXEL)
                cv2.circle(layer, self._at(t, k), radius, self._ink(t, k), self._px(1.2), cv2.LINE_AA, _SUBPIXEL)
            cv2.addWeighted(layer, alpha, canvas, 1 - alpha, 0, dst=canvas)

    def _draw_disc(self, canvas: UInt8[np.ndarray, "H W 3"], t: int, k: int) -> None:
        """The mark of point k in sight."""
        import cv2

        for radius, rgb in ((4.9, _RIM), (3.8, self._ink(t, k))):
            cv2.circle(canvas, self._at(t, k), self._sub(radius), rgb, -1, cv2.LINE_AA, _SUBPIXEL)

    def _draw_ring(self, canvas: UInt8[np.ndarray, "H W 3"], t: int, k: int) -> None:
        """The mark of point k out of sight."""
        import cv2

        for radius, rgb in ((6.0, _RIM), (5.2, self._ink(t, k, _HIDDEN_LIGHT))):
            cv2.circle(canvas, self._at(t, k), self._sub(radius), rgb, self._px(1.6), cv2.LINE_AA, _SUBPIXEL)

    def _draw_cross(self, canvas: UInt8[np.ndarray, "H W 3"], t: int, k: int) -> None:
        """The mark of point k whose position was filled in."""
        import cv2

        (u, v), arm = self._at(t, k), self._sub(3.2)
        strokes = [np.array([[u - arm, v - s * arm], [u + arm, v + s * arm]]) for s in (1, -1)]
        for width, rgb in ((3.4, _RIM), (1.6, self._ink(t, k, _HIDDEN_LIGHT))):
            cv2.polylines(canvas, strokes, False, rgb, self._px(width), cv2.LINE_AA, _SUBPIXEL)

    def _at(self, t: int, k: int) -> tuple[int, int]:
        """Where point k is on the canvas at step t, in OpenCV's fixed point."""
        return int(self._uv[t, k, 0]), int(self._uv[t, k, 1])

    def _ink(self, t: int, k: int, light: float = 1.0) -> tuple[int, ...]:
        """The color of point k at step t, darkened to a share ``light``."""
        return tuple(int(light * channel) for channel in self._rgb[t, k])

    def _px(self, length: float) -> int:
        """A line width, for this size of canvas [px]."""
        return max(1, round(length * self._size))

    def _sub(self, length: float) -> int:
        """A length, for this size of canvas, in OpenCV's fixed point."""
        return round(length * self._size * 2**_SUBPIXEL)
