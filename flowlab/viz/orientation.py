"""Which way is up, in the world and in the picture."""

import numpy as np
from jaxtyping import Float

from flowlab.geometry.camera import Camera

_R_UP_CAMERA = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])


def world_is_camera_frame(camera: Camera) -> bool:
    """Whether the world frame is the camera's own, as where nobody has said where the camera stands."""
    return np.allclose(camera.T_world_cam, np.eye(4))


def up_from_world(camera: Camera) -> Float[np.ndarray, "3 3"]:
    """Turns world coordinates so that z points up: not at all, unless the world frame is the camera's own.
    There y points down; x stays, and z becomes y."""
    return _R_UP_CAMERA if world_is_camera_frame(camera) else np.eye(3)


def is_upside_down(camera: Camera) -> bool:
    """Whether the picture's down points up in the world."""
    return bool(camera.T_world_cam[2, 1] > 0)


def project_upright(
    camera: Camera, xyz_world: Float[np.ndarray, "*batch 3"], turned: bool | None = None
) -> Float[np.ndarray, "*batch 2"]:
    """Pixels (u, v) of world points in the picture, turned by 180 degrees if the camera is upside down, or as
    ``turned`` says; not a number behind the camera."""
    uv, z = camera.project(xyz_world)
    if is_upside_down(camera) if turned is None else turned:
        uv = np.array([camera.width - 1, camera.height - 1]) - uv
    return np.where(z[..., None] > 0, uv, np.nan)
