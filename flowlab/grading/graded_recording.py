"""A recording with known truth, made from a simulated demonstration: seen by a sensor, its queries chosen, written."""

import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int
from pydantic import Field

from flowlab.config import Settings
from flowlab.errors import DataError
from flowlab.files import temporary_path, write_json
from flowlab.grading.ground_truth import MADE_WITH, GroundTruth
from flowlab.perception.observer import Observer, ObserverSettings
from flowlab.perception.queries import EdgeSettings, QuerySettings, away_from_edges, sample_queries
from flowlab.recordings.writing import write_rgbd_recording
from flowlab.records import Frame, Role
from flowlab.sim.pixel_tracks import surface_tracks
from flowlab.sim.recorder import Rollout
from flowlab.sim.sensor import Sensor, SensorSettings
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


def made_once(folder: Path, made_with: dict[str, Any], make: Callable[[Path], int]) -> bool:
    """Make a recording, unless it is there already.

    Args:
        folder: Where to. One that was made like this with the same settings is left alone, one made with others is
            replaced.
        made_with: All that it depends on, as JSON values.
        make: Writes it into a new folder, and says how many queries had to be left out.

    Returns:
        Whether it was made now.

    Raises:
        DataError: Something else is in the way.
    """
    if folder.exists():
        if not (folder / MADE_WITH).is_file():
            raise DataError(f"{folder}: is in the way, and no simulated recording; choose another --out")
        if read_json(folder / MADE_WITH).get("made_with") == made_with:
            return False
    folder.parent.mkdir(parents=True, exist_ok=True)
    temporary = temporary_path(folder)
    try:
        unusable = make(temporary)
        write_json(temporary / MADE_WITH, {"made_with": made_with, "unusable_queries": unusable})
        shutil.rmtree(folder, ignore_errors=True)
        os.replace(temporary, folder)
        return True
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def write_graded(
    folder: Path,
    rollout: Rollout,
    sensor: SensorSettings,
    observer: ObserverSettings,
    mix: QueryMix,
    *,
    poses_known: bool = True,
) -> int:
    """Write a demonstration as a depth camera would have recorded it, with the truth beside it.

    Args:
        folder: Where to; it must not exist.
        rollout: What happens. Its seed is that of the sensor's errors, too.
        sensor: What the camera makes of it.
        observer: The crop that queries are chosen from.
        mix: Which points have their truth recorded.
        poses_known: Whether the recording has the poses of a camera that moves.

    Returns:
        How many queries had to be left out.

    Raises:
        DataError: There is no point to grade.
    """
    camera = Sensor(sensor, rollout.seed)
    frames = [rollout.frame(t) for t in range(len(rollout))]
    depth = np.stack([camera.depth(f.depth, f.rgb) for f in frames])
    rgb = np.stack([camera.rgb(f.rgb) for f in frames if f.rgb is not None])
    pixel = choose_pixels(replace(frames[0], depth=depth[0]), rollout.task, observer, mix)
    x, y = pixel.T
    usable = np.abs(depth[0][y, x] - frames[0].depth[y, x]) < UNUSABLE_M
    pixel = pixel[usable]
    if len(pixel) == 0:
        raise DataError(
            f"{rollout.task} seed {rollout.seed}: no query lies where the sensor reads the true depth; try another seed"
        )
    tracks_cam, visible, role = surface_tracks(rollout, frames[0], pixel)
    moves = rollout.T_world_cam is not None
    samples = {"state": rollout.state, "action": rollout.action} if rollout.state.shape[1] else {}
    write_rgbd_recording(
        folder,
        rgb=rgb,
        depth=depth,
        camera=rollout.camera if not moves or poses_known else rollout.camera.at(np.eye(4)),
        time_s=rollout.time_s,
        success=bool(rollout.success[-1]),
        task=rollout.task,
        rendered=True,
        depth_unit_m=_DEPTH_UNIT_M,
        T_world_cam=rollout.T_world_cam if poses_known else None,
        **samples,
    )
    GroundTruth(pixel.astype(np.float32), tracks_cam, visible, role, rollout.T_world_cam).save(folder)
    return int((~usable).sum())


def choose_pixels(first: Frame, task: str, observer: ObserverSettings, mix: QueryMix) -> Int[np.ndarray, "N 2"]:
    """Distinct pixels (x, y) of the queries, chosen on the cloud of the first frame as the sensor gives it.

    Which kind a point is comes from the simulator, so that every kind can be graded.
    """
    cloud = Observer(observer, task).cloud(first)
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
