"""A surface that slides along itself, step by step: a ball that turns, a cup on its axis, a board in its plane."""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float64
from scipy.spatial import cKDTree

from flowlab.tracking.trackers.rigid_bodies.rigid_motion import RigidMotion

STEPS = 4
_STEP_M, _STEP_TURN = 0.04, 1.2
"""A step moves a surface so far [m], at most by this angle [rad]: the first far enough to be far off and near enough to
be seen, the last as far as things move."""
_CORRECTIONS, _FREE = 2, 0.2
"""Steps toward the surface, none in directions that tell less than this share of what the best one tells."""
_POINTS, _MIN_POINTS = 200, 6


@dataclass(frozen=True, slots=True)
class SlidingSurface:
    """A surface, and what slides on it: itself."""

    xyz: Float64[np.ndarray, "n 3"]
    normals: Float64[np.ndarray, "n 3"]
    tree: cKDTree
    sliding: Float64[np.ndarray, "k 3"]
    """Some points of it."""

    @classmethod
    def of(cls, xyz: Float64[np.ndarray, "n 3"], normals: Float64[np.ndarray, "n 3"]) -> "SlidingSurface":
        """The surface of some points; normals are of length 0 where not known."""
        some = np.random.default_rng(0).permutation(len(xyz))[:_POINTS]
        return cls(xyz, normals, cKDTree(xyz), xyz[some])

    def slide(
        self, turn: Float64[np.ndarray, "3"], shift: Float64[np.ndarray, "3"], center: Float64[np.ndarray, "3"]
    ) -> Iterator[RigidMotion]:
        """Steps of a turn about a center and a shift: one of them, two, and so on, each put back onto the surface."""
        speed = np.linalg.norm(np.cross(turn, self.xyz - center) + shift, axis=1).max()
        size = min(_STEP_M / max(speed, 1e-9), _STEP_TURN / max(float(np.linalg.norm(turn)), 1e-9))
        step = _screw(size * turn, size * (shift - np.cross(turn, center)))
        motion = RigidMotion.identity(1)
        for _ in range(STEPS):
            motion = self._put_back(step @ motion)
            yield motion

    def _put_back(self, motion: RigidMotion) -> RigidMotion:
        """A motion, changed by the least that takes the points onto the surface (point to plane)."""
        for _ in range(_CORRECTIONS):
            moved = motion.apply(self.sliding)[0]
            at = np.asarray(self.tree.query(moved)[1])
            known = np.linalg.norm(self.normals[at], axis=1) > 0.5
            on = known & (np.linalg.norm(moved - self.xyz[at], axis=1) < _STEP_M / 2)
            if on.sum() < _MIN_POINTS:
                break
            center, normals = moved[on].mean(0), self.normals[at[on]]
            radius = np.sqrt(((moved[on] - center) ** 2).sum(1).mean()) + 1e-6
            rows = np.concatenate([np.cross(moved[on] - center, normals) / radius, normals], 1)
            off = ((moved[on] - self.xyz[at[on]]) * normals).sum(1)
            twist = -np.linalg.lstsq(rows, off, rcond=_FREE)[0]
            turn = twist[:3] / radius
            motion = _screw(turn, twist[3:] - np.cross(turn, center)) @ motion
        return motion


def _screw(turn: np.ndarray, shift: np.ndarray) -> RigidMotion:
    """The motion that a turn about the origin [rad] and a shift [m] are at once: the exponential of their twist."""
    R, angle = cv2.Rodrigues(turn)[0], float(np.linalg.norm(turn))
    if angle < 1e-9:
        return RigidMotion(R[None], shift[None])
    axis = turn / angle
    t = axis * (axis @ shift) + (np.eye(3) - R) @ np.cross(axis, shift) / angle
    return RigidMotion(R[None], t[None])
