"""An expert's demonstration, remembered as poses so that it can be looked at later, from anywhere."""

from dataclasses import dataclass, replace
from typing import Literal, Protocol

import mujoco
import numpy as np
from jaxtyping import Float
from pydantic import Field

from flowlab.config import Settings
from flowlab.errors import DataError, UsageError
from flowlab.geometry.camera import Camera
from flowlab.geometry.transforms import pose_9d, rigid
from flowlab.records import Demonstration, Frame
from flowlab.sim.environment import SceneSettings, Simulation, dp3_camera
from flowlab.sim.scene import Poses, Scene
from flowlab.sim.zbuffer import PackedScene, ZBuffer


class Renderer(Protocol):
    """Makes pictures of a scene whose things are at given poses."""

    def frame(self, poses: Poses) -> Frame:
        """The picture from the renderer's camera."""
        ...


class ExpertSettings(Settings):
    """How long an expert goes on."""

    max_steps: int = Field(default=200, gt=0)
    """DP3's and 3D FDP's limit; 12.5 ms each."""
    stop: Literal["success", "full"] = "success"
    """``success`` ends an episode once the task has been solved for ``hold`` steps; ``full`` records all
    ``max_steps``, as DP3 does."""
    hold: int = Field(default=10, gt=0)
    """Steps the solved state is recorded for."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Rollout(Demonstration):
    """A simulated demonstration: what was done, and the poses from which any of it can be pictured."""

    poses: Poses
    """Of everything, before each action, in MuJoCo's world."""
    scene: Scene
    renderer: Renderer
    T_world_sim: Float[np.ndarray, "4 4"]
    """From MuJoCo's world to the dataset's; the identity but for the DP3 convention."""

    def frame(self, t: int) -> Frame:
        """The picture taken at step ``t``, before action ``t``."""
        return replace(self.renderer.frame(self.poses.at(t)), camera=self.camera)


@dataclass(frozen=True, slots=True)
class Live:
    """The simulation's camera, now."""

    simulation: Simulation
    renderer: Renderer
    camera: Camera

    def frame(self) -> Frame:
        """The picture of this moment."""
        return replace(self.renderer.frame(self.simulation.poses()), camera=self.camera)


class Studio:
    """One task's simulation with its geometry packed: made once, used for any number of episodes."""

    def __init__(self, task: str, settings: SceneSettings) -> None:
        if settings.rgb and settings.renderer != "gl":
            raise UsageError("colour pictures need OpenGL; add --renderer gl (expert.scene.renderer=gl)")
        self.simulation = Simulation(task, settings)
        self._packed = PackedScene(self.simulation.scene)
        self._gl: Renderer | None = None

    def renderer(self, first: Poses) -> Renderer:
        """A renderer for the episode whose first poses are given."""
        sim = self.simulation
        if sim.settings.renderer == "zbuffer":
            return ZBuffer(sim.scene, sim.camera(), first, self._packed)
        if self._gl is None:
            from flowlab.sim.gl import GLRenderer  # only here is OpenGL looked for

            self._gl = GLRenderer(sim.scene, sim.camera(), sim.settings)
        return self._gl

    def live(self) -> "Live":
        """A look at the simulation as it goes on from its last reset."""
        sim = self.simulation
        camera = sim.camera()
        if sim.settings.convention == "dp3":
            camera, _ = dp3_camera(camera)
        return Live(sim, self.renderer(sim.poses()), camera)

    def record_expert(self, seed: int, settings: ExpertSettings) -> Rollout:
        """Let the expert solve the layout of ``seed``, or try to until ``max_steps``.

        Raises :class:`DataError` where the physics becomes unstable.
        """
        sim = self.simulation
        sim.reset(seed)
        expert = sim.expert()
        poses: list[Poses] = []
        states: list[np.ndarray] = []
        actions: list[np.ndarray] = []
        successes: list[bool] = []
        while len(actions) < settings.max_steps:
            poses.append(sim.poses())
            states.append(sim.state)
            actions.append(expert.act())
            successes.append(sim.step(actions[-1]))
            if settings.stop == "success" and sum(successes) >= settings.hold:
                break
        if sim.data.warning[mujoco.mjtWarning.mjWARN_BADQACC].number:
            raise DataError("the physics became unstable, and MuJoCo started it anew")
        return self._rollout(seed, Poses.stack(poses), states, actions, successes)

    def _rollout(
        self, seed: int, poses: Poses, states: list[np.ndarray], actions: list[np.ndarray], successes: list[bool]
    ) -> Rollout:
        sim = self.simulation
        camera, T_world_sim = sim.camera(), np.eye(4)
        if sim.settings.convention == "dp3":
            camera, T_world_sim = dp3_camera(camera)
        body = sim.object_body
        T_sim_object = rigid(poses.body_mat[:, body].reshape(-1, 3, 3), poses.body_pos[:, body])
        return Rollout(
            task=sim.task.name,
            seed=seed,
            camera=camera,
            time_s=np.arange(len(actions)) * sim.step_seconds,
            state=np.stack(states),
            action=np.stack(actions),
            success=np.array(successes),
            object_pose=pose_9d(T_world_sim @ T_sim_object).astype(np.float32),
            extras={"rand_vec": sim.rand_vec.tolist()},
            poses=poses,
            scene=sim.scene,
            renderer=self.renderer(poses.at(0)),
            T_world_sim=T_world_sim,
        )
