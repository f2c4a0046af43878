"""Simulated recordings: the expert's episodes as a depth camera would have seen them, with their exact truth."""

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Int
from pydantic import Field

from flowlab.config import Settings
from flowlab.errors import DataError, unknown_name
from flowlab.files import temporary_path, write_json
from flowlab.grading.ground_truth import MADE_WITH, GroundTruth
from flowlab.perception.observer import Observer, ObserverSettings
from flowlab.perception.queries import EdgeSettings, QuerySettings, away_from_edges, sample_queries
from flowlab.pipeline.stages.simulation import ExpertStage
from flowlab.recordings.writing import write_rgbd_recording
from flowlab.records import Frame, Role
from flowlab.sim.pixel_tracks import surface_tracks
from flowlab.sim.scene_settings import CameraSettings, SceneSettings
from flowlab.sim.sensor import KINECT, PRESETS, Sensor, SensorSettings
from flowlab.untrusted import read_json

UNUSABLE_M = 0.005
"""A query whose sensor depth in the first frame is farther than this from the true surface is not graded:
what the labeling would follow there is another point than the one whose truth is known."""
_DEPTH_UNIT_M = 0.0001
"""Fine enough to add nothing to the sensor's error, and 16 bits of it reach beyond the sensor's range."""


class QueryMix(Settings):
    """Which points are graded: farthest-point samples of the cloud of the first noisy frame."""

    points: int = Field(default=128, gt=0)
    """Of all kinds together; fewer where something is not in view, or is chosen as two kinds."""
    background_share: float = Field(default=0.45, ge=0, le=1)
    """Of floor, walls and table: as many still points as there are in a scene sampled evenly."""
    object_share: float = Field(default=0.20, ge=0, le=1)
    """Of what can move and is not the robot; the rest are of everything but the background."""
    avoid_edges: EdgeSettings | None = None
    """Choose no points near edges and holes of the first depth picture. null takes these, too: they are the
    hardest to follow, and the thin things that robots use consist of little else."""


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
    if folder.exists():
        if not (folder / MADE_WITH).is_file():
            raise DataError(f"{folder}: is in the way, and no simulated recording; choose another --out")
        if read_json(folder / MADE_WITH).get("made_with") == made_with:
            return False
    folder.parent.mkdir(parents=True, exist_ok=True)
    temporary = temporary_path(folder)
    try:
        unusable = _record(temporary, task, seed, settings)
        write_json(temporary / MADE_WITH, {"made_with": made_with, "unusable_queries": unusable})
        shutil.rmtree(folder, ignore_errors=True)
        os.replace(temporary, folder)
        return True
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _record(folder: Path, task: str, seed: int, settings: SimulatedRecording) -> int:
    """Write the recording, and return how many queries had to be left out."""
    rollout = settings.expert.simulator(task).record_expert(seed, settings.expert)
    sensor = Sensor(settings.sensor, seed)
    frames = [rollout.frame(t) for t in range(len(rollout))]
    depth = np.stack([sensor.depth(f.depth) for f in frames])
    rgb = np.stack([sensor.rgb(f.rgb) for f in frames if f.rgb is not None])
    pixel = choose_pixels(replace(frames[0], depth=depth[0]), task, settings)
    x, y = pixel.T
    usable = np.abs(depth[0][y, x] - frames[0].depth[y, x]) < UNUSABLE_M
    pixel = pixel[usable]
    if len(pixel) == 0:
        raise DataError(f"{task} seed {seed}: no query lies where the sensor reads the true depth; try another seed")
    truth = GroundTruth(pixel.astype(np.float32), *surface_tracks(rollout, frames[0], pixel))
    write_rgbd_recording(
        folder,
        rgb=rgb,
        depth=depth,
        camera=rollout.camera,
        time_s=rollout.time_s,
        state=rollout.state,
        action=rollout.action,
        success=bool(rollout.success[-1]),
        task=task,
        depth_unit_m=_DEPTH_UNIT_M,
        **truth.arrays(),
    )
    return int((~usable).sum())


def choose_pixels(first: Frame, task: str, settings: SimulatedRecording) -> Int[np.ndarray, "N 2"]:
    """Distinct pixels (x, y) of the queries, chosen on the cloud of the first frame as the sensor gives it.

    Which kind a point is comes from the simulator, so that every kind can be graded.
    """
    mix = settings.queries
    cloud = Observer(settings.observer, task).cloud(first)
    if mix.avoid_edges is not None:
        cloud = away_from_edges(cloud, first.depth, mix.avoid_edges)
    assert cloud.owner is not None
    role = np.array([e.role for e in cloud.entities])[cloud.owner]
    background, objects = round(mix.points * mix.background_share), round(mix.points * mix.object_share)
    kinds = (
        (role != Role.BACKGROUND, mix.points - background - objects),
        (role == Role.BACKGROUND, background),
        (role == Role.OBJECT, objects),
    )
    chosen = []
    for kind, count in kinds:
        if count > 0 and kind.any():
            part = replace(cloud, xyz_world=cloud.xyz_world[kind], pixel=cloud.pixel[kind], owner=cloud.owner[kind])
            queries = sample_queries(part, QuerySettings(points=count))
            assert queries.pixel is not None
            chosen.append(queries.pixel[: queries.count])
    if not chosen:
        raise DataError(f"{task}: no point of the first frame lies in the crop; set observer.crop")
    v, u = np.divmod(np.concatenate(chosen).astype(np.int64), first.camera.width)
    pixel = np.stack([u, v], -1)
    _, where = np.unique(pixel, axis=0, return_index=True)
    return pixel[np.sort(where)]
