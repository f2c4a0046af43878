"""Rows of a recording, shrunk to where flow between them is quick."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
from jaxtyping import Float32, Float64, UInt8

from flowlab.geometry.camera import Camera
from flowlab.recordings.frame_processing import FrameProcessor

if TYPE_CHECKING:
    from flowlab.recordings.parsing import ParsedRecording


@dataclass(frozen=True, slots=True)
class SmallRow:
    """What a row shows."""

    gray: UInt8[np.ndarray, "h w"]
    """A pixel is the mean of those it stands for."""
    depth: Float32[np.ndarray, "h w"]
    """Of the middle one of these [m]; 0 where there is none."""
    factor: int
    """Pixels of the frame to one of these, along each axis."""
    camera: Camera
    """Of the frame."""

    @classmethod
    def read(cls, source: "ParsedRecording", processor: FrameProcessor, row: int, width: int) -> "SmallRow":
        """A row, shrunk by a whole factor to about a width [px]."""
        seen = source.frame_check
        gray = cv2.cvtColor(processor.color(source.streams.color.read(int(seen.color[row]))), cv2.COLOR_RGB2GRAY)
        depth = processor.depth(source.streams.depth.read(int(seen.depth[row])))
        n = max(1, round(processor.camera.width / width))
        gray = cv2.resize(gray[: gray.shape[0] // n * n, : gray.shape[1] // n * n], None, fx=1 / n, fy=1 / n,
                          interpolation=cv2.INTER_AREA)  # fmt: skip
        first = (n - 1) // 2
        depth = depth[first::n, first::n][: gray.shape[0], : gray.shape[1]]
        return cls(gray.astype(np.uint8, copy=False), depth, n, processor.camera)

    def unproject(self, depth: Float32[np.ndarray, "h w"], within: float) -> Float64[np.ndarray, "h w 3"]:
        """Points in the camera frame [m] at some depths [m], seen so many pixels of the frame into each pixel here."""
        v, u = np.mgrid[: depth.shape[0], : depth.shape[1]]
        return np.asarray(self.camera.at(np.eye(4)).unproject(np.stack([u, v], -1) * self.factor + within, depth))
