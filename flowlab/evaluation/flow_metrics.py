"""How far predictions of flow are off: several samples of a policy's, and of what needs no policy."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from flowlab.config import Settings
from flowlab.geometry.camera import Camera
from flowlab.grading.tapvid import tapvid


class FlowError(Settings):
    """How far one way of predicting flow is off, over the moving points of some windows."""

    ade_mm: float
    """Mean distance over the steps from now on that the labels cover."""
    fde_mm: float
    """At the last of these steps."""
    apd: float | None
    """TAPVid-3D's share within its limits, of what the camera sees according to the labels; None if that is nothing."""
    average_jaccard: float | None
    """3D-AJ, likewise. A policy predicts no visibility, so the labels' is taken for it."""


class FlowErrors(Settings):
    """Predicted flow of moving points, sampled several times, beside what needs no policy."""

    draws: int
    pairs: int
    """Moving points times steps, over the windows in which something moves."""
    ends: int
    """Moving points, each counted once a window."""
    seen: int
    """Pairs that the camera sees."""
    policy: FlowError
    """The mean over all draws."""
    best_ade_mm: float
    """Of every window only the draw with the least error."""
    best_fde_mm: float
    zero: FlowError
    """Nothing moves."""
    constant: FlowError | None
    """The true velocity of the last step goes on; None for policies that see one frame only."""


@dataclass(frozen=True, slots=True)
class PointStepErrors:
    """P pairs of a moving point and a step: how far each of D predictions is off [m]."""

    policy: Float[np.ndarray, "D P"]
    zero: Float[np.ndarray, "1 P"]
    constant: Float[np.ndarray, "1 P"]
    last: Bool[np.ndarray, "P"]
    """Whether the step is the last of its point that the labels cover."""
    window: Int[np.ndarray, "P"]
    visible: Bool[np.ndarray, "P"]
    xyz_world: Float[np.ndarray, "3 P"]
    """Where the point truly is."""

    def compute(self, camera: Camera | None, *, has_past: bool) -> FlowErrors:
        """The figures of at least one pair."""
        ends = int(self.last.sum())
        return FlowErrors(
            draws=len(self.policy),
            pairs=len(self.window),
            ends=ends,
            seen=int(self.visible.sum()),
            policy=self._error_of(self.policy, camera),
            best_ade_mm=self._least_error(self.window, self.policy),
            best_fde_mm=self._least_error(self.window[self.last], self.policy[:, self.last]),
            zero=self._error_of(self.zero, camera),
            constant=self._error_of(self.constant, camera) if has_past else None,
        )

    def _error_of(self, distance: Float[np.ndarray, "D P"], camera: Camera | None) -> FlowError:
        """The figures of some predictions, averaged over them."""
        apd = average_jaccard = None
        if camera is not None and self.visible.any():
            _, z = camera.project(self.xyz_world.T.astype(np.float64))
            shares = [tapvid(e, self.visible, self.visible, z, camera) for e in distance]
            apd = float(np.mean([x.apd for x in shares]))
            average_jaccard = float(np.mean([x.average_jaccard for x in shares]))
        return FlowError(
            ade_mm=1e3 * float(distance.mean()),
            fde_mm=1e3 * float(distance[:, self.last].mean()),
            apd=apd,
            average_jaccard=average_jaccard,
        )

    @staticmethod
    def _least_error(window: Int[np.ndarray, "Q"], distance: Float[np.ndarray, "D Q"]) -> float:
        """The mean [mm] if every window has the draw whose own mean is least."""
        totals = np.stack([np.bincount(window, of_sample) for of_sample in distance])
        return 1e3 * float(totals.min(0).sum() / len(window))


def pool_errors(each: Sequence[FlowErrors]) -> FlowErrors | None:
    """Of several demonstrations together."""
    if not each:
        return None
    pairs, ends, seen = ([getattr(f, name) for f in each] for name in ("pairs", "ends", "seen"))
    constant = [f.constant for f in each if f.constant is not None]
    return FlowErrors(
        draws=each[0].draws,
        pairs=sum(pairs),
        ends=sum(ends),
        seen=sum(seen),
        policy=_pool([f.policy for f in each], pairs, ends, seen),
        best_ade_mm=float(np.average([f.best_ade_mm for f in each], weights=pairs)),
        best_fde_mm=float(np.average([f.best_fde_mm for f in each], weights=ends)),
        zero=_pool([f.zero for f in each], pairs, ends, seen),
        constant=_pool(constant, pairs, ends, seen) if constant else None,
    )


def _pool(each: Sequence[FlowError], pairs: Sequence[int], ends: Sequence[int], seen: Sequence[int]) -> FlowError:
    """The mean of some errors, each as heavy as the pairs, ends or seen pairs it is of."""

    def mean(name: str, weights: Sequence[int]) -> float | None:
        known = [(getattr(e, name), w) for e, w in zip(each, weights, strict=True) if getattr(e, name) is not None]
        return float(np.average([v for v, _ in known], weights=[w for _, w in known])) if known else None

    return FlowError.model_validate(
        {
            "ade_mm": mean("ade_mm", pairs),
            "fde_mm": mean("fde_mm", ends),
            "apd": mean("apd", seen),
            "average_jaccard": mean("average_jaccard", seen),
        }
    )
