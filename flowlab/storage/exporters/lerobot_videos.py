"""Pictures for LeRobot: embedded in the table without loss, or as frames of MP4 files that several episodes share."""

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32, Num, UInt8, UInt16

from flowlab.errors import DataError, first_line
from flowlab.storage.exporters.lerobot_tables import numbered

DEPTH_CODE = {"depth_min": 0.01, "depth_max": 10.0, "shift": 3.5, "use_log": True}
"""LeRobot's usual code of depth videos [m]."""
_LAST_CODE = 4095
_MOST_MM = 65535
_ONE_THREAD = "log-level=none:pools=none:frame-threads=1:bframes=0"


def png(picture: UInt8[np.ndarray, "H W 3"]) -> bytes:
    """A color picture, without loss."""
    return cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))[1].tobytes()


def depth_mm(depth: Float32[np.ndarray, "H W"]) -> UInt16[np.ndarray, "H W"]:
    """Whole millimeters; 0, no reading, for what 16 bits cannot hold."""
    counts = np.rint(depth * 1000.0)
    return np.where(counts <= _MOST_MM, counts, 0).astype(np.uint16)


def depth_image(depth: Float32[np.ndarray, "H W"], unit: str) -> bytes:
    """A depth picture: 16-bit PNG of millimeters, or TIFF of meters, bit by bit."""
    if unit == "mm":
        return cv2.imencode(".png", depth_mm(depth))[1].tobytes()
    return cv2.imencode(".tiff", depth, [cv2.IMWRITE_TIFF_COMPRESSION, 8])[1].tobytes()


def depth_codes(depth: Float32[np.ndarray, "H W"]) -> UInt16[np.ndarray, "H W"]:
    """The 12-bit codes that LeRobot keeps of distances [m]; of pixels without a reading the first one."""
    low, high, shift = DEPTH_CODE["depth_min"], DEPTH_CODE["depth_max"], DEPTH_CODE["shift"]
    share = (np.log(depth + shift) - np.log(low + shift)) / (np.log(high + shift) - np.log(low + shift))
    return np.clip(np.rint(share * _LAST_CODE), 0, _LAST_CODE).astype(np.uint16)


@dataclass(frozen=True, slots=True)
class VideoCodec:
    """How the frames of a feature are coded."""

    name: str
    pixels: str
    options: dict[str, str]
    group: int
    """Every so many-th frame can be decoded alone."""

    @classmethod
    def of_color(cls, height: int, width: int, crf: int) -> "VideoCodec":
        """H.264, whose color is of half the resolution where the size allows it."""
        pixels = "yuv420p" if height % 2 == 0 and width % 2 == 0 else "yuv444p"
        return cls("libx264", pixels, {"crf": str(crf), "preset": "medium"}, 2)

    @classmethod
    def of_depth(cls) -> "VideoCodec":
        """HEVC of 12 bits, without loss beyond the code."""
        return cls("libx265", "gray12le", {"x265-params": f"lossless=1:{_ONE_THREAD}", "preset": "ultrafast"}, 2)


@dataclass(frozen=True, slots=True)
class VideoPart:
    """Where the frames of an episode are."""

    file: int
    from_s: float
    to_s: float


class VideoWriter:
    """Writes frames of episodes end to end into MP4 files of a limited size."""

    def __init__(self, folder: Path, codec: VideoCodec, size: tuple[int, int], fps: int, most_bytes: int) -> None:
        self._folder, self._codec, self._size, self._fps, self._most = folder, codec, size, fps, most_bytes
        self._file = -1
        self._container: Any = None
        self._stream: Any = None
        self._frames = self._bytes = 0

    def add(self, pictures: Iterator[Num[np.ndarray, "..."]]) -> VideoPart:
        """The frames of an episode."""
        if self._container is None or self._bytes > self._most:
            self._open()
        first = self._frames
        for picture in pictures:
            frame = self._frame(picture)
            frame.pts, frame.time_base = self._frames, Fraction(1, self._fps)
            self._write(frame)
            self._frames += 1
        return VideoPart(self._file, first / self._fps, self._frames / self._fps)

    def close(self) -> None:
        """End the last file."""
        if self._container is not None:
            self._write(None)
            self._container.close()
            self._container = None

    def _open(self) -> None:
        import av

        self.close()
        self._file += 1
        self._frames = self._bytes = 0
        path = numbered(self._folder, self._file, ".mp4")
        path.parent.mkdir(parents=True, exist_ok=True)
        self._container = av.open(str(path), "w", format="mp4")
        stream = self._stream = self._container.add_stream(self._codec.name, rate=self._fps)
        stream.height, stream.width = self._size
        stream.pix_fmt, stream.options = self._codec.pixels, self._codec.options
        context = stream.codec_context
        context.gop_size, context.max_b_frames, context.thread_count = self._codec.group, 0, 1

    def _frame(self, picture: Num[np.ndarray, "..."]) -> Any:
        import av

        height, width = self._size
        if picture.ndim == 3:
            return av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")
        frame = av.VideoFrame(width, height, self._codec.pixels)
        plane = frame.planes[0]
        rows = np.frombuffer(memoryview(plane), np.uint8).reshape(-1, plane.line_size)
        rows[:height, : 2 * width] = np.ascontiguousarray(picture, "<u2").view(np.uint8).reshape(height, 2 * width)
        return frame

    def _write(self, frame: Any) -> None:
        import av

        try:
            for packet in self._stream.encode(frame):
                self._bytes += packet.size
                self._container.mux(packet)
        except av.FFmpegError as error:
            height, width = self._size
            raise DataError(
                f"{self._folder.name}: pictures of {width}x{height} cannot be made a video by {self._codec.name} "
                f"({first_line(error)}); write images, with --set rgb=image or --set depth=mm"
            ) from error
