"""Scenes that are filmed by ray casting: a table, a wall, boxes and balls, with textures that stick to them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Box:
    """A box along the axes of the world."""

    center: Vector
    size: Vector
    color: Vector = (150.0, 120, 90)
    contrast: float = 40.0
    """Of its texture."""
    grain_m: float = 0.03

    def moved(self, by: Sequence[float]) -> "Box":
        return replace(self, center=tuple(np.add(self.center, by).tolist()))


TABLE = Box((0.0, 0, -0.02), (1.2, 0.9, 0.04), (170, 150, 120))
WALL = Box((0.0, 1.2, 0.5), (6.0, 0.05, 4.0), (120, 130, 150))
FLOOR = Box((0.0, 0, -0.75), (6.0, 6.0, 0.02), (90, 90, 95))
THINGS = (
    Box((-0.2, 0.1, 0.06), (0.1, 0.1, 0.12), (200, 60, 50)),
    Box((0.15, -0.05, 0.04), (0.16, 0.08, 0.08), (60, 90, 200)),
    Box((0.05, 0.25, 0.1), (0.07, 0.07, 0.2), (60, 180, 80)),
)
SCENE = (TABLE, WALL, FLOOR, *THINGS)
_NOISE = np.random.default_rng(7).uniform(-1, 1, (32, 32, 32))


def looking(eye: Sequence[float], at: Sequence[float] = (0.0, 0.0, 0.05)) -> np.ndarray:
    """``T_world_cam`` of a camera at ``eye`` that looks at a place, its y axis as far down as can be."""
    forward = np.subtract(at, eye) / np.linalg.norm(np.subtract(at, eye))
    right = np.cross(forward, [0.0, 0, 1])
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, 0], T[:3, 1], T[:3, 2], T[:3, 3] = right, np.cross(forward, right), forward, eye
    return T


def film(
    scene: Sequence[Box], K: np.ndarray, size: tuple[int, int], T_world_cam: np.ndarray, seed: int | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Color uint8 (H, W, 3) and z-depth (H, W) [m], 0 where nothing is; ``seed`` adds a sensor's noise."""
    u, v = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones(u.shape)], -1)
    ways = rays @ T_world_cam[:3, :3].T
    depth, rgb = np.full(u.shape, np.inf), np.full((*u.shape, 3), 60.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        for box in scene:
            low, high = np.array(box.center) - np.array(box.size) / 2, np.array(box.center) + np.array(box.size) / 2
            ends = np.sort(np.stack([(c - T_world_cam[:3, 3]) / ways for c in (low, high)]), axis=0)
            enter, leave = ends[0].max(-1), ends[1].min(-1)
            hit = (enter < leave) & (enter > 0.02) & (enter < depth)
            depth[hit] = enter[hit]
            at = T_world_cam[:3, 3] + ways[hit] * enter[hit][:, None]
            shade = 1 - 0.25 * ends[0][hit].argmax(-1) / 2
            rgb[hit] = (np.array(box.color) + box.contrast * _texture((at - box.center) / box.grain_m)) * shade[:, None]
    depth[~np.isfinite(depth)] = 0
    if seed is not None:
        rng = np.random.default_rng(seed)
        rgb += rng.normal(0, 3, rgb.shape)
        depth += (depth > 0) * rng.normal(0, 0.0015, depth.shape) * depth**2
    return rgb.clip(0, 255).astype(np.uint8), depth


def _texture(at: np.ndarray) -> np.ndarray:
    """Smooth noise (N, 1) at places."""
    low = np.floor(at).astype(int)
    part = at - low
    total = np.zeros(len(at))
    for corner in np.ndindex(2, 2, 2):
        weight = np.where(corner, part, 1 - part).prod(-1)
        total += weight * _NOISE[tuple(((low + corner) % 32).T)]
    return total[:, None]
