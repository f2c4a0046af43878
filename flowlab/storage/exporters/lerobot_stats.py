"""Statistics as LeRobot keeps them: of every feature, for each episode and for all."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from jaxtyping import Num

_QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
_MOST = 3_000_000
"""So many numbers of a feature are kept at most for its quantiles."""
_THINNED = 3
"""Where there are more, every so many-th is kept: no power of two, as numbers of points often are."""


class FeatureStats:
    """Statistics of a feature, gathered episode by episode."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self._shape = shape
        self._count = self._values = 0
        self._low: Any = np.inf
        self._high: Any = -np.inf
        self._mean: Any = 0.0
        self._squares: Any = 0.0
        self._kept: list[np.ndarray] = []
        self._every = 1

    def add(self, rows: Num[np.ndarray, "K C"], count: int) -> dict[str, Any]:
        """Take in an episode.

        Args:
            rows: Values of every channel.
            count: How many steps they are of.

        Returns:
            The statistics of this episode alone.
        """
        rows = rows.astype(np.float64)
        mean, squares, n = rows.mean(0), ((rows - rows.mean(0)) ** 2).sum(0), len(rows)
        self._low, self._high = np.minimum(self._low, rows.min(0)), np.maximum(self._high, rows.max(0))
        apart, total = mean - self._mean, self._values + n
        self._squares = self._squares + squares + apart**2 * (self._values * n / total)
        self._mean = self._mean + apart * (n / total)
        self._values, self._count = total, self._count + count
        self._keep(rows, total - n)
        return self._told(rows.min(0), rows.max(0), mean, squares / n, rows, count)

    def to_json(self) -> dict[str, Any]:
        """The statistics of all episodes; quantiles are of three million evenly spaced numbers where there are more."""
        variance = self._squares / self._values
        return self._told(self._low, self._high, self._mean, variance, np.concatenate(self._kept), self._count)

    def _keep(self, rows: Num[np.ndarray, "K C"], before: int) -> None:
        """Keep rows for quantiles, of which there were so many before: always every ``self._every``-th of all."""
        self._kept.append(rows[-before % self._every :: self._every])
        while sum(x.size for x in self._kept) > _MOST:
            self._kept = [np.concatenate(self._kept)[::_THINNED]]
            self._every *= _THINNED

    def _told(self, low: Any, high: Any, mean: Any, variance: Any, rows: np.ndarray, count: int) -> dict[str, Any]:
        quantiles = np.quantile(rows, list(_QUANTILES.values()), axis=0)
        values = {
            "min": low,
            "max": high,
            "mean": mean,
            "std": np.sqrt(variance),
            **dict(zip(_QUANTILES, quantiles, strict=True)),
        }
        return {**{k: np.reshape(v, self._shape).tolist() for k, v in values.items()}, "count": [count]}


def flattened(stats: dict[str, Any]) -> dict[str, list[Any]]:
    """The same statistics, each as one list."""
    return {key: np.ravel(value).tolist() for key, value in stats.items()}


def evenly(count: int, most: int) -> Iterable[int]:
    """Indices of at most so many of some pictures, evenly spread."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(int)).tolist()
