"""A body that was lost, out of the picture or behind something, is looked for wherever something new is seen."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8

from flowlab.tracking.trackers.rigid_bodies import _costs
from flowlab.tracking.trackers.rigid_bodies.body_batch import BodyBatch
from flowlab.tracking.trackers.rigid_bodies.features import ClipFeatures
from flowlab.tracking.trackers.rigid_bodies.rigid_motion import RigidMotion

LOST_ENERGY = 0.9
"""A body of a higher energy is not where it is said to be."""
_FOUND_ENERGY, _FOUND_SEEN = 0.5, 0.6
"""What a place must be better than to be a lost body's: most of the body is seen there, and looks as it did."""
_CLOSER = 2.0
"""A body that is this much farther away or nearer than at first is too small or large in the picture to look as it did;
of a thing of few pixels, anything far away does."""
_REACH_M = 0.6
"""How far away a lost body may have come from one frame to the next [m], of pictures that are seldom taken, too: of the
color of a far, small thing is much else, meters away."""
_STEP = 4
"""Every how many pixels, both ways, a place is tried."""
_LIKE, _AS_BEFORE = 0.6, 0.35
"""Costs of color below which a pixel may show the body's middle, and below which it shows what it did at first."""
_WINDOW = (5, 5)
"""[px], of the window whose mean color is compared, too: a texture may be finer than the places."""
_NEARBY_PX = np.array([(x, y, 0.0) for y in range(-2, 3) for x in range(-2, 3)])
"""Shifts between places."""
_FIRST_POINTS, _BEST, _REFINED = 50, 8, 4
"""By how many points places are compared at first, near how many of them others are tried, and how many are refined."""


