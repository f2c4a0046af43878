"""What a careful user would write with libraries alone: the same clouds as flowlab's defaults, without flowlab.

MuJoCo's OpenGL renderer takes the depth, numpy unprojects and crops, Open3D samples. ``extract.py`` times it
and checks its clouds; run alone, it prints the frames per second of one episode.
"""

import os

os.environ.setdefault("MUJOCO_GL", "egl")  # before mujoco is imported

import sys
import time
import warnings
from collections.abc import Iterator

import metaworld
import mujoco
import numpy as np
import open3d
from metaworld import policies
from metaworld.sawyer_xyz_env import SawyerXYZEnv

BACKGROUND_BODIES = {"world", "tablelink", "RetainingWall"}
CROP_LOW, CROP_HIGH = np.array([-0.5, 0.25, -0.2]), np.array([0.5, 0.97, 0.8])
SIZE, POINTS, MAX_STEPS, HOLD = 128, 1024, 200, 10
STATIC, ALL = int(mujoco.mjtCatBit.mjCAT_STATIC), int(mujoco.mjtCatBit.mjCAT_ALL)
DYNAMIC = ALL & ~STATIC


class Extractor:
    """One task, made once and used for any number of episodes.

    ``static_once`` renders what cannot move once per episode and only the rest per frame. It is the cheapest
    way found that gives the same cloud. Without it every frame takes a depth and a segmentation picture of
    everything, the obvious use of ``mujoco.Renderer``.
    """

    def __init__(self, task: str, *, static_once: bool = True) -> None:
        self.env = make_env(task)
        self.policy = make_policy(task)
        self.static_once = static_once
        m = self.env.model
        m.cam("corner2").pos[:] = 0.6, 0.295, 0.8
        m.vis.quality.offsamples = 0  # multisampling costs time and does nothing for depth
        self.renderer = mujoco.Renderer(m, SIZE, SIZE)
        self.camera = mujoco.MjvCamera()
        self.camera.type, self.camera.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, m.camera("corner2").id
        of_background = [m.body(b).name in BACKGROUND_BODIES for b in m.geom_bodyid]
        self.is_background = np.array([*of_background, True])  # the last is for pixels that show nothing

    def frames(self, seed: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Of every frame of the expert's episode: all points in the crop (P, 3), and their sample (1024, 3)."""
        observation = reset(self.env, seed)
        self._start_episode()
        solved = 0
        for _ in range(MAX_STEPS):
            cloud = self._cloud_over_static() if self.static_once else self._cloud_by_segmentation()
            yield cloud, sample(cloud)
            observation, success = step(self.env, self.policy, observation)
            solved += success
            if solved >= HOLD:
                return

    def _start_episode(self) -> None:
        """Pixel rays in the world frame; and what cannot move: its depth, its points and which to keep."""
        d, m = self.env.data, self.env.model
        focal = SIZE / 2 / np.tan(np.deg2rad(m.cam("corner2").fovy[0]) / 2)
        v, u = np.mgrid[:SIZE, :SIZE].reshape(2, -1) - (SIZE - 1) / 2
        rays = np.stack([u / focal, -v / focal, -np.ones(SIZE * SIZE)], 1)
        self.rays, self.origin = rays @ d.cam("corner2").xmat.reshape(3, 3).T, d.cam("corner2").xpos.copy()
        if self.static_once:
            self.static_depth, background = self._depth(STATIC), self._background()
            self.static_xyz = self.rays * self.static_depth[:, None] + self.origin
            self.static_kept = ~background & in_crop(self.static_xyz)

    def _cloud_over_static(self) -> np.ndarray:
        depth = self._depth(DYNAMIC)
        moving = depth < self.static_depth
        xyz = self.rays[moving] * depth[moving, None] + self.origin
        return np.concatenate([xyz[in_crop(xyz)], self.static_xyz[self.static_kept & ~moving]])

    def _cloud_by_segmentation(self) -> np.ndarray:
        depth = self._depth(ALL)
        kept = ~self._background()
        xyz = self.rays[kept] * depth[kept, None] + self.origin
        return xyz[in_crop(xyz)]

    def _depth(self, categories: int) -> np.ndarray:
        """z-depth (SIZE * SIZE,) [m] of the things of these categories."""
        mujoco.mjv_updateScene(
            self.env.model, self.env.data, mujoco.MjvOption(), None, self.camera, categories, self.renderer.scene
        )
        self.renderer.enable_depth_rendering()
        depth = self.renderer.render().ravel()
        self.renderer.disable_depth_rendering()
        return depth

    def _background(self) -> np.ndarray:
        """Whether each pixel of the scene rendered last shows background, or nothing."""
        self.renderer.enable_segmentation_rendering()
        number, kind = self.renderer.render().reshape(-1, 2).T
        self.renderer.disable_segmentation_rendering()
        is_site = kind == int(mujoco.mjtObj.mjOBJ_SITE)  # comparing with the enum itself takes 4 ms
        return ~is_site & self.is_background[number]


def in_crop(xyz: np.ndarray) -> np.ndarray:
    """Whether points (N, 3) lie strictly in the workspace."""
    return ((xyz > CROP_LOW) & (xyz < CROP_HIGH)).all(1)


def sample(cloud: np.ndarray) -> np.ndarray:
    """Farthest-point sample (1024, 3); a smaller cloud repeats its points."""
    if len(cloud) < POINTS:
        return cloud[np.arange(POINTS) % len(cloud)]
    points = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(cloud))
    return np.asarray(points.farthest_point_down_sample(POINTS).points)


def make_env(task: str) -> SawyerXYZEnv:
    """A MetaWorld environment whose expert can see the goal."""
    env = metaworld.ALL_V3_ENVIRONMENTS[f"{task}-v3"]()
    env._partially_observable = False
    del env.sawyer_observation_space
    env._set_task_called = True
    return env


def make_policy(task: str) -> policies.policy.Policy:
    """MetaWorld's scripted expert."""
    stem = "peg-insertion-side" if task == "peg-insert-side" else task
    return getattr(policies, "Sawyer" + "".join(p.capitalize() for p in stem.split("-")) + "V3Policy")()


def reset(env: SawyerXYZEnv, seed: int) -> np.ndarray:
    """Lay the task out as the seed says; the first observation. Poses are refreshed, which reset forgets."""
    env.seeded_rand_vec, env._freeze_rand_vec = True, False
    env.seed(seed)
    env.reset_model()
    env._freeze_rand_vec = True
    observation, _ = env.reset()
    mujoco.mj_kinematics(env.model, env.data)
    mujoco.mj_comPos(env.model, env.data)
    mujoco.mj_camlight(env.model, env.data)
    return observation


def step(env: SawyerXYZEnv, policy: policies.policy.Policy, observation: np.ndarray) -> tuple[np.ndarray, bool]:
    """One step of the expert: the next observation, and whether the task counts as solved."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        action = policy.get_action(observation)
    observation, _, _, _, info = env.step(np.clip(action, -1, 1).astype(np.float32))
    return observation, bool(info["success"])


if __name__ == "__main__":
    extractor = Extractor(sys.argv[1] if len(sys.argv) > 1 else "hammer")
    start = time.process_time()
    count = sum(1 for _ in extractor.frames(seed=0))
    print(f"{count / (time.process_time() - start):.0f} frames per CPU second")
