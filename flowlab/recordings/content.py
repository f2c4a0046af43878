"""What pictures hold: how much they change."""

import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float32, Int64, Num

_TILES = 8
"""A picture is looked at in so many rows and columns of tiles."""
CELLS = (48, 64)
"""And changes are told in so many rows and columns of cells."""
_NOISY = (0.3, 0.7)
"""Noise changes this share of the pixels from picture to picture, in this share of the pairs."""
_UNLIKE = -0.2
"""Correlation of two changes in a row: near -0.5 for noise, as what was added is gone again, above for motion."""
_OF_CONTRAST = 0.35
"""Noise is less than this share of the contrast; a change of this size is motion."""
_FEWEST = 4
"""So many different pictures tell whether they have noise."""


@dataclass(frozen=True, slots=True)
class PictureDigest:
    """What is kept of a picture that was looked at."""

    checksum: int
    """The same only for pictures that are the same bit by bit."""
    tiles: tuple[int, ...]
    """Likewise of every tile; 0 where all of its pixels are alike."""
    small: Num[np.ndarray, "h w"]
    """The picture, thinned, to tell how much has changed."""
    cells: Num[np.ndarray, "48 64"]
    """The same by more pixels, as they are in the picture, to tell where."""


def digest(picture: np.ndarray) -> PictureDigest:
    """What is kept of a picture."""
    gray = picture[..., 1] if picture.ndim == 3 else picture
    step = max(1, gray.shape[0] // 24), max(1, gray.shape[1] // 32)
    small = np.nan_to_num(gray[:: step[0], :: step[1]].astype(np.float32), posinf=0, neginf=0)
    rows, columns = (np.linspace(0, side, _TILES + 1).astype(int).tolist() for side in gray.shape)
    tiles = [picture[a:b, c:d].tobytes() for a, b in pairwise(rows) for c, d in pairwise(columns)]
    pixel = picture[:1, :1].nbytes
    sums = [zlib.crc32(tile) for tile in tiles]
    plain = tuple(0 if tile == tile[:pixel] * (len(tile) // pixel) else n for tile, n in zip(tiles, sums, strict=True))
    places = [((np.arange(n) + 0.5) * side / n).astype(int) for n, side in zip(CELLS, gray.shape, strict=True)]
    return PictureDigest(zlib.crc32(np.array(sums, np.uint32).tobytes()), plain, small, gray[np.ix_(*places)])


def repeated_pictures(digests: Mapping[int, PictureDigest]) -> Int64[np.ndarray, "R"]:
    """The pictures that are the same as the one looked at before."""
    return np.array([b for a, b in pairwise(sorted(digests)) if is_equal(digests[a], digests[b])], np.int64)


def is_equal(a: PictureDigest, b: PictureDigest) -> bool:
    """Whether two pictures are the same, and have anything in them by which that could be told."""
    return a.checksum == b.checksum and np.ptp(a.small) > 0


def change_between(a: PictureDigest, b: PictureDigest) -> float:
    """How much has changed between two pictures."""
    return float(np.abs(a.small - b.small).mean()) if a.small.shape == b.small.shape else 0.0


def has_noise(pictures: Float32[np.ndarray, "T P"]) -> bool:
    """Whether pictures differ from one to the next as by a sensor's noise, not by motion alone."""
    steps = np.diff(pictures, axis=0)
    differ = steps != 0
    if len(pictures) < _FEWEST or (differ.mean(axis=1) >= _NOISY[0]).mean() < _NOISY[1]:
        return False
    size = float(np.median(np.abs(steps[differ])))
    contrast = float(np.median([np.std(p[p != 0]) if p.any() else 0.0 for p in pictures]))
    capped = np.clip(steps, -3 * size, 3 * size)
    like = [float(np.sum(a * b) / max(np.sqrt(np.sum(a**2) * np.sum(b**2)), 1e-9)) for a, b in pairwise(capped)]
    return bool(np.median(like) < _UNLIKE and size < _OF_CONTRAST * contrast)


def runs(same: Bool[np.ndarray, "N"]) -> list[tuple[int, int]]:
    """First and last row of every run of equal pictures."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], same, [False]]).astype(np.int8)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]
