"""What scenes with truth say of the errors of positions like some others."""

from dataclasses import dataclass, fields
from importlib.resources.abc import Traversable
from typing import Any, BinaryIO

import numpy as np
from jaxtyping import Float, Float64

from flowlab.tracking.boosted_trees import BoostedTrees

FAR_M = 0.02
"""An error beyond this is far."""
_NEAREST_M = 0.2
"""What is nearer, or behind the camera, is no surer than this."""


@dataclass(frozen=True, slots=True)
class Doubt:
    """How likely errors are to be beyond some length, and what is stated because of that."""

    log_odds: BoostedTrees
    stated: Float64[np.ndarray, "2 k"]
    """Log-odds, and the least error [m] that is stated then: so much that more than four times it is rare, on scenes
    that no trees were fitted to."""

    def least(self, evidence: Float[np.ndarray, "*n E"]) -> Float64[np.ndarray, "*n"]:
        """The error [m] that is stated at least."""
        return np.asarray(np.interp(self.log_odds(evidence), *self.stated))


@dataclass(frozen=True, slots=True)
class ErrorModel:
    """Forests of gradient-boosted trees: one of how large errors are, others of how likely they are large."""

    log_error: BoostedTrees
    """Of the error [m] that two in three stay below, at a depth of 1 m."""
    doubts: tuple[Doubt, ...]

    def stated_error(
        self, evidence: Float[np.ndarray, "*n E"], z: Float[np.ndarray, "*n"]
    ) -> Float64[np.ndarray, "*n"]:
        """The error [m] that two in three of such positions stay below; more, where it is likely that they are far
        off. ``z``: their depths [m]."""
        usual = np.exp(self.log_error(evidence) + log_scale(z))
        return np.asarray(np.maximum.reduce([usual, *(d.least(evidence) for d in self.doubts)]))

    @classmethod
    def read(cls, file: Traversable) -> "ErrorModel":
        """That of a file that :meth:`write` made."""
        with file.open("rb") as stream, np.load(stream, allow_pickle=False) as arrays:
            log_error, *log_odds = (
                BoostedTrees(**{f.name: arrays[f"{k}.{f.name}"] for f in fields(BoostedTrees)})
                for k in range(sum(name.endswith(".root") for name in arrays))
            )
            return cls(log_error, tuple(Doubt(d, arrays[f"{k + 1}.stated"]) for k, d in enumerate(log_odds)))

    def write(self, stream: BinaryIO) -> None:
        """Keep it as the arrays of an ``.npz`` file."""
        forests = (self.log_error, *(d.log_odds for d in self.doubts))
        arrays: Any = {
            f"{k}.{f.name}": getattr(forest, f.name) for k, forest in enumerate(forests) for f in fields(forest)
        }
        arrays |= {f"{k + 1}.stated": doubt.stated for k, doubt in enumerate(self.doubts)}
        np.savez_compressed(stream, **arrays)


def log_scale(z: Float[np.ndarray, "*n"]) -> Float64[np.ndarray, "*n"]:
    """Log of how much more an error is at a depth [m] than at 1 m: it grows as a triangulating camera's noise does, by
    the square, also where it is deeper than in any scene with truth."""
    return 2 * np.log(np.maximum(z, _NEAREST_M).astype(np.float64))
