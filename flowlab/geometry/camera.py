"""The pinhole camera, in OpenCV's convention."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Num

from flowlab.shapes import Record, Size

GL_TO_CV = np.diag([1.0, -1.0, -1.0])
"""OpenGL's cameras, and MuJoCo's, look along -z with y up."""
_ROTATION_TOLERANCE = 1e-3
"""So much may a rotation times its transpose differ from the identity: what rounding to three digits does."""


def pose_fault(T: Float[np.ndarray, "4 4"]) -> str:
    """Why a matrix is no pose, in words that follow the name of it; empty where it is one."""
    R, last = T[:3, :3], T[3]
    if not np.isfinite(T).all():
        return "holds a number that is not finite"
    if np.abs(last - [0, 0, 0, 1]).max() > 1e-6:
        return f"has the last row {last.tolist()}, expected [0, 0, 0, 1]"
    off = np.abs(R @ R.T - np.eye(3)).max()
    if off > _ROTATION_TOLERANCE or np.linalg.det(R) < 0:
        what = f"is off by {off:.2g}" if off > _ROTATION_TOLERANCE else "mirrors"
        return f"holds no rotation (it {what}), expected columns that are right-handed axes"
    return ""


@dataclass(frozen=True, slots=True, repr=False)
class Camera(Record):
    """A calibrated pinhole camera without distortion.

    Axes: x right, y down, z forward. The center of pixel (u, v) lies at integer coordinates (u, v), so
    an image of width W whose optical axis passes through its middle has ``cx = (W - 1) / 2``.
    """

    width: int
    """[px]"""
    height: int
    """[px]"""
    K: Float[np.ndarray, "3 3"]
    """Intrinsics [px]."""
    T_world_cam: Float[np.ndarray, "4 4"]
    """Camera pose: maps camera coordinates to world coordinates [m]."""

    def lengths(self) -> dict[str | int, int]:
        """Of its pictures: height and width.

        Returns:
            The length of ``H`` and ``W`` [px].
        """
        return {"H": self.height, "W": self.width}

    def sizes(self) -> dict[str, Size]:
        """Of its pictures, too: height and width.

        Returns:
            Every named dimension, and which field says its length.
        """
        own = {"H": Size(self.height, "height"), "W": Size(self.width, "width")}
        return {**Record.sizes(self), **own}

    def _check_values(self) -> None:
        for name in ("width", "height"):
            if not getattr(self, name) > 0:
                raise self._wrong(name, f"is {getattr(self, name)}, expected a number of pixels above 0")
        if not np.isfinite(self.K).all():
            raise self._wrong("K", "holds a number that is not finite")
        fx, skew, fy = self.K[0, 0], self.K[0, 1], self.K[1, 1]
        if not (fx > 0 and fy > 0):
            raise self._wrong("K", f"has the focal lengths {fx:g} and {fy:g}, expected pixels above 0")
        if not (np.abs(self.K[2] - [0, 0, 1]).max() < 1e-6 and abs(self.K[1, 0]) < 1e-6 and abs(skew) < 1e-3 * fx):
            raise self._wrong("K", f"is {self.K.tolist()}, expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]")
        if fault := pose_fault(self.T_world_cam):
            raise self._wrong("T_world_cam", fault)

    def at(self, T_world_cam: Float[np.ndarray, "4 4"]) -> "Camera":
        """The same camera elsewhere.

        Args:
            T_world_cam: Its pose there.

        Returns:
            The camera with that pose.
        """
        return replace(self, T_world_cam=T_world_cam)

    @classmethod
    def from_fovy(cls, width: int, height: int, fovy_deg: float, T_world_cam: np.ndarray) -> "Camera":
        """A centered camera with square pixels.

        Args:
            width: Of its pictures [px].
            height: Of its pictures [px].
            fovy_deg: Vertical field of view [degrees].
            T_world_cam: Its pose (4, 4): maps camera coordinates to world coordinates [m].

        Returns:
            The camera, whose optical axis passes through the middle of the picture.
        """
        f = 0.5 * height / np.tan(np.deg2rad(fovy_deg) / 2)
        K = np.array([[f, 0, (width - 1) / 2], [0, f, (height - 1) / 2], [0, 0, 1.0]])
        return cls(width, height, K, T_world_cam)

    def project(
        self, xyz_world: Num[np.ndarray, "*batch 3"]
    ) -> tuple[Float[np.ndarray, "*batch 2"], Float[np.ndarray, "*batch"]]:
        """Where world points are in the picture.

        Args:
            xyz_world: Points in the world frame [m].

        Returns:
            Their pixel coordinates (u, v) [px], which may lie outside the picture, and their z-depth [m]; a point with
            z <= 0 is behind the camera, and its pixel means nothing.
        """
        R, t = self.T_world_cam[:3, :3], self.T_world_cam[:3, 3]
        xyz_cam = (xyz_world - t) @ R
        z = xyz_cam[..., 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            uv = (xyz_cam @ self.K.T)[..., :2] / z[..., None]
        return uv, z

    def unproject(self, uv: Num[np.ndarray, "*batch 2"], z: Num[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch 3"]:
        """The inverse of :meth:`project`.

        Args:
            uv: Pixel coordinates (u, v) [px].
            z: Depth along the optical axis [m].

        Returns:
            Points in the world frame [m].
        """
        u = (uv[..., 0] - self.K[0, 2]) / self.K[0, 0]
        v = (uv[..., 1] - self.K[1, 2]) / self.K[1, 1]
        xyz_cam = np.stack([u, v, np.ones_like(u)], -1) * np.asarray(z)[..., None]
        return xyz_cam @ self.T_world_cam[:3, :3].T + self.T_world_cam[:3, 3]

    def to_json(self) -> dict[str, Any]:
        """The camera as plain JSON values.

        Returns:
            ``width``, ``height``, ``K`` and ``T_world_cam``, matrices row by row.
        """
        return {
            "width": int(self.width),
            "height": int(self.height),
            "K": self.K.tolist(),
            "T_world_cam": self.T_world_cam.tolist(),
        }

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> "Camera":
        """The inverse of :meth:`to_json`.

        Args:
            values: What :meth:`to_json` gives.

        Returns:
            The camera.
        """
        return cls(
            values["width"], values["height"], np.array(values["K"], float), np.array(values["T_world_cam"], float)
        )
