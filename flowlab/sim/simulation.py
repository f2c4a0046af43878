"""MetaWorld with everything decided by (task, seed)."""

import logging
from functools import partial
from typing import Any

import metaworld
import mujoco
import numpy as np
from jaxtyping import Float32

from flowlab.errors import DataError, unknown_name
from flowlab.geometry.camera import GL_TO_CV, Camera
from flowlab.geometry.transforms import rigid
from flowlab.sim.scene import Poses, Scene
from flowlab.sim.scene_settings import SceneSettings
from flowlab.sim.tasks import find_task

# Else MuJoCo adds its warnings to a MUJOCO_LOG.TXT in the current folder, through whatever link is there.
mujoco.set_mju_user_warning(logging.getLogger(__name__).warning)


_UNMOVED = "plate-slide"
"""How the tasks begin whose object is where it is whatever the random vector says (tested for all 50)."""


class Simulation:
    """One MetaWorld task, reset by seed and stepped by action.

    The layout of an episode is one random vector drawn from the seed and then frozen, so that neither
    the environment's past nor its double reset can leak into it: an episode is a function of
    (task, seed), bit for bit, in a fresh process or a used environment.
    """

    def __init__(self, task: str, settings: SceneSettings) -> None:
        self.task = find_task(task)
        self.settings = settings
        env = metaworld.ALL_V3_ENVIRONMENTS[self.task.environment]()
        env._partially_observable = False  # the expert needs to see the goal
        del env.sawyer_observation_space  # cached for the hidden goal
        env._set_task_called = True
        env.touching_object = partial(_is_held, env.model, env.data)
        self._env = env
        self.model: mujoco.MjModel = env.model
        self.data: mujoco.MjData = env.data
        _check_camera(self.model, settings.camera.name)
        if settings.camera.position is not None:
            self.model.cam(settings.camera.name).pos[:] = settings.camera.position
        self.scene = Scene(self.model, markers=settings.markers, hidden_bodies=settings.hidden_bodies)
        self.object_body = self._manipulated_body()
        self.rand_vec = np.zeros(0)
        self.observation = np.zeros(0)
        """What MetaWorld tells its scripted experts."""

    def reset(self, seed: int, moved_m: tuple[float, float] = (0.0, 0.0)) -> None:
        """Lay the task out as the seed says, and its object so far away from there along x and y [m].

        Raises:
            DataError: MetaWorld has the task's object in one place always, or the object would be too near to its goal.
        """
        env = self._env
        env.seeded_rand_vec, env._freeze_rand_vec = True, False
        env.seed(seed)
        env.reset_model()
        env._freeze_rand_vec = True
        if any(moved_m):
            if self.task.name.startswith(_UNMOVED):
                raise DataError(f"{self.task.name}: MetaWorld has its object in one place always; use another task")
            env._last_rand_vec[:2] += moved_m  # the vector begins with the object's place
            _check_layout(env, f"{self.task.name} seed {seed}: the object, moved by {moved_m} m,")
        self.rand_vec = env._last_rand_vec.copy()
        self.observation, _ = env.reset()
        # Many tasks move bodies and goal sites last thing in their reset; without this the first frame
        # would show the layout before. mj_forward would do too, but it disturbs the trajectory.
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)

    @property
    def step_seconds(self) -> float:
        """Duration of a control step [s]; 0.0125 in MetaWorld."""
        return float(self._env.dt)

    def step(self, action: Float32[np.ndarray, "4"]) -> bool:
        """Execute an action for one control step; whether the task now counts as solved."""
        self.observation, _, _, _, info = self._env.step(action)
        return bool(info["success"])

    @property
    def unstable(self) -> bool:
        """Whether the physics broke down; then MuJoCo has started it anew, and what follows means nothing."""
        return bool(self.data.warning[mujoco.mjtWarning.mjWARN_BADQACC].number)

    @property
    def state(self) -> Float32[np.ndarray, "9"]:
        """Hand, right and left finger position in MuJoCo's world [m], as DP3 defines it."""
        d = self.data
        parts = d.body("hand").xpos, d.site("rightEndEffector").xpos, d.site("leftEndEffector").xpos
        return np.concatenate(parts).astype(np.float32)

    def poses(self) -> Poses:
        """Where everything is now."""
        return Poses.of(self.data)

    def camera(self) -> Camera:
        """The true camera, in MuJoCo's world."""
        c, cam = self.settings.camera, self.data.cam(self.settings.camera.name)
        T_world_cam = rigid(cam.xmat.reshape(3, 3) @ GL_TO_CV, cam.xpos)
        return Camera.from_fovy(c.width, c.height, float(self.model.cam(c.name).fovy[0]), T_world_cam)

    def _manipulated_body(self) -> int:
        """The body whose pose is the object's."""
        m = self.model
        roots = [b for b in sorted(self.scene.movable) if m.body_weldid[b] == b]
        if self.task.manipulated is not None:
            roots = [b for b in roots if self.task.manipulated in _names_below(m, b)]
        assert len(roots) == 1, f"{self.task.name}: which of the bodies {roots} is manipulated?"
        return roots[0]


def _is_held(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> bool:
    """Whether both fingers press on a geom: what MetaWorld's ``touching_object`` computes, bit for bit.

    That one goes through all contacts in Python, several times a step, which takes longer than the physics.
    """
    touches = data.contact.geom == geom
    if not touches.any():
        return False
    forces = []
    for finger in ("leftpad_geom", "rightpad_geom"):
        both = touches.any(1) & (data.contact.geom == model.geom(finger).id).any(1)
        forces.append(sum(data.efc_force[data.contact.efc_address[both]]))
    return bool(all(force > 0 for force in forces))


def _check_layout(env: Any, what: str) -> None:
    """Reset to a frozen layout, which MetaWorld would draw again for ever where it does not like it."""
    asked = 0

    def once() -> np.ndarray:
        nonlocal asked
        asked += 1
        if asked > 1:
            raise DataError(f"{what} is too near to its goal, and MetaWorld takes no such layout; use another seed")
        return np.asarray(env._last_rand_vec)

    env._get_state_rand_vec = once
    try:
        env.reset_model()
    finally:
        del env._get_state_rand_vec


def _check_camera(model: mujoco.MjModel, name: str) -> None:
    """Refuse a camera that does not exist or rides on something that moves: an episode has one camera pose."""
    fixed = [model.cam(c).name for c in range(model.ncam) if model.body_weldid[model.cam_bodyid[c]] == 0]
    if name not in fixed:
        raise unknown_name("camera that stands still", name, fixed)


def _names_below(model: mujoco.MjModel, body: int) -> set[str]:
    """Names of all bodies welded to a moving body, itself included."""
    return {model.body(b).name for b in range(model.nbody) if model.body_weldid[b] == body}
