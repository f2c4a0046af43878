"""Stated errors compared with true ones."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

SIGMA_EDGES_MM = (0.0, *(float(2 ** (k / 2)) for k in range(-2, 15)), float("inf"))
"""Limits of the bins of stated error, two to an octave: 0, 0.5, 0.71, 1, ... 128, and no limit."""


CONFIDENTLY_WRONG = (0.02, 4.0)
"""An error is confidently wrong above so many meters and so many times the stated one."""


def confidently_wrong(
    error_m: Float[np.ndarray, "*batch"], sigma_m: Float[np.ndarray, "*batch"], seen: Bool[np.ndarray, "*batch"]
) -> float:
    """How often labels are far off without saying so: the worst that can happen to who trusts them.

    Args:
        error_m: True errors [m]; not a number where there is no answer, which claims nothing.
        sigma_m: Stated ones [m].
        seen: Positions that count: those in sight, or said to be.

    Returns:
        The share of these whose error is above ``CONFIDENTLY_WRONG``; not a number where none counts.
    """
    if not seen.any():
        return float("nan")
    least_m, sigmas = CONFIDENTLY_WRONG
    with np.errstate(invalid="ignore"):
        wrong = (error_m > least_m) & (error_m > sigmas * sigma_m)
    return float(wrong[seen].mean())


@dataclass(frozen=True, slots=True)
class Calibration:
    """Stated errors beside true ones, over every answered pair, seen or not."""

    n: int
    within_1_sigma: float
    """Share of errors below the stated one; 0.68 is meant."""
    within_2_sigma: float
    rank_correlation: float
    """Spearman's, of stated with true errors."""
    count: tuple[int, ...]
    """Pairs in each bin of ``SIGMA_EDGES_MM``."""
    stated_mm: tuple[float, ...]
    """Median stated error of each bin; not a number where it is empty."""
    true_mm: tuple[float, ...]
    """68th percentile of the true errors of each bin: on the diagonal, if sigma is right."""


def calibrate(error_m: Float[np.ndarray, "*batch"], sigma_m: Float[np.ndarray, "*batch"]) -> Calibration | None:
    """What stated errors are worth; pairs without an answer are left out. None where none remains."""
    known = np.isfinite(error_m) & np.isfinite(sigma_m)
    error, sigma = error_m[known] * 1e3, sigma_m[known] * 1e3
    if len(error) == 0:
        return None
    which = np.digitize(sigma, SIGMA_EDGES_MM[1:-1])
    bins = [which == k for k in range(len(SIGMA_EDGES_MM) - 1)]
    return Calibration(
        n=len(error),
        within_1_sigma=float((error < sigma).mean()),
        within_2_sigma=float((error < 2 * sigma).mean()),
        rank_correlation=rank_correlation(sigma, error),
        count=tuple(int(b.sum()) for b in bins),
        stated_mm=tuple(float(np.median(sigma[b])) if b.any() else np.nan for b in bins),
        true_mm=tuple(float(np.percentile(error[b], 68)) if b.any() else np.nan for b in bins),
    )


def rank_correlation(a: Float[np.ndarray, "K"], b: Float[np.ndarray, "K"]) -> float:
    """Spearman's; ties share their mean rank. Not a number where one of the two is constant."""
    x, y = _ranks(a), _ranks(b)
    x, y = x - x.mean(), y - y.mean()
    spread = np.sqrt((x**2).sum() * (y**2).sum())
    return float((x * y).sum() / spread) if spread > 0 else float("nan")


def _ranks(values: Float[np.ndarray, "K"]) -> Float[np.ndarray, "K"]:
    """Ranks from 1, in the mean of their ranks where values are the same."""
    _, place, count = np.unique(values, return_inverse=True, return_counts=True)
    return (np.cumsum(count) - (count - 1) / 2)[place]
