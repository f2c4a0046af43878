"""Exact tracks of the surface points that given pixels of the first frame show."""

import mujoco
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int8

from flowlab.geometry.camera import Camera
from flowlab.geometry.transforms import apply, inverse
from flowlab.records import Frame, Queries
from flowlab.sim.exact_tracks import RigidFlowSettings, rigid_tracks
from flowlab.sim.recorder import Rollout

RAY_TOLERANCE_M = 0.003
"""A ray that ends this close before a point has met the surface the point itself lies on."""
_DRAWN_GROUPS = np.array([1, 1, 1, 0, 0, 0], np.uint8)


def surface_tracks(
    rollout: Rollout, first: Frame, pixel: Int[np.ndarray, "N 2"]
) -> tuple[Float32[np.ndarray, "T N 3"], Bool[np.ndarray, "T N"], Int8[np.ndarray, "N"]]:
    """Tracks in the camera frame [m], whether the camera sees the points, and the roles of what they lie on.

    ``first`` is the first frame as the simulator has it, ``pixel`` (x, y) where it shows something. A point is
    seen if it lies within the picture and the ray to it (``mj_ray``) meets nothing else before it.
    """
    x, y = pixel.T
    assert first.owner is not None
    owner = first.owner[y, x]
    xyz_world = first.camera.unproject(pixel.astype(np.float64), first.depth[y, x].astype(np.float64))
    queries = Queries(xyz_world.astype(np.float32), owner, len(pixel), first.entities)
    tracks_world, _ = rigid_tracks(rollout, queries, RigidFlowSettings())
    role = np.array([e.role for e in first.entities], np.int8)[owner]
    tracks_cam = apply(inverse(_camera_poses(rollout))[:, None], tracks_world.astype(np.float64))
    return tracks_cam.astype(np.float32), visible_by_rays(rollout, tracks_world), role


def visible_by_rays(rollout: Rollout, xyz_world: Float[np.ndarray, "T N 3"]) -> Bool[np.ndarray, "T N"]:
    """Whether the camera sees points of surfaces. Single rays, because ``mj_multiRay`` misses thin things in
    MuJoCo 3.3.0."""
    model, T_sim_world = rollout.scene.model, inverse(rollout.T_world_sim)
    inside = np.stack([_in_picture(rollout.camera_at(t), xyz) for t, xyz in enumerate(xyz_world)])
    eye = apply(T_sim_world, _camera_poses(rollout)[:, :3, 3])
    away = apply(T_sim_world, xyz_world.astype(np.float64)) - eye[:, None]
    distance = np.linalg.norm(away, axis=-1)
    data, met = mujoco.MjData(model), np.zeros(1, np.int32)
    mujoco.mj_forward(model, data)
    seen = np.zeros(distance.shape, bool)
    for t in range(len(seen)):
        poses = rollout.poses.at(t)
        data.geom_xpos[:], data.geom_xmat[:] = poses.geom_pos, poses.geom_mat
        for n in np.flatnonzero(inside[t]):
            free = mujoco.mj_ray(model, data, eye[t], away[t, n] / distance[t, n], _DRAWN_GROUPS, 1, -1, met)
            seen[t, n] = free < 0 or free > distance[t, n] - RAY_TOLERANCE_M
    return seen


def _camera_poses(rollout: Rollout) -> Float[np.ndarray, "T 4 4"]:
    """Of a camera that moves, or stands still, in every frame."""
    if rollout.T_world_cam is not None:
        return rollout.T_world_cam
    return np.broadcast_to(rollout.camera.T_world_cam, (len(rollout), 4, 4))


def _in_picture(camera: Camera, xyz_world: Float[np.ndarray, "N 3"]) -> Bool[np.ndarray, "N"]:
    """Which points lie before the camera, and within its picture."""
    uv, z = camera.project(xyz_world)
    return np.asarray((z > 0) & (uv > -0.5).all(-1) & (uv < np.array([camera.width, camera.height]) - 0.5).all(-1))
