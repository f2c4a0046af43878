"""An expert's demonstration, remembered as poses so that it can be looked at later, from anywhere."""

from dataclasses import dataclass, replace
from typing import Literal, Protocol

import numpy as np
from jaxtyping import Float, Float32
from pydantic import Field

from flowlab.config import Settings
from flowlab.demonstrations import Demonstration
from flowlab.errors import DataError, UsageError
from flowlab.geometry.camera import Camera
from flowlab.geometry.transforms import pose_9d, rigid
from flowlab.records import Frame
from flowlab.sim.dp3_camera import dp3_camera
from flowlab.sim.expert import Expert
from flowlab.sim.render.zbuffer import PackedScene, ZBuffer
from flowlab.sim.scene import Poses, Scene
from flowlab.sim.scene_settings import SceneSettings
from flowlab.sim.simulation import Simulation


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


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
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
        return _seen_by(self.camera_at(t), self.renderer.frame(self.poses.at(t)))


def _seen_by(camera: Camera, frame: Frame) -> Frame:
    """A renderer's frame with the camera's pose in the dataset's world, which may not be MuJoCo's."""
    return frame if frame.camera is camera else replace(frame, camera=camera)


class EpisodeRecorder:
    """An episode under way: looked at and acted in step by step, and remembered as poses."""

    def __init__(self, simulation: Simulation, seed: int, renderer: Renderer) -> None:
        self.simulation, self.seed, self.renderer = simulation, seed, renderer
        self.camera, self.T_world_sim = simulation.camera(), np.eye(4)
        if simulation.settings.convention == "dp3":
            self.camera, self.T_world_sim = dp3_camera(self.camera)
        self._poses: list[Poses] = []
        self._state: list[np.ndarray] = []
        self._action: list[np.ndarray] = []
        self.success: list[bool] = []
        """Whether the task counted as solved, after every action so far."""

    def frame(self) -> Frame:
        """The picture of this moment."""
        return _seen_by(self.camera, self.renderer.frame(self.simulation.poses()))

    @property
    def unstable(self) -> bool:
        """Whether the physics broke down."""
        return self.simulation.unstable

    def step(self, action: Float32[np.ndarray, "4"]) -> bool:
        """Execute an action; whether the task now counts as solved."""
        sim = self.simulation
        self._poses.append(sim.poses())
        self._state.append(sim.state)
        self._action.append(action)
        self.success.append(sim.step(action))
        return self.success[-1]

    def rollout(self) -> Rollout:
        """All of the episode so far, at least one step."""
        sim, poses = self.simulation, Poses.stack(self._poses)
        body = sim.object_body
        T_sim_object = rigid(poses.body_mat[:, body].reshape(-1, 3, 3), poses.body_pos[:, body])
        return Rollout(
            task=sim.task.name,
            seed=self.seed,
            camera=self.camera,
            time_s=np.arange(len(self._action)) * sim.step_seconds,
            state=np.stack(self._state),
            action=np.stack(self._action),
            success=np.array(self.success),
            object_pose=pose_9d(self.T_world_sim @ T_sim_object).astype(np.float32),
            extras={"rand_vec": sim.rand_vec.tolist()},
            poses=poses,
            scene=sim.scene,
            renderer=self.renderer,
            T_world_sim=self.T_world_sim,
        )


class TaskSimulator:
    """One task's simulation with its geometry packed: made once, used for any number of episodes."""

    def __init__(self, task: str, settings: SceneSettings) -> None:
        if settings.rgb and settings.renderer != "gl":
            raise UsageError("color pictures need OpenGL; add --renderer gl (expert.scene.renderer=gl)")
        self.simulation = Simulation(task, settings)
        self._packed = PackedScene(self.simulation.scene)
        self._gl: Renderer | None = None

    def renderer(self, first: Poses) -> Renderer:
        """A renderer for the episode whose first poses are given."""
        sim = self.simulation
        if sim.settings.renderer == "zbuffer":
            return ZBuffer(sim.scene, sim.camera(), first, self._packed)
        if self._gl is None:
            from flowlab.sim.render.gl import GLRenderer  # only here is OpenGL looked for

            self._gl = GLRenderer(sim.scene, sim.camera(), sim.settings)
        return self._gl

    def begin(self, seed: int, moved_m: tuple[float, float] = (0.0, 0.0)) -> EpisodeRecorder:
        """An episode with the layout of ``seed``, the object moved from there. It ends when the next begins."""
        sim = self.simulation
        sim.reset(seed, moved_m)
        return EpisodeRecorder(sim, seed, self.renderer(sim.poses()))

    def record_expert(self, seed: int, settings: ExpertSettings) -> Rollout:
        """Let the expert solve the layout of ``seed``, or try to until ``max_steps``.

        Raises :class:`DataError` where the physics becomes unstable.
        """
        live = self.begin(seed)
        expert = Expert(self.simulation)
        while len(live.success) < settings.max_steps:
            live.step(expert.act())
            if settings.stop == "success" and sum(live.success) >= settings.hold:
                break
        if live.unstable:
            raise DataError("the physics became unstable, and MuJoCo started it anew")
        return live.rollout()
