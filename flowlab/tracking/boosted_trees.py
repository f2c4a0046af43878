"""Gradient-boosted regression trees (Friedman 2001), as plain arrays: fitted elsewhere, evaluated here."""

from dataclasses import dataclass

import numba
import numpy as np
from jaxtyping import Float, Float32, Float64, Int16, Int32


@dataclass(frozen=True, slots=True)
class BoostedTrees:
    """K trees of n nodes in all, whose leaves' values are added up."""

    root: Int32[np.ndarray, "K"]
    column: Int16[np.ndarray, "n"]
    """Which number decides in every node; -1 in a leaf."""
    threshold: Float64[np.ndarray, "n"]
    """It goes to the left up to this."""
    children: Int32[np.ndarray, "n 2"]
    """The nodes to the left and to the right."""
    value: Float32[np.ndarray, "n"]
    """Of the leaves."""

    def __call__(self, evidence: Float[np.ndarray, "*n E"]) -> Float32[np.ndarray, "*n"]:
        """The sum of the trees for each row."""
        rows = np.ascontiguousarray(evidence.reshape(-1, evidence.shape[-1]), np.float64)
        total = _evaluate(rows, self.root, self.column, self.threshold, self.children, self.value)
        return total.astype(np.float32).reshape(evidence.shape[:-1])


@numba.njit(cache=True)
def _evaluate(rows, root, column, threshold, children, value) -> np.ndarray:  # type: ignore[no-untyped-def]
    total = np.zeros(len(rows))
    for i in range(len(rows)):
        for node in root:
            while column[node] >= 0:
                node = children[node, 0 if rows[i, column[node]] <= threshold[node] else 1]
            total[i] += value[node]
    return total
