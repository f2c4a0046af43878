"""Simulated recordings: the expert's episodes as a depth camera would have seen them, with their exact truth."""

import json
from pathlib import Path

from flowlab.config import Settings
from flowlab.errors import unknown_name
from flowlab.grading.graded_recording import QueryMix, made_once, write_graded
from flowlab.perception.observer import ObserverSettings
from flowlab.pipeline.stages.simulation import ExpertStage
from flowlab.sim.scene_settings import CameraSettings, SceneSettings
from flowlab.sim.sensor import KINECT, PRESETS, SensorSettings


class SimulatedRecording(Settings):
    """How a simulated recording is made."""

    expert: ExpertStage = ExpertStage(
        scene=SceneSettings(camera=CameraSettings(width=320, height=240), renderer="gl", rgb=True, markers=False)
    )
    """Who acts, and what the camera is shown: color, so OpenGL is needed, and no goal markers."""
    sensor: SensorSettings = KINECT
    """What the camera makes of it."""
    observer: ObserverSettings = ObserverSettings(drop_background=False)
    """The crop that queries are chosen from."""
    queries: QueryMix = QueryMix()
    """Which points have their truth recorded."""

    @classmethod
    def with_camera(cls, sensor: str, size: tuple[int, int]) -> "SimulatedRecording":
        """The defaults with another camera.

        Args:
            sensor: Name of a preset of its errors, ``kinect`` or ``clean``.
            size: Width and height of its pictures [px].

        Raises:
            UsageError: There is no such preset.
        """
        if sensor not in PRESETS:
            raise unknown_name("sensor", sensor, PRESETS)
        default = cls(sensor=PRESETS[sensor])
        scene = default.expert.scene
        camera = scene.camera.model_copy(update={"width": size[0], "height": size[1]})
        expert = default.expert.model_copy(update={"scene": scene.model_copy(update={"camera": camera})})
        return default.model_copy(update={"expert": expert})


def simulate_recording(folder: Path, task: str, seed: int, settings: SimulatedRecording) -> bool:
    """Record the expert's attempt at a task into a plain folder with ``ground_truth.npz``.

    Args:
        folder: Where to. One that was made like this with the same settings is left alone, one made with others is
            replaced.
        task: A task of MetaWorld.
        seed: Of the scene, and of the sensor's errors.
        settings: How it is recorded.

    Returns:
        Whether it was recorded now.

    Raises:
        DataError: Something else is in the way, or there is no point to grade.
    """
    made_with = {"task": task, "seed": seed, "settings": json.loads(settings.model_dump_json())}

    def record(into: Path) -> int:
        rollout = settings.expert.simulator(task).record_expert(seed, settings.expert)
        return write_graded(into, rollout, settings.sensor, settings.observer, settings.queries)

    return made_once(folder, made_with, record)
