"""Textures of procedural scenes: what a surface looks like, from patterned to plain."""

from typing import Literal

import cv2
import numpy as np
from jaxtyping import UInt8

Look = Literal["textured", "striped", "mirrored", "plain"]
"""``textured`` is different everywhere, ``striped`` repeats along one direction, ``mirrored`` looks the same turned by
half a turn, ``plain`` has one color."""


def make_texture(look: Look, rng: np.random.Generator, size_px: int = 256) -> UInt8[np.ndarray, "S S 3"]:
    """A square picture of a surface.

    Args:
        look: Its kind.
        rng: What it is drawn from.
        size_px: Its side; what is in it keeps its size, so that a larger picture shows more.

    Returns:
        Colors from 0 to 255.
    """
    base, other = _color(rng), _color(rng)
    if look == "plain":
        return np.broadcast_to(base.astype(np.uint8), (size_px, size_px, 3)).copy()
    if look == "striped":
        return _striped(base, other, rng, size_px)
    picture = _patterned(base, rng, size_px)
    if look == "mirrored":
        picture = np.where(np.tri(size_px, dtype=bool)[..., None], picture, picture[::-1, ::-1])
    return picture


def _color(rng: np.random.Generator) -> np.ndarray:
    return rng.uniform(40, 215, 3)


def _striped(base: np.ndarray, other: np.ndarray, rng: np.random.Generator, size_px: int) -> np.ndarray:
    """Even stripes along one side or the other."""
    across = np.arange(size_px) / rng.integers(20, 80)
    on = (across % 1 < rng.uniform(0.3, 0.7))[:, None]
    stripes = np.broadcast_to(np.where(on, base, other)[:, None], (size_px, size_px, 3))
    return (stripes if rng.random() < 0.5 else stripes.swapaxes(0, 1)).astype(np.uint8)


def _patterned(base: np.ndarray, rng: np.random.Generator, size_px: int) -> np.ndarray:
    """Noise of several scales, and patches with edges."""
    picture = np.broadcast_to(base, (size_px, size_px, 3)).astype(np.float32)
    for cell_px in (64, 21, 6):
        cells = max(2, size_px // cell_px)
        noise = rng.standard_normal((cells, cells, 3)).astype(np.float32)
        picture = picture + 25 * cv2.resize(noise, (size_px, size_px), interpolation=cv2.INTER_CUBIC)
    for _ in range(rng.integers(6, 25) * size_px**2 // 256**2):
        center, reach = rng.integers(0, size_px, 2), int(rng.integers(4, 40))
        color = _color(rng).tolist()
        if rng.random() < 0.5:
            cv2.circle(picture, center.tolist(), reach, color, -1)
        else:
            cv2.rectangle(picture, (center - reach).tolist(), (center + reach // 2).tolist(), color, -1)
    return np.clip(picture, 0, 255).astype(np.uint8)
