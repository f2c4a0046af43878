"""Scenes moved about in the world: the same demonstration, elsewhere on the table."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Int


@dataclass(frozen=True, slots=True)
class SceneAugmentation:
    """A turn about the vertical through a point, then a shift along the table, for each of R runs of windows."""

    R: Float32[np.ndarray, "R 3 3"]
    center: Float32[np.ndarray, "3"]
    """[m], world frame."""
    shift: Float32[np.ndarray, "R 3"]
    """[m], z is 0."""

    @classmethod
    def draw(
        cls, rng: np.random.Generator, runs: int, shift_m: float, turn_deg: float, center: Float[np.ndarray, "3"]
    ) -> "SceneAugmentation":
        """Uniform shifts and turns of up to so much to either side."""
        shift = rng.uniform(-shift_m, shift_m, (runs, 3))
        shift[:, 2] = 0
        angle = np.deg2rad(rng.uniform(-turn_deg, turn_deg, runs))
        c, s, o = np.cos(angle), np.sin(angle), np.zeros(runs)
        R = np.stack([np.stack([c, -s, o], -1), np.stack([s, c, o], -1), np.stack([o, o, o + 1], -1)], 1)
        return cls(R.astype(np.float32), center.astype(np.float32), shift.astype(np.float32))

    def transform_points(
        self, xyz: Float32[np.ndarray, "n *s 3"], run: Int[np.ndarray, "n"]
    ) -> Float32[np.ndarray, "n *s 3"]:
        """Where points of given runs [m], world frame, get to."""
        shift = self.shift[run].reshape(len(run), *[1] * (xyz.ndim - 2), 3)
        return self.rotate_vectors(xyz - self.center, run) + self.center + shift

    def rotate_vectors(
        self, v: Float32[np.ndarray, "n *s 3"], run: Int[np.ndarray, "n"]
    ) -> Float32[np.ndarray, "n *s 3"]:
        """How displacements of given runs turn."""
        return np.einsum("nij,n...j->n...i", self.R[run], v)
