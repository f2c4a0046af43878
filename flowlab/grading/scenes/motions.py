"""Motions of procedural scenes: smooth paths of rigid things, whose poses are known exactly."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from flowlab.geometry.transforms import rigid

Path = Float[np.ndarray, "T 4 4"]


def progress(steps: int, begin: float, end: float) -> Float[np.ndarray, "T"]:
    """From 0 to 1 between two shares of the film, without jerks, as a hand moves.

    Args:
        steps: Frames of the film.
        begin: When the motion begins, as a share of the film.
        end: When it ends.

    Returns:
        How much of the motion is done in each frame: the path of least jerk between two rests.
    """
    s = np.clip((np.linspace(0, 1, steps) - begin) / max(end - begin, 1e-9), 0, 1)
    return s**3 * (10 - 15 * s + 6 * s**2)


def still(start: Float[np.ndarray, "4 4"], steps: int) -> Path:
    """A thing that stays where it is."""
    return np.broadcast_to(start, (steps, 4, 4)).copy()


def shifted(path: Path, offset: Float[np.ndarray, "T 3"]) -> Path:
    """A path moved by so much in every frame [m]."""
    moved = path.copy()
    moved[:, :3, 3] += offset
    return moved


def turned(
    path: Path,
    axis: Float[np.ndarray, "3"],
    angle: Float[np.ndarray, "T"],
    pivot: Float[np.ndarray, "3"] | None = None,
) -> Path:
    """A path turned about an axis of the world.

    Args:
        path: Poses to turn.
        axis: Direction of the axis.
        angle: By how much in each frame [rad].
        pivot: A point of the axis [m]; None is the place of the thing itself, in each frame.

    Returns:
        The turned poses.
    """
    R = Rotation.from_rotvec(np.asarray(axis) / np.linalg.norm(axis) * angle[:, None]).as_matrix()
    where = path[:, :3, 3] if pivot is None else np.broadcast_to(pivot, (len(path), 3))
    position = np.einsum("tij,tj->ti", R, path[:, :3, 3] - where) + where
    return rigid(R @ path[:, :3, :3], position)


def carried(path: Path, by: Path, begin: int, end: int) -> Path:
    """A thing that is held by another from one frame to another, and stays where it is put down.

    Args:
        path: Where it would stay.
        by: What holds it.
        begin: The first frame in which it is held.
        end: The first frame in which it is not held any more.

    Returns:
        The poses of the thing.
    """
    held = by @ np.linalg.inv(by[begin]) @ path[begin]
    frames = np.arange(len(path))[:, None, None]
    return np.where(frames < begin, path, np.where(frames < end, held, held[min(end, len(path) - 1)]))


Motion = Callable[[Path, np.random.Generator], Path]
"""Gives a thing that rests a way to move."""


def when(rng: np.random.Generator, steps: int) -> Float[np.ndarray, "T"]:
    """Progress over a random stretch of the film, sometimes only its last fifth, or a brief moment of it."""
    kind = rng.random()
    if kind < 0.15:
        return progress(steps, 0.8, 1.0)
    begin = rng.uniform(0, 0.5)
    return progress(steps, begin, begin + (rng.uniform(0.08, 0.15) if kind < 0.3 else rng.uniform(0.3, 0.5)))


def slide(path: Path, rng: np.random.Generator) -> Path:
    """Along the table, without turning."""
    heading = rng.uniform(0, 2 * np.pi)
    way = rng.uniform(0.06, 0.25) * np.array([np.cos(heading), np.sin(heading), 0])
    return shifted(path, when(rng, len(path))[:, None] * way)


def push(path: Path, rng: np.random.Generator) -> Path:
    """Along the table, turning a little on the way."""
    return slide(spin(path, rng, most=0.8), rng)


def spin(path: Path, rng: np.random.Generator, most: float = 3.0) -> Path:
    """In place, about the vertical."""
    return turned(path, np.array([0, 0, 1.0]), when(rng, len(path)) * rng.uniform(0.3, most) * rng.choice([-1, 1]))


def roll(path: Path, rng: np.random.Generator) -> Path:
    """Along the table, turning about its own y axis as what is round does: its center is as high as its radius."""
    way = rng.uniform(0.06, 0.25) * when(rng, len(path)) * rng.choice([-1, 1])
    axis = path[0, :3, 1]
    heading = np.cross(axis, [0.0, 0.0, 1.0])
    return shifted(turned(path, axis, way / path[0, 2, 3]), way[:, None] * heading)


def lift(path: Path, rng: np.random.Generator) -> Path:
    """Up, over, tilting, and down again somewhere else."""
    s = when(rng, len(path))
    height = rng.uniform(0.05, 0.2) * np.sin(np.pi * s)
    up = shifted(path, np.stack([0 * s, 0 * s, height], -1))
    axis = rng.standard_normal(3) * [1, 1, 0.3]
    return slide(turned(up, axis, rng.uniform(0, 0.9) * np.sin(np.pi * s)), rng)


def leave(path: Path, rng: np.random.Generator) -> Path:
    """Out of the picture, and back."""
    heading = rng.uniform(0, 2 * np.pi)
    away = 1.2 * np.array([np.cos(heading), np.sin(heading), 0])
    out = progress(len(path), 0.15, 0.4) - progress(len(path), 0.6, 0.85)
    return shifted(path, out[:, None] * away)


def rest(path: Path, rng: np.random.Generator) -> Path:
    """Not at all."""
    del rng
    return path
