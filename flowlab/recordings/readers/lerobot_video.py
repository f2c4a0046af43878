"""MP4 files of strangers: the frame at a time, decoded. Runs in a process of its own."""

import os
from collections.abc import Iterator
from typing import Any

import av
import numpy as np

from flowlab.errors import DataError, first_line
from flowlab.limits import MAX_PIXELS

_CODECS = {"h264", "hevc", "av1", "libdav1d", "libaom-av1", "vp9", "libvpx-vp9", "mpeg4"}
_DEEP = ("gray12le", "yuv420p12le")
"""Formats of 12 bits a pixel, whose first plane is a code of depth."""
_KEPT = 4
_AHEAD_S = 2.0
"""A frame no later than so much after the last one is decoded on to, instead of looked for [s]."""


class VideoFiles:
    """The videos that were asked for."""

    def __init__(self) -> None:
        self._opened: dict[tuple[Any, ...], _Film] = {}

    def film(self, path: str) -> dict[str, Any]:
        """What a video says of itself: ``width``, ``height`` [px], ``format``, ``codec``, ``end_s``."""
        return self._film(path).about

    def frame(self, path: str, time_s: float, tolerance_s: float, deep: bool) -> np.ndarray:
        """The frame at a time.

        Args:
            path: The video.
            time_s: Since its start [s].
            tolerance_s: So far off a frame may be [s].
            deep: Whether to give the 12-bit codes (H, W), uint16, of depth; else uint8 (H, W, 3) RGB.

        Raises:
            DataError: There is no such frame, or it cannot be decoded.
        """
        try:
            return self._film(path).frame(time_s, tolerance_s, deep)
        except (av.FFmpegError, ValueError, OSError, MemoryError) as error:
            self._opened.clear()
            raise DataError(f"{path}: cannot be decoded at {time_s:.4f} s ({first_line(error)})") from error

    def _film(self, path: str) -> "_Film":
        about = os.stat(path)
        key = (path, about.st_mtime_ns, about.st_size, about.st_ino)
        if key not in self._opened:
            while len(self._opened) >= _KEPT:
                self._opened.pop(next(iter(self._opened))).close()
            self._opened[key] = _Film(path)
        return self._opened[key]


class _Film:
    """A video, and how far it was decoded."""

    def __init__(self, path: str) -> None:
        self._path = path
        try:  # as MP4 and nothing else: lists of other files are formats, too
            self._container = av.open(
                path, format="mp4", options={"protocol_whitelist": "file"}, metadata_errors="replace"
            )
            if not self._container.streams.video:
                raise ValueError("it holds no video")
            stream = self._stream = self._container.streams.video[0]
        except (av.FFmpegError, ValueError, OSError) as error:
            raise DataError(f"{path}: is no readable MP4 video ({first_line(error)}); copy it again") from error
        context = stream.codec_context
        if context.name not in _CODECS:
            raise DataError(f"{path}: is coded as {context.name}, expected h264, hevc, av1 or vp9")
        if not 0 < context.width * context.height <= MAX_PIXELS:
            raise DataError(
                f"{path}: says it has {context.width} x {context.height} pixels, expected 1 to {MAX_PIXELS:,}"
            )
        context.options = {"max_pixels": str(MAX_PIXELS), "err_detect": "explode"}
        context.thread_count = 1
        stream_s = float(stream.duration * stream.time_base) if stream.duration and stream.time_base else 0.0
        self.about = {"width": context.width, "height": context.height, "format": context.pix_fmt or "",
                      "codec": context.name, "end_s": stream_s or (self._container.duration or 0) / 1e6}  # fmt: skip
        self._frames: Iterator[Any] | None = None
        self._last: Any = None

    def close(self) -> None:
        self._frames = self._last = None
        self._container.close()

    def frame(self, time_s: float, tolerance_s: float, deep: bool) -> np.ndarray:
        before = self._last
        if before is None or not before.time - tolerance_s <= time_s <= before.time + _AHEAD_S:
            self._seek(time_s)
        while self._last is None or self._last.time < time_s - tolerance_s:
            before = self._last
            assert self._frames is not None
            self._last = next(self._frames, None)
            if self._last is None:
                self._frames = None
                ends = "it has none" if before is None else f"the last one is at {before.time:.4f} s"
                raise DataError(f"{self._path}: has no frame at {time_s:.4f} s; {ends}")
            if self._last.time is None:
                raise DataError(f"{self._path}: has a frame without a time")
        if self._last.time > time_s + tolerance_s:
            raise DataError(f"{self._path}: has no frame at {time_s:.4f} s; the next one is at {self._last.time:.4f} s")
        return self._pixels(self._last, deep)

    def _seek(self, time_s: float) -> None:
        """Stand before the frame at a time, at one from which can be decoded."""
        assert self._stream.time_base is not None
        at = max(0, int(time_s / self._stream.time_base) - 1)
        self._container.seek(at, stream=self._stream, backward=True)
        self._frames, self._last = self._container.decode(self._stream), None

    def _pixels(self, frame: Any, deep: bool) -> np.ndarray:
        if frame.is_corrupt:
            raise DataError(f"{self._path}: is damaged at {frame.time:.4f} s")
        if (frame.width, frame.height) != (self.about["width"], self.about["height"]):
            raise DataError(f"{self._path}: changes its size to {frame.width}x{frame.height} on the way")
        if not deep:
            return np.ascontiguousarray(frame.to_ndarray(format="rgb24"))
        if frame.format.name not in _DEEP:
            raise DataError(f"{self._path}: has pixels of {frame.format.name}, expected {' or '.join(_DEEP)} of depth")
        plane = frame.planes[0]
        rows = np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)[: frame.height, : 2 * frame.width]
        return np.ascontiguousarray(rows).view("<u2")
