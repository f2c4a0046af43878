"""An episode as a video: its pictures, and where its tracks put the query points in them."""

from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from flowlab.errors import DataError
from flowlab.files import output_file
from flowlab.records import Episode, FlowPrediction
from flowlab.viz.caption_bar import CaptionBar
from flowlab.viz.orientation import is_upside_down
from flowlab.viz.overlay import Overlay

WIDTH = 640
"""Smaller pictures are enlarged, by a whole factor, to at least this width [px]: trails need room."""
_ONE_FRAME_FPS = 10.0
_BT709 = 1


def write_video(
    episode: Episode,
    path: Path,
    *,
    fps: float | None = None,
    trail_s: float = 0.5,
    title: str = "",
    note: str = "",
    prediction: FlowPrediction | None = None,
) -> None:
    """Write an H.264 ``.mp4`` that browsers play, a frame per step. ``path`` is either absent, as before, or whole.

    Every query point is drawn where its track is in the color picture, or in the depth picture where there is
    no color; by default in real time, with trails over the last half second. ``title`` is said instead of task
    and seed; ``note`` stands below, in red. The paths that a policy has ``prediction`` are drawn from the step of each
    plan to that of the next. Raises :class:`DataError` where the episode has no pictures.
    """
    pictures = VideoFrames(episode)
    rate = Fraction(mean_fps(episode) if fps is None else fps).limit_denominator(1000)
    overlay = Overlay(episode, pictures.scale, max(1, round(trail_s * mean_fps(episode))), prediction)
    name, width = title or f"{episode.task}, seed {episode.seed}", pictures.scale * episode.camera.width
    bar = CaptionBar(episode, width, name, note, predicted=prediction is not None)
    with output_file(path) as temporary:
        _encode(temporary, rate, (_frame(pictures, overlay, bar, t) for t in range(len(episode))))


def mean_fps(episode: Episode) -> float:
    """Steps per second."""
    seconds = float(episode.time_s[-1] - episode.time_s[0])
    return (len(episode) - 1) / seconds if seconds > 0 else _ONE_FRAME_FPS


class VideoFrames:
    """The pictures of an episode, upright and enlarged by a whole factor: color, or else gray depth."""

    def __init__(self, episode: Episode) -> None:
        if episode.rgb is None and episode.depth is None:
            simulated = episode.tracks.quality is None
            how = "--renderer gl --set expert.scene.rgb=true" if simulated else "--set write.rgb=true"
            raise DataError(
                f"{episode.task}, seed {episode.seed}: the dataset holds neither color nor depth pictures to draw on; "
                f"make it anew, into a new folder, with {how} (color) or --set write.depth=true"
            )
        self._episode = episode
        self.scale = -(-WIDTH // episode.camera.width)
        """Pixels of the video for one of the picture, each way."""
        self._near_far = _depth_range(episode)

    def draw(self, t: int) -> UInt8[np.ndarray, "h w 3"]:
        """The picture of step t, at ``scale`` times its size."""
        import cv2

        camera, rgb = self._episode.camera, self._episode.rgb
        picture = self._gray_depth(t) if rgb is None else rgb[t]
        if is_upside_down(camera):
            picture = picture[::-1, ::-1]
        size = camera.width * self.scale, camera.height * self.scale
        return np.asarray(cv2.resize(np.ascontiguousarray(picture), size, interpolation=cv2.INTER_CUBIC), np.uint8)

    def _gray_depth(self, t: int) -> UInt8[np.ndarray, "H W 3"]:
        """What is near is bright; what has no depth, black."""
        assert self._episode.depth is not None
        depth, (near, far) = self._episode.depth[t], self._near_far
        gray = np.interp(depth, [near, far], [225, 50]) * (depth > 0)
        return np.repeat(gray.astype(np.uint8)[..., None], 3, -1)


def _depth_range(episode: Episode) -> tuple[float, float]:
    """Between which depths [m] nearly all readings of the episode lie."""
    known = np.zeros(0) if episode.depth is None else episode.depth[episode.depth > 0]
    near, far = np.percentile(known[:: max(1, len(known) // 100_000)], [1, 99]) if len(known) else (0.0, 1.0)
    return float(near), float(max(far, near + 1e-3))


def _frame(pictures: VideoFrames, overlay: Overlay, bar: CaptionBar, t: int) -> UInt8[np.ndarray, "h w 3"]:
    """One frame of the video, of even height and width, as yuv420p needs."""
    picture = pictures.draw(t)
    overlay.draw(picture, t)
    frame = np.concatenate([picture, bar.draw(t)])
    return np.pad(frame, [(0, frame.shape[0] % 2), (0, frame.shape[1] % 2), (0, 0)], mode="edge")


def _encode(path: Path, rate: Fraction, frames: Iterator[UInt8[np.ndarray, "h w 3"]]) -> None:
    """Write frames as H.264 in colors that browsers show right."""
    import av

    with av.open(str(path), "w", format="mp4", options={"movflags": "+faststart"}) as container:
        stream = container.add_stream("h264", rate=rate, options={"crf": "18"})
        stream.pix_fmt = "yuv420p"
        stream.colorspace = stream.color_primaries = stream.color_trc = _BT709
        for t, rgb in enumerate(frames):
            if t == 0:
                stream.height, stream.width = rgb.shape[:2]
            frame = av.VideoFrame.from_ndarray(rgb, format="rgb24")
            frame = frame.reformat(format="yuv420p", dst_colorspace="ITU709")
            frame.pts, frame.time_base = t, 1 / rate
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
