"""The episode of a demonstration whose tracks are made."""

from dataclasses import replace
from typing import Any

from flowlab.demonstrations import QueriedDemo
from flowlab.records import Episode, Tracks3D


def labeled(record: QueriedDemo, tracks: Tracks3D, **extras: Any) -> Episode:
    """The episode of a demonstration whose tracks are made: simulated and real ones differ in nothing else."""
    seen, demo = record.observed, record.observed.demo
    return Episode(
        task=demo.task,
        seed=demo.seed,
        camera=demo.camera,
        time_s=demo.time_s,
        point_cloud=seen.points_world,
        point_count=seen.point_count,
        state=demo.state,
        action=demo.action,
        success=demo.success,
        queries=replace(record.queries, pixel=None),
        tracks=tracks,
        object_pose=demo.object_pose,
        depth=seen.depth,
        rgb=seen.rgb,
        extras={**demo.extras, **extras},
        T_world_cam=demo.T_world_cam,
    )
