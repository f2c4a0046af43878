"""MetaWorld with everything decided by (task, seed)."""

import warnings
from functools import partial
from typing import Annotated, Any, Literal

import metaworld
import mujoco
import numpy as np
from jaxtyping import Float32
from metaworld import policies
from pydantic import Field, PlainSerializer

from flowlab.config import Settings
from flowlab.errors import unknown_name
from flowlab.geometry.camera import Camera
from flowlab.geometry.transforms import inverse, rigid
from flowlab.provenance import Channels
from flowlab.sim.scene import Poses, Scene
from flowlab.sim.tasks import find_task

ACTION_SIZE = 4
"""Hand displacement in x, y, z (1 is 1 cm) and gripper effort, each in [-1, 1]."""
_GL_TO_CV = np.diag([1.0, -1.0, -1.0])
"""MuJoCo's camera looks along -z with y up."""


class CameraSettings(Settings):
    """The camera of a simulated scene."""

    name: str = "corner2"
    """A camera of MetaWorld's models."""
    position: tuple[float, float, float] | None = (0.6, 0.295, 0.8)
    """Moves the camera there [m]; DP3's and 3D FDP's position. null leaves it where the model has it."""
    width: int = Field(default=128, gt=0)
    """[px]"""
    height: int = Field(default=128, gt=0)
    """[px]"""


class SceneSettings(Settings):
    """What the camera is shown, and in which frame the labels are given."""

    camera: CameraSettings = CameraSettings()
    """Where it is looked at from."""
    renderer: Literal["zbuffer", "gl"] = "zbuffer"
    """``zbuffer`` needs no OpenGL; ``gl`` is MuJoCo's own renderer. They agree (see the tests)."""
    rgb: bool = False
    """Also take color pictures; needs ``gl``."""
    markers: bool = True
    """Draw goal markers. In reach, push and pick-place they are all that shows the goal."""
    hidden_bodies: Annotated[frozenset[str], PlainSerializer(sorted)] = frozenset()
    """Bodies not to draw."""
    convention: Literal["flowlab", "dp3"] = "flowlab"
    """``dp3`` reproduces DP3's camera: its rotated, camera-centered frame and its half-pixel shift."""


_WORLD_FRAMES = {
    "flowlab": "MetaWorld's own: z up, table top at z = 0 in most tasks, the robot's base at the origin facing +y",
    "dp3": "DP3's: centered at the camera and turned about 130 degrees about z; robot state stays in MetaWorld's",
}


def describe_scene(settings: SceneSettings) -> dict[str, Any]:
    """What the episodes of a scene are and what their numbers mean: all of their
    :class:`~flowlab.provenance.Provenance` that does not depend on the camera's model."""
    frame = "simulator" if settings.convention == "dp3" else "world"  # DP3 turns the clouds, and not the state
    position, displacement = {"kind": "position", "unit": "m"}, {"kind": "displacement", "unit": "cm"}
    return {
        "kind": "simulated",
        "simulator": "metaworld",
        "scene": settings.model_dump(mode="json"),
        "world_frame": _WORLD_FRAMES[settings.convention],
        "state": (
            Channels(name="hand", index=(0, 1, 2), frame=frame, **position),
            Channels(name="right finger", index=(3, 4, 5), frame=frame, **position),
            Channels(name="left finger", index=(6, 7, 8), frame=frame, **position),
        ),
        "action": (
            Channels(name="hand", index=(0, 1, 2), frame=frame, **displacement),
            Channels(name="gripper", index=(3,), kind="effort", frame="", unit="1"),
        ),
        "action_limits": ((-1.0,) * ACTION_SIZE, (1.0,) * ACTION_SIZE),
    }


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

    def reset(self, seed: int) -> None:
        """Lay the task out as the seed says."""
        env = self._env
        env.seeded_rand_vec, env._freeze_rand_vec = True, False
        env.seed(seed)
        env.reset_model()
        self.rand_vec = env._last_rand_vec.copy()
        env._freeze_rand_vec = True
        self._observation, _ = env.reset()
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
        self._observation, _, _, _, info = self._env.step(action)
        return bool(info["success"])

    def expert(self) -> "Expert":
        """A fresh scripted expert for this task."""
        return Expert(self)

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
        T_world_cam = rigid(cam.xmat.reshape(3, 3) @ _GL_TO_CV, cam.xpos)
        return Camera.from_fovy(c.width, c.height, float(self.model.cam(c.name).fovy[0]), T_world_cam)

    def _manipulated_body(self) -> int:
        """The body whose pose is the object's."""
        m = self.model
        roots = [b for b in sorted(self.scene.movable) if m.body_weldid[b] == b]
        if self.task.manipulated is not None:
            roots = [b for b in roots if self.task.manipulated in _names_below(m, b)]
        assert len(roots) == 1, f"{self.task.name}: which of the bodies {roots} is manipulated?"
        return roots[0]


class Expert:
    """MetaWorld's scripted policy of a task."""

    def __init__(self, simulation: Simulation) -> None:
        self._simulation = simulation
        self._policy = getattr(policies, simulation.task.expert)()

    def act(self) -> Float32[np.ndarray, "4"]:
        """The next action, clipped to [-1, 1]: what is executed, and what a policy should learn."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the policies warn at every step that needs clipping
            action = self._policy.get_action(self._simulation._observation)
        return np.clip(action, -1, 1).astype(np.float32)


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


def _check_camera(model: mujoco.MjModel, name: str) -> None:
    """Refuse a camera that does not exist or rides on something that moves: an episode has one camera pose."""
    fixed = [model.cam(c).name for c in range(model.ncam) if model.body_weldid[model.cam_bodyid[c]] == 0]
    if name not in fixed:
        raise unknown_name("camera that stands still", name, fixed)


def _names_below(model: mujoco.MjModel, body: int) -> set[str]:
    """Names of all bodies welded to a moving body, itself included."""
    return {model.body(b).name for b in range(model.nbody) if model.body_weldid[b] == body}


_DP3_TURN = np.array([[0.992546, 0, -0.121869], [0.106999, 0.478692, 0.871439], [0.058338, -0.877983, 0.475124]])
"""DP3's rotation of OpenGL camera coordinates into what it calls the world (61.4 and -7 degrees)."""


def dp3_camera(camera: Camera) -> tuple[Camera, np.ndarray]:
    """The camera as DP3 takes it to be, and T_dp3_world from MuJoCo's world to DP3's frame.

    DP3 reads the pose of another camera, whose rotation is the identity, so its frame is centered at the
    camera and turned by constants; and its intrinsics put the image center half a pixel off.
    """
    T_dp3_cam = rigid(_DP3_TURN @ _GL_TO_CV, np.zeros(3))
    K = camera.K.copy()
    K[:2, 2] += 0.5
    return Camera(camera.width, camera.height, K, T_dp3_cam), T_dp3_cam @ inverse(camera.T_world_cam)
