"""Small recordings made by hand: a camera looks at a tilted plane, and every frame is told apart by its color."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from flowlab.geometry.camera import Camera
from flowlab.recordings.recording import Recording, RecordingSettings, open_recording

WIDTH, HEIGHT, STEPS = 32, 24, 6
INTRINSICS = {"width": WIDTH, "height": HEIGHT, "fx": 30.0, "fy": 31.0, "cx": 15.2, "cy": 11.7}
K = np.array([[30.0, 0, 15.2], [0, 31.0, 11.7], [0, 0, 1]])
CAMERA = Camera(WIDTH, HEIGHT, K, np.eye(4))


def colors(steps: int = STEPS, size: tuple[int, int] = (WIDTH, HEIGHT)) -> np.ndarray:
    """RGB pictures (T, H, W, 3) that differ in every frame, channel and direction."""
    t, v, u = np.meshgrid(np.arange(steps), np.arange(size[1]), np.arange(size[0]), indexing="ij")
    return np.stack([7 * t + u, 40 + 5 * v, 200 - 3 * u - v], -1).astype(np.uint8)


def counts(steps: int = STEPS, size: tuple[int, int] = (WIDTH, HEIGHT)) -> np.ndarray:
    """Depth pictures (T, H, W) uint16 in millimeters, with a hole that never closes."""
    t, v, u = np.meshgrid(np.arange(steps), np.arange(size[1]), np.arange(size[0]), indexing="ij")
    depth = (700 + 10 * t + 3 * u + 2 * v).astype(np.uint16)
    depth[:, 2:4, 5:9] = 0
    return depth


def write_png(path: Path, picture: np.ndarray) -> None:
    """A PNG of an RGB or depth picture."""
    path.parent.mkdir(parents=True, exist_ok=True)
    bgr = picture[..., ::-1] if picture.ndim == 3 else picture
    assert cv2.imwrite(str(path), np.ascontiguousarray(bgr))


def write_folder(folder: Path, *, steps: int = STEPS, **yaml_keys: Any) -> Path:
    """A plain folder, its ``recording.yaml`` with these keys beside the usual; None leaves a key out."""
    for t, (rgb, depth) in enumerate(zip(colors(steps), counts(steps), strict=True)):
        write_png(folder / "color" / f"{t:04d}.png", rgb)
        write_png(folder / "depth" / f"{t:04d}.png", depth)
    write_yaml(folder / "recording.yaml", **{"fps": 10, "depth_unit_m": 0.001, "intrinsics": INTRINSICS, **yaml_keys})
    return folder


def write_yaml(path: Path, **keys: Any) -> Path:
    """A YAML file; keys that are None are left out."""
    path.write_text(yaml.safe_dump({k: v for k, v in keys.items() if v is not None}))
    return path


def opened(path: Path, **settings: Any) -> Recording:
    """The recording, with these settings."""
    return open_recording(path, RecordingSettings(**settings), task="pour", seed=3)


def said(recording: Recording, about: str) -> str:
    """What the only check of something says."""
    (check,) = [c for c in recording.extras["checks"] if c["about"] == about]
    return str(check["says"])


def assert_frames(recording: Recording, rows: list[int], *, exact_color: bool = True) -> None:
    """Row k of the recording is frame ``rows[k]`` of :func:`colors` and :func:`counts`."""
    assert len(recording) == len(rows)
    for k, t in enumerate(rows):
        frame = recording.frame(k)
        assert frame.depth.dtype == np.float32
        np.testing.assert_array_equal(frame.depth, counts(t + 1)[t].astype(np.float32) * np.float32(0.001))
        assert frame.rgb is not None
        assert frame.rgb.dtype == np.uint8
        if exact_color:
            np.testing.assert_array_equal(frame.rgb, colors(t + 1)[t])
