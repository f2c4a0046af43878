"""Where the camera of a procedural scene stands, and how a hand that holds it moves."""

from collections.abc import Callable
from typing import Literal, TypeAlias

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from flowlab.geometry.transforms import rigid

CameraMotion = Literal["fixed", "hand-held", "hand-held, poses known", "traveling", "traveling, poses known"]
"""What moves the camera of a film; those that travel are not drawn, but asked for."""
CameraPath: TypeAlias = Callable[[Float[np.ndarray, "4 4"], int, np.random.Generator], Float[np.ndarray, "T 4 4"]]
"""Poses of a camera in so many frames, from its first."""


def look_at(eye: Float[np.ndarray, "3"], target: Float[np.ndarray, "3"], roll: float = 0.0) -> np.ndarray:
    """The pose of a camera, in OpenCV's axes, that has a point in the middle of its picture.

    Args:
        eye: Where it stands [m].
        target: What it looks at [m].
        roll: By how much it is turned about its axis [rad].

    Returns:
        Maps the camera's coordinates to the world's [m].
    """
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward], -1)
    return rigid(R @ Rotation.from_euler("z", roll).as_matrix(), eye)


def fixed_camera(
    rng: np.random.Generator, target: Float[np.ndarray, "3"], distance_m: tuple[float, float]
) -> np.ndarray:
    """A random place around a target: in front of it, from a little above the table to almost straight down."""
    azimuth, elevation = rng.uniform(-0.9, 0.9), rng.uniform(0.3, 1.15)
    away = np.array([np.sin(azimuth) * np.cos(elevation), -np.cos(azimuth) * np.cos(elevation), np.sin(elevation)])
    return look_at(target + rng.uniform(*distance_m) * away, target, rng.uniform(-0.08, 0.08))


def held_still(start: Float[np.ndarray, "4 4"], steps: int, rng: np.random.Generator) -> Float[np.ndarray, "T 4 4"]:
    """A camera on a stand."""
    return np.broadcast_to(start, (steps, 4, 4))


def hand_held(start: Float[np.ndarray, "4 4"], steps: int, rng: np.random.Generator) -> Float[np.ndarray, "T 4 4"]:
    """A camera that somebody holds: it wanders by some centimeters and degrees, and trembles."""
    wander, tremble = _smooth(rng, steps, steps / 2), _smooth(rng, steps, 3)
    place = 0.05 * wander[:, :3] + 0.002 * tremble[:, :3]
    angles = 0.06 * wander[:, 3:] + 0.003 * tremble[:, 3:]
    return start @ rigid(Rotation.from_rotvec(angles).as_matrix(), place)


def traveling(start: Float[np.ndarray, "4 4"], steps: int, rng: np.random.Generator) -> Float[np.ndarray, "T 4 4"]:
    """A camera that somebody carries past the scene, turning it: much of what it saw at first leaves its picture."""
    side, ease = rng.choice([-1, 1]), np.linspace(0, 1, steps)[:, None] ** rng.uniform(0.8, 1.5)
    place = ease * [side * rng.uniform(0.1, 0.4), rng.uniform(-0.1, 0.1), rng.uniform(-0.15, 0.15)]
    angles = ease * [rng.uniform(-0.15, 0.15), side * rng.uniform(-0.5, 0.6), rng.uniform(-0.1, 0.1)]
    path = start @ rigid(Rotation.from_rotvec(angles).as_matrix(), place)
    return path @ hand_held(np.eye(4), steps, rng)


def _smooth(rng: np.random.Generator, steps: int, every: float) -> Float[np.ndarray, "T 6"]:
    """Smooth random numbers of about unit size that begin at 0: a knot every so many frames."""
    from scipy.interpolate import CubicSpline

    knots = max(4, int(np.ceil(steps / every)) + 2)
    values = rng.standard_normal((knots, 6))
    values -= values[0]
    return np.asarray(CubicSpline(np.linspace(0, steps, knots), values)(np.arange(steps)))
