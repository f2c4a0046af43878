"""Depth seen from the depth camera, moved to the color camera."""

from dataclasses import dataclass

import numba
import numpy as np
from jaxtyping import Float, Float32, Float64

from flowlab.recordings.intrinsics import Intrinsics
from flowlab.recordings.lens import undistorted_rays


@dataclass(frozen=True, slots=True)
class Registration:
    """Where the corners and centers of depth pixels lie as seen from the color camera."""

    corner_rays: Float64[np.ndarray, "H+1 W+1 2"]
    """x / z and y / z of the pixel corners in the depth camera."""
    center_rays: Float64[np.ndarray, "H W 2"]
    T_color_depth: Float64[np.ndarray, "4 4"]
    K: Float64[np.ndarray, "3 3"]
    """Of the color camera [px]."""
    width: int
    """Of the color picture [px]."""
    height: int

    @classmethod
    def make(
        cls,
        depth: Intrinsics,
        size: tuple[int, int],
        T_color_depth: Float[np.ndarray, "4 4"],
        K: Float[np.ndarray, "3 3"],
        color: tuple[int, int],
    ) -> "Registration":
        """For pictures of ``size`` (width, height) of the depth camera and ``color`` of the color camera."""
        centers = np.stack(np.meshgrid(np.arange(size[0]), np.arange(size[1])), -1)
        corners = np.stack(np.meshgrid(np.arange(size[0] + 1) - 0.5, np.arange(size[1] + 1) - 0.5), -1)
        return cls(_rays(corners, depth), _rays(centers, depth), T_color_depth, K, *color)

    def __call__(self, depth_m: Float32[np.ndarray, "Hd Wd"]) -> Float32[np.ndarray, "H W"]:
        """z-depth in the color camera [m]; 0 where no depth pixel lands.

        Every depth pixel is a small square facing the depth camera, drawn into all color pixels whose
        centers it covers; the nearest wins.
        """
        return _splat(depth_m, self.corner_rays, self.center_rays, self.T_color_depth, self.K, self.width, self.height)


def _rays(pixels: np.ndarray, camera: Intrinsics) -> np.ndarray:
    """x / z and y / z of pixel coordinates (..., 2)."""
    return undistorted_rays(camera.lens, camera.K, camera.distortion, pixels)


@numba.njit(cache=True)
def _splat(depth, corners, centers, T, K, width, height) -> np.ndarray:  # type: ignore[no-untyped-def]
    """z-buffer of depth pixels as squares: float32 (height, width)."""
    seen = np.zeros((height, width), np.float32)
    for i in range(depth.shape[0]):
        for j in range(depth.shape[1]):
            z = np.float64(depth[i, j])
            if not (z > 0.0):
                continue
            x, y = centers[i, j, 0] * z, centers[i, j, 1] * z
            front = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
            u0, u1, v0, v1 = np.inf, -np.inf, np.inf, -np.inf
            for k in range(4):
                a, b = corners[i + k // 2, j + k % 2]
                p, q = a * z, b * z
                zc = T[2, 0] * p + T[2, 1] * q + T[2, 2] * z + T[2, 3]
                if zc <= 0.0:
                    front = 0.0
                    break
                u = K[0, 0] * (T[0, 0] * p + T[0, 1] * q + T[0, 2] * z + T[0, 3]) / zc + K[0, 2]
                v = K[1, 1] * (T[1, 0] * p + T[1, 1] * q + T[1, 2] * z + T[1, 3]) / zc + K[1, 2]
                u0, u1, v0, v1 = min(u0, u), max(u1, u), min(v0, v), max(v1, v)
            if front <= 0.0 or u1 < 0.0 or v1 < 0.0 or u0 > width - 1 or v0 > height - 1:
                continue
            for row in range(max(0, int(np.ceil(v0))), min(height - 1, int(np.floor(v1))) + 1):
                for col in range(max(0, int(np.ceil(u0))), min(width - 1, int(np.floor(u1))) + 1):
                    if seen[row, col] == 0.0 or front < seen[row, col]:
                        seen[row, col] = front
    return seen
