"""Small pictures that the first pass keeps of the frames that it decodes anyway, for all checks that look at them."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Num, UInt8

MAX_SAMPLES = 40
_MAX_SIDE = 160


@dataclass(frozen=True, slots=True)
class PictureSample:
    """A frame of color and depth, shrunk by whole factors."""

    row: int
    """Of the recording's rows."""
    gray: UInt8[np.ndarray, "H W"]
    """A pixel is the mean of those it stands for."""
    depth: Num[np.ndarray, "Hd Wd"]
    """Counts; a pixel is one of those it stands for."""
    color_factor: int
    """Source pixels per pixel."""
    depth_factor: int


def shrink_factor(picture: np.ndarray) -> int:
    """The factor by which a picture is shrunk."""
    return -(-max(picture.shape[:2]) // _MAX_SIDE)


def small_gray(picture: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "h w"]:
    """A picture shrunk, in gray."""
    n = shrink_factor(picture)
    height, width = picture.shape[0] // n, picture.shape[1] // n
    whole = picture[: height * n, : width * n]
    small = cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA) if n > 1 else whole
    return cv2.cvtColor(small, cv2.COLOR_RGB2GRAY)


def small_depth(counts: Num[np.ndarray, "H W"]) -> Num[np.ndarray, "h w"]:
    """One reading of every block."""
    n = shrink_factor(counts)
    height, width = counts.shape[0] // n, counts.shape[1] // n
    return np.array(counts[(n - 1) // 2 :: n, (n - 1) // 2 :: n][:height, :width])


def chosen(count: int) -> set[int]:
    """Which of so many frames are kept: evenly spaced, the first and the last among them."""
    return set(np.linspace(0, count - 1, min(count, MAX_SAMPLES)).round().astype(int).tolist()) if count else set()
