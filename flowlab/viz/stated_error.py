"""Stated errors as colors, classes and shares: the same in films, stills and recordings."""

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from flowlab.records import Episode

SIGMA_STEPS_M = (0.005, 0.01, 0.02, 0.05)
"""Stated errors are shown in classes that end below these [m], and a last one without end."""
SIGMA_RGB = ((128, 246, 231), (229, 204, 28), (242, 134, 8), (228, 44, 50), (150, 28, 110))
"""sRGB of the classes: the larger the error, the darker. Told apart by color-blind people, and in gray."""
SIGMA_NAMES = ("< 5 mm", "< 10 mm", "< 20 mm", "< 50 mm", "≥ 50 mm")
COARSE_M = 0.02
"""What is stated from here on [m] is drawn as unsure: with faint trails, and a circle of radius σ around the mark."""
MOST_DRAWN_M = 0.05
"""Circles are drawn no larger than this [m]: what may be farther off is off anywhere, and would hide the rest."""
_PALETTE = np.array(SIGMA_RGB, np.uint8)


def sigma_class(sigma: Float[np.ndarray, "*batch"]) -> Int[np.ndarray, "*batch"]:
    """The class of each stated error [m], counted from 0; what is not a number is in the last."""
    return np.digitize(sigma.astype(np.float32), np.array(SIGMA_STEPS_M, np.float32))


def is_coarse(sigma: Float[np.ndarray, "*batch"]) -> Bool[np.ndarray, "*batch"]:
    """Which stated errors [m] are so large that they are drawn as unsure."""
    return ~(sigma.astype(np.float32) < np.float32(COARSE_M))


def sigma_rgb(sigma: Float[np.ndarray, "*batch"]) -> UInt8[np.ndarray, "*batch 3"]:
    """The color of each stated error [m]."""
    colors: np.ndarray = _PALETTE[sigma_class(sigma)]
    return colors


def stated_sigma(episode: Episode) -> Float[np.ndarray, "T M"] | None:
    """The stated errors [m] of the distinct query points; None of exact tracks."""
    quality = episode.tracks.quality
    return None if quality is None else quality.sigma[:, : episode.queries.count]


def class_shares(sigma: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "5"]:
    """Which share of stated errors is in each class."""
    counts = np.bincount(sigma_class(sigma).ravel(), minlength=len(SIGMA_RGB))
    return counts / max(sigma.size, 1)


def shares_below(sigma: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "5"]:
    """Which share of stated errors is below the end of each class; of the last, which share is in it."""
    shares = class_shares(sigma)
    return np.append(np.cumsum(shares[:-1]), shares[-1])


def percent(share: float) -> str:
    """A share in percent, which is 0 or 100 only where it is none or all."""
    if 0 < share < 0.005:
        return "<1%"
    return ">99%" if 0.995 <= share < 1 else f"{share:.0%}"


def describe_shares(sigma: Float[np.ndarray, "*batch"]) -> str:
    """Which share of stated errors is below the end of each class, in words."""
    *below, _ = shares_below(sigma)
    return "σ " + ", ".join(f"{name} {percent(share)}" for name, share in zip(SIGMA_NAMES, below, strict=False))
