"""DP3's camera: a rotated frame centered at the camera, and a shift of half a pixel."""

import numpy as np

from flowlab.geometry.camera import GL_TO_CV, Camera
from flowlab.geometry.transforms import inverse, rigid

_DP3_TURN = np.array([[0.992546, 0, -0.121869], [0.106999, 0.478692, 0.871439], [0.058338, -0.877983, 0.475124]])
"""DP3's rotation of OpenGL camera coordinates into what it calls the world (61.4 and -7 degrees)."""


def dp3_camera(camera: Camera) -> tuple[Camera, np.ndarray]:
    """The camera as DP3 takes it to be, and T_dp3_world from MuJoCo's world to DP3's frame.

    DP3 reads the pose of another camera, whose rotation is the identity, so its frame is centered at the
    camera and turned by constants; and its intrinsics put the image center half a pixel off.
    """
    T_dp3_cam = rigid(_DP3_TURN @ GL_TO_CV, np.zeros(3))
    K = camera.K.copy()
    K[:2, 2] += 0.5
    return Camera(camera.width, camera.height, K, T_dp3_cam), T_dp3_cam @ inverse(camera.T_world_cam)
