"""Statistics of the arrays that windows are cut from."""

from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from flowlab.storage.pictures import StoredPictures

_ROWS = 64
"""Rows that are looked at together, so that pictures need not fit into memory."""


def describe_rows(key: str, array: np.ndarray | StoredPictures, ends: Sequence[int]) -> dict[str, Tensor]:
    """Least and greatest value, mean and deviation of an array (F, ...), per channel.

    The channel is the last axis, but for pictures: of ``rgb`` the three colors from 0 to 1, shape (3, 1, 1), and of
    ``depth`` its only one, shape (1, 1, 1), over the pixels that have a reading. Of ``flow`` the array is that of the
    tracks, ``ends`` the row after each episode's last, and only steps within episodes count.
    """
    count, total, square = 0.0, 0.0, 0.0
    low, high = np.inf, -np.inf
    for rows in _steps(array, ends) if key == "flow" else _portions(array):
        values = _by_channel(key, np.asarray(rows, float))
        if len(values):
            count += len(values)
            total, square = total + values.sum(0), square + (values**2).sum(0)
            low, high = np.minimum(low, values.min(0)), np.maximum(high, values.max(0))
    mean = total / max(count, 1)
    found = {"min": low, "max": high, "mean": mean, "std": np.sqrt(np.maximum(square / max(count, 1) - mean**2, 0))}
    shape = (-1, 1, 1) if key in ("rgb", "depth") else (-1,)
    return {name: torch.from_numpy(np.asarray(v, np.float32).reshape(shape)) for name, v in found.items()}


def _portions(array: np.ndarray | StoredPictures) -> Iterator[np.ndarray]:
    yield from (array[start : start + _ROWS] for start in range(0, len(array), _ROWS))


def _steps(tracks: np.ndarray | StoredPictures, ends: Sequence[int]) -> Iterator[np.ndarray]:
    yield from (np.diff(tracks[start:stop], axis=0) for start, stop in pairwise([0, *ends]))


def _by_channel(key: str, values: np.ndarray) -> np.ndarray:
    """(n, channels)."""
    if key == "rgb":
        return values.reshape(-1, 3) / 255
    if key == "depth":
        return values[values > 0][:, None]
    return values.reshape(len(values), -1) if values.ndim < 3 else values.reshape(-1, values.shape[-1])
