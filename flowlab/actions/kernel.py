"""Regression with a Gaussian kernel: smooth, and it tells how far a row is from what it learned of."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

MOST_ROWS = 2400
"""More rows are not worth what they cost."""


@dataclass(frozen=True, slots=True)
class KernelRegression:
    """A fitted regression from rows of features to rows of values."""

    x: Float[np.ndarray, "n d"]
    weights: Float[np.ndarray, "n c"]
    mean: Float[np.ndarray, "c"]
    inverse: Float[np.ndarray, "n n"]
    width: float
    """Squared distance at which two rows have little in common."""

    @classmethod
    def fit(
        cls, x: Float[np.ndarray, "n d"], y: Float[np.ndarray, "n c"], *, ridge: float, sharpness: float
    ) -> "KernelRegression":
        """Fit it.

        Args:
            x: Features, at most :data:`MOST_ROWS` rows.
            y: Values.
            ridge: How far it may stay from the values, so that noise is not learned.
            sharpness: How much nearer than the median two rows must be to tell of each other.
        """
        distance = _distances(x, x)
        width = max(float(np.median(distance)), 1e-9) / sharpness
        inverse = np.linalg.inv(np.exp(-distance / width) + ridge * np.eye(len(x)))
        mean = y.mean(0)
        return cls(x, inverse @ (y - mean), mean, inverse, width)

    def predict(self, x: Float[np.ndarray, "m d"]) -> Float[np.ndarray, "m c"]:
        """The values of other rows."""
        return self._kernel(x) @ self.weights + self.mean

    def novelty(self, x: Float[np.ndarray, "m d"]) -> Float[np.ndarray, "m"]:
        """How unlike all that was learned from rows are: from 0 to 1, where nothing is known of them."""
        k = self._kernel(x)
        return np.sqrt(np.clip(1 - np.einsum("ij,ij->i", k @ self.inverse, k), 1e-6, 1))

    def _kernel(self, x: np.ndarray) -> np.ndarray:
        return np.exp(-_distances(x, self.x) / self.width)


def _distances(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Squared distances of all pairs of rows."""
    return np.maximum((a**2).sum(1)[:, None] + (b**2).sum(1)[None] - 2 * a @ b.T, 0)
