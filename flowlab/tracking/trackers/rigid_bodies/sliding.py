"""A surface that slides along itself, step by step: a ball that turns, a cup on its axis, a board in its plane."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

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

    def slides(
        self, turns: Float64[np.ndarray, "K 3"], shifts: Float64[np.ndarray, "K 3"], center: Float64[np.ndarray, "3"]
    ) -> RigidMotion:
        """Steps of turns about a center and shifts: of each one step, two, and so on, each put back onto the surface.

        Args:
            turns: Axes of the turns [rad]; of these and the shifts only the ratio counts.
            shifts: What goes with each [m].
            center: What they turn about [m, camera frame].

        Returns:
            K times ``STEPS`` motions of one frame, those of each slide together, as the frames of one.
        """
        speed = np.linalg.norm(np.cross(turns[:, None], self.xyz - center) + shifts[:, None], axis=-1).max(1)
        size = np.minimum(
            _STEP_M / np.maximum(speed, 1e-9), _STEP_TURN / np.maximum(np.linalg.norm(turns, axis=1), 1e-9)
        )[:, None]
        step = _screws(size * turns, size * (shifts - np.cross(turns, center)))
        motion, steps = RigidMotion.identity(len(turns)), []
        for _ in range(STEPS):
            motion = self._put_back(step @ motion)
            steps.append(motion)
        R, t = np.stack([m.R for m in steps], 1), np.stack([m.t for m in steps], 1)
        return RigidMotion(R.reshape(-1, 3, 3), t.reshape(-1, 3))

    def _put_back(self, motion: RigidMotion) -> RigidMotion:
        """Motions, changed by the least that takes the points onto the surface (point to plane)."""
        for _ in range(_CORRECTIONS):
            moved = motion.apply(self.sliding)
            at = np.asarray(self.tree.query(moved)[1])
            normals, off = self.normals[at], moved - self.xyz[at]
            on = (np.linalg.norm(normals, axis=-1) > 0.5) & (np.linalg.norm(off, axis=-1) < _STEP_M / 2)
            count = np.maximum(on.sum(1), 1)
            center = (moved * on[..., None]).sum(1) / count[:, None]
            away = (moved - center[:, None]) * on[..., None]
            radius = np.sqrt((away**2).sum((1, 2)) / count)[:, None] + 1e-6
            rows = np.concatenate([np.cross(away, normals) / radius[..., None], normals * on[..., None]], -1)
            twist = -_least_squares(rows, (off * normals).sum(-1))
            twist[on.sum(1) < _MIN_POINTS] = 0
            turn = twist[:, :3] / radius
            motion = _screws(turn, twist[:, 3:] - np.cross(turn, center)) @ motion
        return motion


def _least_squares(
    rows: Float64[np.ndarray, "K n 6"], values: Float64[np.ndarray, "K n"]
) -> Float64[np.ndarray, "K 6"]:
    """What rows times it comes nearest to the values, 0 in directions that tell little."""
    across = rows.swapaxes(1, 2)
    told, axes = np.linalg.eigh(across @ rows)  # squares of singular values
    enough = told > np.maximum(_FREE**2 * told[:, -1:], 1e-12)
    along = (axes.swapaxes(1, 2) @ (across @ values[..., None]))[..., 0]
    return (axes @ (np.where(enough, along, 0) / np.where(enough, told, 1))[..., None])[..., 0]


def _screws(turns: Float64[np.ndarray, "K 3"], shifts: Float64[np.ndarray, "K 3"]) -> RigidMotion:
    """The motions that turns about the origin [rad] and shifts [m] are at once: the exponentials of their twists."""
    R, angle = Rotation.from_rotvec(turns).as_matrix(), np.linalg.norm(turns, axis=1, keepdims=True)
    some = angle > 1e-9
    angle = np.where(some, angle, 1)
    axis = turns / angle
    left = (np.cross(axis, shifts)[:, None] @ (np.eye(3) - R).swapaxes(1, 2))[:, 0]
    t = axis * (axis * shifts).sum(1, keepdims=True) + left / angle
    return RigidMotion(R, np.where(some, t, shifts))
