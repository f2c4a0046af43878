"""How far depth lies from color, told by where in the picture both change."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64, Int64
from scipy import fft

from flowlab.recordings.content import CELLS, PictureDigest
from flowlab.recordings.picture_changes import color_changes, depth_changes

_FEWEST, _MOST = 20, 600
"""With fewer rows nothing is told; of more, so many steps from one to the next are looked at."""
_REACH = 9
"""Cells to every side that depth is moved by."""
_LIKE = 0.1
"""Changes that correlate by this have one cause."""
_AWAY, _OF_LIKE = 1.9, 0.9
"""Where the best of all places is so many cells away, and they are less alike here than this share of there, depth does
not lie on color; where it is not away at all, it does."""
_MIDDLE = (CELLS[0] // 2, CELLS[1] // 2)
_HALVES = (np.s_[:, :, : _MIDDLE[1]], np.s_[:, :, _MIDDLE[1] :], np.s_[:, : _MIDDLE[0]], np.s_[:, _MIDDLE[0] :])
"""Of the cells: left, right, upper, lower."""
_NOTHING = 1e-12


@dataclass(frozen=True, slots=True)
class DepthAside:
    """Where depth changes when color does."""

    shift: tuple[float, float]
    """By what share of the picture's width and height depth must be moved, right and down."""
    correlation: float
    """Correlation of the two, if it is moved so."""
    lies: bool | None
    """Whether depth lies on color; None where that is not told."""


def find_depth_aside(
    rows: Int64[np.ndarray, "T 2"], color: Mapping[int, PictureDigest], depth: Mapping[int, PictureDigest]
) -> DepthAside | None:
    """How far depth lies from color, to within a cell; None where there are too few pictures.

    What moves changes the same places of both at the same time.

    Args:
        rows: Indices of the color and the depth picture of every row.
        color: What is kept of color pictures, by index.
        depth: Likewise of depth pictures.
    """
    if len(rows) < _FEWEST:
        return None
    some = np.unique(np.linspace(0, len(rows) - 2, min(_MOST, len(rows) - 1)).astype(int))
    pairs = [rows[k : k + 2] for k in some]
    seen = np.stack([color_changes(np.stack([color[i].cells for i in pair[:, 0]]))[0] for pair in pairs])
    read = np.stack([depth_changes(np.stack([depth[j].cells for j in pair[:, 1]]))[0] for pair in pairs])
    seen, read = seen - seen.mean(0), read - read.mean(0)
    whole = _judged(_shifted_correlations(seen, read))
    if whole.lies and any(_judged(_shifted_correlations(seen[half], read[half])).lies is False for half in _HALVES):
        return replace(whole, lies=None)  # as of a camera with another field of view
    return whole


def _judged(like: Float64[np.ndarray, "n n"]) -> DepthAside:
    """What correlations at every shift tell."""
    down, across = (int(k) - _REACH for k in np.unravel_index(like.argmax(), like.shape))
    most, here = float(like.max()), float(like[_REACH - 1 : _REACH + 2, _REACH - 1 : _REACH + 2].max())
    lies = None
    if most >= _LIKE and down == across == 0:
        lies = True
    elif (
        most >= _LIKE
        and np.hypot(down, across) > _AWAY
        and here < _OF_LIKE * most
        and max(abs(down), abs(across)) < _REACH
    ):
        lies = False
    return DepthAside((-across / CELLS[1], -down / CELLS[0]), most, lies)


def _shifted_correlations(color: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Correlation of changes with those of depth so many cells down and across, each from -_REACH to _REACH."""
    size = tuple(fft.next_fast_len(n + _REACH, real=True) for n in color.shape[1:])
    spectrum = np.zeros((size[0], size[1] // 2 + 1), complex)
    for one, other in zip(color, depth, strict=True):
        spectrum += np.conj(fft.rfft2(one, size)) * fft.rfft2(other, size)
    energy = float((color**2).sum()) * float((depth**2).sum())
    around = np.arange(-_REACH, _REACH + 1)
    return fft.irfft2(spectrum, size)[np.ix_(around, around)] / np.sqrt(max(energy, _NOTHING))
