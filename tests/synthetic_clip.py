"""A small recording whose truth is known: a textured board slides sideways before a textured wall."""

from pathlib import Path

import cv2
import numpy as np

from flowlab.geometry.camera import Camera
from flowlab.recordings.readers.plain import write_rgbd_recording

WIDTH, HEIGHT, FOCAL = 160, 120, 150.0
WALL_M, BOARD_M = 1.0, 0.75
FPS = 10.0
CAMERA = Camera(WIDTH, HEIGHT, np.array([[FOCAL, 0, 79.5], [0, FOCAL, 59.5], [0, 0, 1]]), np.eye(4))
TOP, BOTTOM, LEFT, RIGHT = 30, 90, 25, 95
"""Rows and columns of the board in the first frame; it moves one column to the right per frame."""


def film(frames: int = 20, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Color (T, H, W, 3) and depth (T, H, W) [m]."""
    rng = np.random.default_rng(seed)
    wall, board = (_texture(rng, HEIGHT, WIDTH), _texture(rng, BOTTOM - TOP, RIGHT - LEFT))
    rgb = np.repeat(wall[None], frames, 0)
    depth = np.full((frames, HEIGHT, WIDTH), WALL_M, np.float32)
    for t in range(frames):
        here = np.s_[t, TOP:BOTTOM, LEFT + t : RIGHT + t]
        rgb[here], depth[here] = board, BOARD_M
    return rgb, depth


def _texture(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    coarse = rng.integers(0, 256, (height // 4 + 1, width // 4 + 1, 3)).astype(np.uint8)
    return cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)


def truth(xyz_world: np.ndarray, frames: int) -> np.ndarray:
    """Where points of the first frame (M, 3) [m] are in every frame (T, M, 3) [m]."""
    on_board = xyz_world[:, 2] < (WALL_M + BOARD_M) / 2
    step = np.where(on_board, BOARD_M / FOCAL, 0.0)
    moved = np.repeat(xyz_world[None].astype(np.float64), frames, 0)
    moved[..., 0] += np.arange(frames)[:, None] * step
    return moved


def record(folder: Path, frames: int = 20, seed: int = 0, **more: object) -> Path:
    """Write the film as a recording of a robot with a state of two numbers."""
    rgb, depth = film(frames, seed)
    state = np.stack([0.3 * np.arange(frames), np.arange(frames) ** 2], -1).astype(np.float32)
    values = {"rgb": rgb, "depth": depth, "camera": CAMERA, "time_s": np.arange(frames) / FPS, "state": state, **more}
    write_rgbd_recording(folder, **values)  # type: ignore[arg-type]
    return folder
