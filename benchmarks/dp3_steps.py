"""DP3's own extraction steps, rebuilt for today's libraries without flowlab.

Source: MetaWorldEnv and PointCloudGenerator of the 3D-Diffusion-Policy repository. Per step they take one
color picture for the image observation and one color picture with depth for the cloud, both shaded with
shadows; Open3D unprojects all pixels; numpy turns and crops them in DP3's frame; and 1024 are sampled.

Differences: MetaWorld v3 instead of v2; ``mujoco`` instead of mujoco-py, so depth is a pass of its own (see
``benchmarks/README.md``); Open3D samples, where DP3 uses PyTorch3D on a GPU; episodes are laid out by seed.
"""

import os

os.environ.setdefault("MUJOCO_GL", "egl")  # before mujoco is imported

import sys
import time
from collections.abc import Iterator

import mujoco
import numpy as np
import open3d
from careful_user import make_env, make_policy, reset, step

SIZE, POINTS, STEPS = 128, 1024, 200
CROP_LOW, CROP_HIGH = np.array([-0.5, -1.5, -0.795]), np.array([1.0, -0.4, 100.0])


class Extractor:
    """One task, made once and used for any number of episodes. DP3 renders with shadows, MuJoCo's default."""

    def __init__(self, task: str, *, shadows: bool = True) -> None:
        self.env = make_env(task)
        self.policy = make_policy(task)
        m = self.env.model
        m.cam("corner2").pos[:] = 0.6, 0.295, 0.8
        m.vis.map.znear, m.vis.map.zfar = 0.1, 1.5
        wall = [g for g in range(m.ngeom) if m.body(m.geom_bodyid[g]).name == "RetainingWall"]
        m.geom_matid[wall], m.geom_rgba[wall, 3] = -1, 0  # DP3's copy of MetaWorld has no wall
        self.renderer = mujoco.Renderer(m, SIZE, SIZE)
        self.renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = shadows
        focal = SIZE / 2 / np.tan(np.deg2rad(m.cam("corner2").fovy[0]) / 2)
        self.intrinsics = open3d.camera.PinholeCameraIntrinsic(SIZE, SIZE, focal, focal, SIZE / 2, SIZE / 2)
        self.turn = turn_about_x(61.4) @ turn_about_y(-7)

    def frames(self, seed: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Of every frame of the expert's episode: all points in the crop (P, 6), and their sample (1024, 3)."""
        observation = reset(self.env, seed)
        for _ in range(STEPS):
            self._color()  # the image observation
            cloud = self._cloud()
            yield cloud, sample(cloud)
            observation, _ = step(self.env, self.policy, observation)

    def _cloud(self) -> np.ndarray:
        """xyz in DP3's frame [m] and color of every pixel in the crop."""
        color, depth = self._color(), self._depth()
        cloud = open3d.geometry.PointCloud.create_from_depth_image(
            open3d.geometry.Image(depth), self.intrinsics, depth_scale=1.0
        )
        cloud.transform(np.diag([1.0, -1.0, -1.0, 1.0]))  # to OpenGL's axes, which DP3 takes for the world's
        points = np.concatenate([np.asarray(cloud.points), color.reshape(-1, 3)], axis=1)
        points[:, :3] = points[:, :3] @ self.turn.T
        points = points[np.all(points[:, :3] > CROP_LOW, axis=1)]
        return points[np.all(points[:, :3] < CROP_HIGH, axis=1)]

    def _color(self) -> np.ndarray:
        self.renderer.update_scene(self.env.data, "corner2")
        return self.renderer.render()

    def _depth(self) -> np.ndarray:
        self.renderer.enable_depth_rendering()
        depth = self.renderer.render()
        self.renderer.disable_depth_rendering()
        return depth


def sample(cloud: np.ndarray) -> np.ndarray:
    """Farthest-point sample (1024, 3); a smaller cloud is filled up with zeros."""
    if len(cloud) <= POINTS:
        return np.concatenate([cloud[:, :3], np.zeros((POINTS - len(cloud), 3))])
    points = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(cloud[:, :3]))
    return np.asarray(points.farthest_point_down_sample(POINTS).points)


def turn_about_x(degrees: float) -> np.ndarray:
    """DP3's sense of rotation about x."""
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    return np.array([[1, 0, 0], [0, c, s], [0, -s, c]])


def turn_about_y(degrees: float) -> np.ndarray:
    """DP3's sense of rotation about y."""
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


if __name__ == "__main__":
    extractor = Extractor(sys.argv[1] if len(sys.argv) > 1 else "hammer")
    start = time.process_time()
    count = sum(1 for _ in extractor.frames(seed=0))
    print(f"{count / (time.process_time() - start):.1f} frames per CPU second")
