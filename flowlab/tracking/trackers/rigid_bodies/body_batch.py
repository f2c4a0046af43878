"""Some rigid bodies, as arrays that compiled code takes, each followed by points that it turns to the camera."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32, Int64

from flowlab.tracking.trackers.rigid_bodies import _costs, _energies, _gauss_newton
from flowlab.tracking.trackers.rigid_bodies.features import ClipFeatures
from flowlab.tracking.trackers.rigid_bodies.rigid_motion import nearest_rotation

_ITERATIONS = 6
"""Of Gauss-Newton, for every frame."""
_MAX_STEP_M, _STEP_PENALTY = 0.15, 10.0
"""Nothing moves farther than this from one frame to the next [m]."""
_GRAZING = 0.15
"""Cosine of the angle of view below which a surface is not seen well enough to follow."""
_FACING_SHARE, _MORE_FACING, _LEAST_FACING = 0.9, 1.2, 40
"""Other points are taken where fewer of those in use face the camera, or so many times as many as when they were taken
do; if these are not too few."""


@dataclass(frozen=True, slots=True)
class Surface:
    """What the first frame shows of a body."""

    points: Float64[np.ndarray, "n 3"]
    """[m] in the camera frame."""
    normals: Float64[np.ndarray, "n 3"]
    """0 where not known."""
    features: Float32[np.ndarray, "n 4"]

    @classmethod
    def at_pixels(cls, pictures: ClipFeatures, pixels: Int32[np.ndarray, "n 2"]) -> "Surface":
        """The surface at some pixels (u, v) of the first frame."""
        u, v = pixels.T
        points = pictures.unproject(pixels.astype(float), pictures.smooth[0, v, u].astype(float))
        features = _costs.features_at(pictures.feature[0], pixels.astype(np.float32))
        return cls(points, pictures.normal[0, v, u] / 127, features)

    def facing(self, R: Float64[np.ndarray, "3 3"], s: Float64[np.ndarray, "3"]) -> Bool[np.ndarray, "n"]:
        """Which points a pose turns to the camera; one whose normal is not known counts as if it did."""
        return _energies.facing(self.points, self.normals, R, s, _GRAZING)


class BodyBatch:
    """B bodies, each followed by n points of its surface."""

    def __init__(
        self,
        pictures: ClipFeatures,
        pixels: Sequence[Int32[np.ndarray, "_ 2"]],
        rng: np.random.Generator,
        points: int,
    ) -> None:
        self.pictures = pictures
        self._rng = rng
        self._surfaces = [Surface.at_pixels(pictures, p) for p in pixels]
        self._used = [_sample(np.arange(len(p)), points, rng) for p in pixels]
        self._facing = np.array([len(p) for p in pixels])
        """Among how many points those in use were chosen."""
        chosen = list(zip(self._surfaces, self._used, strict=True))
        self.points = np.stack([surface.points[used] for surface, used in chosen])
        self.features = np.stack([surface.features[used] for surface, used in chosen])
        self.lightness = self.features[..., 1].astype(float)
        self.center = self.points.mean(1)
        self.last_center = self.center
        """Where the bodies' centers (B, 3) [m] were in the frame before the one looked at."""

    def turn(
        self,
        of: Int64[np.ndarray, "k"],
        R: Float64[np.ndarray, "B 3 3"],
        s: Float64[np.ndarray, "B 3"],
    ) -> None:
        """Follow bodies ``of``, which have the poses R, s, by points that they turn to the camera.

        A point on the far side is not seen, which says nothing against the pose that took it there.
        """
        for k in of:
            surface, used = self._surfaces[k], self._used[k]
            facing = surface.facing(R[k], s[k])
            count = int(facing.sum())
            enough = facing[used].mean() >= _FACING_SHARE and count <= _MORE_FACING * self._facing[k]
            if enough or count < _LEAST_FACING:
                continue
            used = _sample(np.flatnonzero(facing), len(used), self._rng)
            self._used[k], self._facing[k] = used, count
            self.points[k], self.features[k] = surface.points[used], surface.features[used]
            self.lightness[k] = self.features[k, :, 1]

    def fit(
        self, t: int, R: np.ndarray, s: np.ndarray, of: np.ndarray | slice = slice(None), every: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        """Energy and seen share of each of some poses, however far they are from where the bodies were."""
        return self._evaluate(t, R, s, of, every, np.zeros(R.shape[:2]), False)

    def _evaluate(
        self, t: int, R: np.ndarray, s: np.ndarray, of: np.ndarray | slice, every: int, base: np.ndarray, best: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        p, what = self.pictures, (self.points[of], self.features[of])
        return _energies.energies(*what, R, s, p.depth[t], p.feature[t], p.K, every, base, best)

    def energies(
        self, t: int, R: np.ndarray, s: np.ndarray, of: np.ndarray | slice = slice(None), every: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        """Energy and seen share (B', C) of candidate poses (B', C, 3, 3), (B', C, 3) in frame t; of a pose that is
        worse than one before it, a bound of the energy that is worse, too."""
        leap = np.linalg.norm(rotate(R, self.center[of][:, None]) + s - self.last_center[of][:, None], axis=-1)
        return self._evaluate(t, R, s, of, every, _STEP_PENALTY * (leap > _MAX_STEP_M), True)

    def align(
        self, t: int, R: np.ndarray, s: np.ndarray, lightness: np.ndarray, of: np.ndarray | slice = slice(None)
    ) -> tuple[np.ndarray, np.ndarray]:
        """Poses (B', 3, 3), (B', 3) refined on frame t, whose lightness is given."""
        p = self.pictures
        R, s = _gauss_newton.align(
            self.points[of], self.lightness[of], R, s, lightness, p.smooth[t], p.normal[t], p.K, _ITERATIONS
        )
        return nearest_rotation(R), s


def rotate(R: np.ndarray, s: np.ndarray) -> np.ndarray:
    """Vectors (..., 3) turned by rotations (..., 3, 3)."""
    return (R @ s[..., None])[..., 0]


def _sample(of: np.ndarray, points: int, rng: np.random.Generator) -> np.ndarray:
    """So many ``of`` some points, all of them if they are as many."""
    if len(of) == points:
        return of
    return rng.choice(of, points, replace=len(of) < points)
