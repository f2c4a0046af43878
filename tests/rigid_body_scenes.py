"""Scenes of two plates before a wall, in the form that the rigid-body fit works on, with their true motions."""

from dataclasses import dataclass
from functools import cache

import moving_planes
import numpy as np

from flowlab.geometry.sampling import farthest_points
from flowlab.records import Clip
from flowlab.tracking.trackers.rigid_bodies.assignment import CellCosts, assign
from flowlab.tracking.trackers.rigid_bodies.bodies import RigidBodyFit
from flowlab.tracking.trackers.rigid_bodies.features import ClipFeatures, extract_features
from flowlab.tracking.trackers.rigid_bodies.motion_segmentation import STEP, segment_motion
from flowlab.tracking.trackers.rigid_bodies.pose_tracking import RigidBody
from flowlab.tracking.trackers.rigid_bodies.rigid_motion import RigidMotion

FRAMES = 16


@dataclass(frozen=True)
class Scene:
    plates: list[moving_planes.Plate]
    clip: Clip
    owner: np.ndarray
    """Which plate each pixel of frame 0 shows (H, W)."""
    pictures: ClipFeatures

    def motion(self, k: int) -> RigidMotion:
        """How a plate truly moves."""
        plate = self.plates[k]
        R = plate.R @ plate.R[0].T
        return RigidMotion(R, plate.t - (R @ plate.t[0]))

    def pixels(self, k: int, border: int = 4) -> np.ndarray:
        """Pixels (n, 2) of frame 0 that show a plate, away from its edges."""
        inner = self.owner == k
        for axis in (0, 1):
            for shift in (-border, border):
                inner = inner & (np.roll(self.owner, shift, axis) == k)
        inner[:border], inner[-border:], inner[:, :border], inner[:, -border:] = False, False, False, False
        v, u = np.nonzero(inner)
        return np.stack([u, v], 1).astype(np.int32)

    def some_pixels(self, k: int, count: int, border: int = 4) -> np.ndarray:
        """Some of them, spread evenly."""
        uv = self.pixels(k, border)
        flat = np.insert(uv, 2, 0, axis=1).astype(np.float32)
        return uv[farthest_points(flat, count)]

    def points(self, uv: np.ndarray) -> np.ndarray:
        """Positions (n, 3) [m] of pixels (n, 2) of frame 0, as the pictures have them."""
        return self.pictures.unproject(uv.astype(float), self.pictures.depth[0, uv[:, 1], uv[:, 0]].astype(float))

    @property
    def owner_of_cell(self) -> np.ndarray:
        """Which plate each cell shows."""
        return self.owner[::STEP, ::STEP]


@cache
def two_plates(noise: float = 0.0, frames: int = FRAMES) -> Scene:
    """One slides to the right and turns; one comes nearer, tilting."""
    return scene([
        moving_planes.wall(1.2, frames),
        moving_planes.moving(
            (0.22, 0.26), (-0.2, -0.12, 0.8), np.array([0.012, 0.003, 0]), np.array([0, 0, 0.022]), frames, 1
        ),
        moving_planes.moving(
            (0.24, 0.22), (0.2, 0.15, 0.9), np.array([-0.003, 0, -0.010]), np.array([0, 0.018, 0]), frames, 2
        ),
    ], noise)  # fmt: skip


@cache
def still_camera_moves(frames: int = FRAMES) -> Scene:
    """Nothing but the camera moves: it turns away from a wall with a plate before it."""
    still = two_plates(frames=1).plates[:2]
    turn = moving_planes.moving((1, 1), (0, 0, 0), np.array([0.02, 0, 0.004]), np.array([0, 0.01, 0.02]), frames, 0)
    plates = [
        moving_planes.Plate(p.size, turn.R @ p.R[0], (turn.R @ p.t[0]) + turn.t, p.seed) for p in still
    ]  # fmt: skip
    return scene(plates)


def scene(plates: list[moving_planes.Plate], noise: float = 0.0) -> Scene:
    """A scene of plates, filmed and made ready."""
    clip, owner = moving_planes.film(plates, noise=noise)
    return Scene(plates, clip, owner, extract_features(clip, 4.0))


def fit_of(seen: Scene, *motions: RigidMotion) -> RigidBodyFit:
    """Motions that are known, as a fit of a scene."""
    cells = CellCosts(seen.pictures, segment_motion(seen.pictures))
    frames = len(seen.pictures)
    nowhere = np.zeros((0, 2), np.int32)
    bodies = tuple(RigidBody(nowhere, m, np.zeros(frames, bool)) for m in motions)
    return RigidBodyFit(cells, bodies, assign(cells, motions))