def find_again(
    batch: BodyBatch, t: int, k: int, last_seen: "LastSeen", lightness: Float32[np.ndarray, "h w"], new: "NewPlaces"
) -> tuple[np.ndarray, np.ndarray, float, float] | None:
    """A pose in which a lost body explains a frame well, as far from where it was last seen as it may be by now.

    Args:
        batch: Some bodies.
        t: The frame.
        k: Which of them is lost.
        last_seen: How the bodies lay when they were last seen.
        lightness: Of the frame.
        new: Where it may be.

    Returns:
        R, s, the energy and the seen share; None where there is no such pose.
    """
    anchor, R = _middle(batch, k), last_seen.R[k]
    near = last_seen.within_reach(k, t, anchor, batch.pictures.stillness, new.like(batch.pictures, anchor))
    if len(near) == 0:
        return None
    every = max(1, batch.points.shape[1] // _FIRST_POINTS)
    places, _ = _best(batch, t, k, R, near, every, _BEST)
    nearby = _NEARBY_PX / batch.pictures.K[0, 0] * places[:, None, 2:]
    places, energy = _best(batch, t, k, R, (places[:, None] + nearby).reshape(-1, 3), every, _REFINED)
    places, of = places[energy < LOST_ENERGY], np.array([k])
    if len(places) == 0:
        return None
    refined = [batch.align(t, R[None], (x - R @ anchor)[None], lightness, of) for x in places]
    turns, shifts = (np.concatenate(x) for x in zip(*refined, strict=True))
    energy, seen = (x[0] for x in batch.fit(t, turns[None], shifts[None], of))
    i = int(energy.argmin())
    if energy[i] > _FOUND_ENERGY or seen[i] < _FOUND_SEEN:
        return None
    return turns[i], shifts[i], float(energy[i]), float(seen[i])


def _best(
    batch: BodyBatch, t: int, k: int, R: np.ndarray, places: np.ndarray, every: int, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Of places (n, 3) [m] of the middle of body k so many as are best, and their energies."""
    shifts = places - R @ _middle(batch, k)
    energy = batch.fit(t, np.tile(R, (1, len(places), 1, 1)), shifts[None], np.array([k]), every)[0][0]
    best = np.argsort(energy, kind="stable")[:count]
    return places[best], energy[best]


@dataclass(frozen=True, slots=True)
class LastSeen:
    """The poses in which B bodies were last seen well, and in which frames that was."""

    R: Float64[np.ndarray, "B 3 3"]
    s: Float64[np.ndarray, "B 3"]
    frame: Int64[np.ndarray, "B"]

    @classmethod
    def at_first(cls, count: int) -> "LastSeen":
        """In the first frame, as they are there."""
        return cls(np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3)), np.zeros(count, int))

    def update(
        self, which: Bool[np.ndarray, "B"], t: int, R: Float64[np.ndarray, "B 3 3"], s: Float64[np.ndarray, "B 3"]
    ) -> None:
        """Frame t shows some of them well, in these poses."""
        self.R[which], self.s[which], self.frame[which] = R[which], s[which], t

    def within_reach(
        self, k: int, t: int, middle: Float64[np.ndarray, "3"], still: RigidMotion, places: Float64[np.ndarray, "n 3"]
    ) -> Float64[np.ndarray, "m 3"]:
        """Those of some places [m] in frame t that the middle [m] of body k may have come to since; ``still`` is how
        what stands still moves before the camera."""
        then = self.frame[k]
        rested = still.R[t] @ still.R[then].T @ (self.R[k] @ middle + self.s[k] - still.t[then]) + still.t[t]
        return places[np.linalg.norm(places - rested, axis=1) <= _REACH_M * (t - then)]


@dataclass(frozen=True, slots=True)
class NewPlaces:
    """Where a frame shows what did not stand there in the first, a grid of pixels."""

    xyz: Float64[np.ndarray, "n 3"]
    """[m], in the camera frame."""
    color: UInt8[np.ndarray, "n 3"]
    """Lightness, a and b."""
    around: UInt8[np.ndarray, "n 3"]
    """The mean of those around it."""

    @classmethod
    def of(cls, pictures: ClipFeatures, t: int) -> "NewPlaces":
        """Those of frame t."""
        grid = pictures.feature[t, ::_STEP, ::_STEP, 1:].reshape(-1, 3)
        v, u = (x.ravel() for x in np.mgrid[: len(pictures.depth[t]) : _STEP, : pictures.depth.shape[2] : _STEP])
        z = pictures.depth[t, v, u].astype(float)
        xyz = pictures.unproject(np.stack([u, v], -1).astype(float), z)
        new = np.flatnonzero(z > 0)
        new = new[~_stood_there(pictures, t, xyz[new], grid[new])]
        return cls(xyz[new], grid[new], cv2.blur(pictures.feature[t], _WINDOW)[v[new], u[new], 1:])

    def like(self, pictures: ClipFeatures, middle: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "k 3"]:
        """Those [m] of a color and about the depth of a point [m] of the first frame."""
        height, width = pictures.depth.shape[1:]
        j, i = np.rint(pictures.project(middle)).astype(int).clip(0, [width - 1, height - 1])
        top, left = max(i - _WINDOW[0], 0), max(j - _WINDOW[0], 0)
        beside = pictures.feature[0, top : i + _WINDOW[0] + 1, left : j + _WINDOW[0] + 1, 1:]
        around, z = cv2.blur(beside, _WINDOW)[i - top, j - left], self.xyz[:, 2]
        like = (z > middle[2] / _CLOSER) & (z < middle[2] * _CLOSER)
        like &= (_unlike(self.around, around) < _LIKE) | (_unlike(self.color, pictures.feature[0, i, j, 1:]) < _LIKE)
        return self.xyz[like]


def _middle(batch: BodyBatch, k: int) -> Float64[np.ndarray, "3"]:
    """Of the points by which body k is followed the one [m] nearest to their center."""
    points = batch.points[k]
    return np.asarray(points[np.linalg.norm(points - points.mean(0), axis=1).argmin()])


def _stood_there(
    pictures: ClipFeatures, t: int, xyz: Float64[np.ndarray, "n 3"], color: UInt8[np.ndarray, "n 3"]
) -> Bool[np.ndarray, "n"]:
    """Whether the first frame shows points [m] of frame t in the same color where they would be if they stood still."""
    height, width = pictures.depth.shape[1:]
    first = (xyz - pictures.stillness.t[t]) @ pictures.stillness.R[t]
    uv, z = np.rint(pictures.project(first)).astype(int), first[:, 2]
    inside = (z > 0.05) & (uv >= 0).all(1) & (uv < [width, height]).all(1)
    j, i = np.where(inside[:, None], uv, 0).T
    near = np.abs(pictures.depth[0, i, j] - z) < _costs.SURFACE_TOLERANCE * np.maximum(1, z * z)
    return inside & near & (_unlike(pictures.feature[0, i, j, 1:], color) < _AS_BEFORE)


def _unlike(a: UInt8[np.ndarray, "n 3"], b: UInt8[np.ndarray, "*n 3"]) -> Float32[np.ndarray, "n"]:
    """What colors (lightness, a, b) that differ cost, 0 and more."""
    off = np.abs(a.astype(np.int16) - b).astype(np.float32)
    return np.asarray(off @ np.array([_costs.L, _costs.A, _costs.B], np.float32))
