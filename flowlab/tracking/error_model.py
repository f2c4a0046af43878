"""What scenes with truth say of the errors of positions like some others."""

from dataclasses import dataclass, fields
from importlib.resources.abc import Traversable
from typing import BinaryIO

import numpy as np
from jaxtyping import Float, Float64

from flowlab.tracking.boosted_trees import BoostedTrees

FAR_M = 0.02
"""An error beyond this is far."""
_NEAREST_M = 0.2
"""What is nearer, or behind the camera, is no surer than this."""


@dataclass(frozen=True, slots=True)
class ErrorModel:
    """Two forests of gradient-boosted trees, and how much is stated of what is likely far off."""

    log_odds: BoostedTrees
    """Of an error above ``FAR_M``."""
    log_error: BoostedTrees
    """Of the error [m] that two in three stay below, at a depth of 1 m."""
    far_off: Float64[np.ndarray, "2 k"]
    """Log-odds of being far off, and the least error [m] that is stated then: so much that more than four times it is
    rare, on scenes that neither forest was fitted to."""

    def stated_error(
        self, evidence: Float[np.ndarray, "*n E"], z: Float[np.ndarray, "*n"]
    ) -> Float64[np.ndarray, "*n"]:
        """The error [m] that two in three of such positions stay below; more, where it is likely that they are far
        off. ``z``: their depths [m]."""
        far = np.interp(self.log_odds(evidence), *self.far_off)
        return np.maximum(np.exp(self.log_error(evidence) + log_scale(z)), far)

    @classmethod
    def read(cls, file: Traversable) -> "ErrorModel":
        """That of a file that :meth:`write` made."""
        with file.open("rb") as stream, np.load(stream, allow_pickle=False) as arrays:
            log_odds, log_error = (
                BoostedTrees(**{f.name: arrays[f"{forest}.{f.name}"] for f in fields(BoostedTrees)})
                for forest in ("log_odds", "log_error")
            )
            return cls(log_odds, log_error, arrays["far_off"])

    def write(self, stream: BinaryIO) -> None:
        """Keep it as the arrays of an ``.npz`` file."""
        arrays = {
            f"{forest}.{f.name}": getattr(getattr(self, forest), f.name)
            for forest in ("log_odds", "log_error")
            for f in fields(BoostedTrees)
        }
        np.savez_compressed(stream, far_off=self.far_off, **arrays)


def log_scale(z: Float[np.ndarray, "*n"]) -> Float64[np.ndarray, "*n"]:
    """Log of how much more an error is at a depth [m] than at 1 m: it grows as a triangulating camera's noise does, by
    the square, also where it is deeper than in any scene with truth."""
    return 2 * np.log(np.maximum(z, _NEAREST_M).astype(np.float64))
