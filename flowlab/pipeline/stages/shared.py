"""Stages that work on any demonstration, simulated or recorded. Each is a thin skin over the function that does the
work."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field

from flowlab.config import Settings
from flowlab.errors import DataError
from flowlab.perception.observer import Observer, ObserverSettings
from flowlab.perception.queries import QuerySettings, queries_in
from flowlab.pipeline.stage import Rejected, Stage, Writer
from flowlab.provenance import Provenance
from flowlab.records import Demonstration, Episode, Frame, ObservedDemo, QueriedDemo, Tracks3D
from flowlab.storage.shard import write_shard


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
    )


class ObserverStage(Stage, ObserverSettings):
    """The Observer looks at every frame."""

    stage: str = "observer"

    def process(self, record: Demonstration) -> ObservedDemo:
        """Unproject, crop and sample every frame."""
        observer = Observer(self, record.task)
        first = _frame(record, 0)
        steps, shape = len(record), first.depth.shape
        points = np.empty((steps, self.points, 3), np.float32)
        count = np.empty(steps, np.int32)
        depth = np.empty((steps, *shape), np.float32)
        owner = None if first.owner is None else np.empty((steps, *shape), np.int16)
        rgb = None if first.rgb is None else np.empty((steps, *shape, 3), np.uint8)
        for t in range(steps):
            frame = first if t == 0 else _frame(record, t)
            try:
                seen = observer.observe(frame)
            except DataError as error:
                raise Rejected(f"step {t}: {error}") from error
            points[t], count[t], depth[t] = seen.points_world, seen.count, frame.depth
            if owner is not None:
                owner[t] = frame.owner
            if rgb is not None:
                rgb[t] = frame.rgb
        return ObservedDemo(record, points, count, observer.cloud(first), depth, owner, rgb)

    def describe(self, provenance: Provenance, task: str) -> Provenance:
        """How the clouds were made, so that a policy's are made the same way."""
        return provenance.model_copy(update={"observer": _settings(self, ObserverSettings)})


def _frame(demo: Demonstration, t: int) -> Frame:
    try:
        return demo.frame(t)
    except DataError as error:
        raise Rejected(f"step {t}: {error}") from error


class QueriesStage(Stage, QuerySettings):
    """Query points are chosen on the first cloud."""

    stage: str = "queries"

    def process(self, record: ObservedDemo) -> QueriedDemo:
        """Choose the points to follow."""
        try:
            return QueriedDemo(record, queries_in(record.first_cloud, record.depth[0], self))
        except DataError as error:
            raise Rejected(str(error)) from error

    def describe(self, provenance: Provenance, task: str) -> Provenance:
        """How the query points were chosen."""
        return provenance.model_copy(update={"queries": _settings(self, QuerySettings)})


def _settings(stage: Stage, group: type[Settings]) -> dict[str, Any]:
    """Those settings of a stage that are of a group, as JSON values: neither its name nor what a subclass adds."""
    return stage.model_dump(mode="json", include=set(group.model_fields))


class AcceptStage(Stage):
    """Keeps failed demonstrations out."""

    stage: str = "accept"
    success_steps: int = Field(default=5, ge=0)
    """Steps the task must have been solved for; 5 is DP3's rule."""

    def process(self, record: Episode) -> Episode:
        """Let a successful episode pass."""
        solved = int(record.success.sum())
        if solved < self.success_steps:
            raise Rejected(f"solved for {solved} steps of {len(record)}, at least {self.success_steps} asked for")
        return record


class WriteStage(Writer):
    """Writes the episodes of a unit into its shard."""

    stage: str = "write"
    depth: bool = False
    """Store the depth pictures too, so that clouds can be cropped anew later."""
    rgb: bool = True
    """Store the color pictures, where there are any."""

    def process(self, record: Episode) -> Episode:
        """The episode without what is not stored."""
        return replace(record, depth=record.depth if self.depth else None, rgb=record.rgb if self.rgb else None)

    def store(self, path: Path, episodes: Sequence[Episode], settings_digest: str) -> None:
        """Write the shard in one step."""
        write_shard(path, episodes, settings_digest)
