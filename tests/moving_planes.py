"""Textured plates that move rigidly before a textured wall, filmed by ray casting: every point's path is known."""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from flowlab.geometry.camera import Camera
from flowlab.records import Clip


@dataclass(frozen=True)
class Plate:
    """A rectangle in its own xy plane, at poses over time in the camera frame."""

    size: tuple[float, float]
    """Width and height [m]."""
    R: np.ndarray
    """(T, 3, 3)"""
    t: np.ndarray
    """(T, 3) [m]"""
    seed: int

    def texture(self) -> np.ndarray:
        rng = np.random.default_rng(self.seed)
        coarse = rng.integers(40, 216, (24, 32, 3)).astype(np.float32)
        return cv2.resize(coarse, (512, 384), interpolation=cv2.INTER_CUBIC).clip(0, 255)


def moving(size: tuple[float, float], start: tuple[float, float, float], velocity: np.ndarray, spin: np.ndarray,
           frames: int, seed: int) -> Plate:  # fmt: skip
    """A plate with constant velocity [m/frame] and spin [rad/frame]."""
    steps = np.arange(frames)[:, None]
    return Plate(size, Rotation.from_rotvec(steps * spin).as_matrix(), np.array(start) + steps * velocity, seed)


def wall(z: float, frames: int) -> Plate:
    """A still wall that fills the picture."""
    return moving((8 * z, 6 * z), (0, 0, z), np.zeros(3), np.zeros(3), frames, seed=99)


def film(plates: list[Plate], width: int = 160, height: int = 120, noise: float = 0.0) -> tuple[Clip, np.ndarray]:
    """The clip, and which plate each pixel of frame 0 shows (H, W)."""
    f = 0.9 * width
    camera = Camera(width, height, np.array([[f, 0, (width - 1) / 2], [0, f, (height - 1) / 2], [0, 0, 1]]), np.eye(4))
    frames = len(plates[0].t)
    v, u = np.mgrid[:height, :width]
    rays = np.stack([(u - camera.K[0, 2]) / f, (v - camera.K[1, 2]) / f, np.ones((height, width))], -1)
    depth = np.full((frames, height, width), np.inf)
    rgb = np.zeros((frames, height, width, 3), np.uint8)
    first = np.full((height, width), -1)
    rng = np.random.default_rng(0)
    for k, plate in enumerate(plates):
        texture = plate.texture()
        for t in range(frames):
            normal = plate.R[t, :, 2]
            z = (normal @ plate.t[t]) / (rays @ normal)
            local = (rays * z[..., None] - plate.t[t]) @ plate.R[t]
            x, y = ((local[..., a] / plate.size[a] + 0.5).astype(np.float32) for a in (0, 1))
            hit = (z > 0) & (z < depth[t]) & (x >= 0) & (x <= 1) & (y >= 0) & (y <= 1)
            color = cv2.remap(texture, x * 511, y * 383, cv2.INTER_LINEAR)
            rgb[t][hit], depth[t][hit] = color[hit].astype(np.uint8), z[hit]
            if t == 0:
                first[hit] = k
    if noise:
        depth += rng.normal(0, noise, depth.shape)
        rgb = (rgb + rng.normal(0, 3, rgb.shape)).clip(0, 255).astype(np.uint8)
    return Clip(rgb, depth.astype(np.float32), camera), first


def paths(plates: list[Plate], clip: Clip, owner: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Where the surface points (T, M, 3) [m] at pixels (M, 2) of frame 0 go."""
    u, v = xy.astype(int).T
    out = np.empty((len(clip), len(xy), 3))
    for m, (x, y) in enumerate(zip(u, v, strict=True)):
        plate = plates[owner[y, x]]
        ray = clip.camera.unproject(np.array([x, y], float), np.array(1.0))
        z = (plate.R[0, :, 2] @ plate.t[0]) / (ray @ plate.R[0, :, 2])
        local = (ray * z - plate.t[0]) @ plate.R[0]
        out[:, m] = plate.R @ local + plate.t
    return out
