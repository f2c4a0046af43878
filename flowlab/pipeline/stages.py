"""The stages that come with flowlab. Each is a thin skin over the function that does the work."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field

from flowlab.errors import DataError
from flowlab.perception.observer import Observer, ObserverSettings
from flowlab.perception.queries import QuerySettings, sample_queries
from flowlab.pipeline.memory import return_freed_memory
from flowlab.pipeline.stage import EpisodeRequest, Rejected, Stage, Writer
from flowlab.records import Demonstration, Episode, ObservedDemo, QueriedDemo
from flowlab.sim.environment import SceneSettings
from flowlab.sim.rollout import ExpertSettings, Rollout, Studio
from flowlab.sim.tracks import RigidFlowSettings, label
from flowlab.storage.shard import write_shard


class ExpertStage(Stage, ExpertSettings):
    """MetaWorld's scripted expert tries the task."""

    stage: Literal["expert"] = "expert"
    scene: SceneSettings = SceneSettings()
    """What the camera is shown."""

    def process(self, record: EpisodeRequest) -> Rollout:
        """Let the expert solve the layout of the seed."""
        try:
            return self.studio(record.task).record_expert(record.seed, self)
        except DataError as error:
            raise Rejected(str(error)) from error

    def studio(self, task: str) -> Studio:
        """The simulation of a task; the last one used is kept, since units come task by task."""
        key = task, self.scene
        if key not in _last_studio:
            _last_studio.clear()
            return_freed_memory()
            _last_studio[key] = Studio(*key)
        return _last_studio[key]


_last_studio: dict[tuple[str, SceneSettings], Studio] = {}


class ObserverStage(Stage, ObserverSettings):
    """The Observer looks at every frame."""

    stage: Literal["observer"] = "observer"

    def process(self, record: Demonstration) -> ObservedDemo:
        """Unproject, crop and sample every frame."""
        observer = Observer(self, record.task)
        first = record.frame(0)
        steps, shape = len(record), first.depth.shape
        points = np.empty((steps, self.points, 3), np.float32)
        count = np.empty(steps, np.int32)
        depth = np.empty((steps, *shape), np.float32)
        owner = None if first.owner is None else np.empty((steps, *shape), np.int16)
        rgb = None if first.rgb is None else np.empty((steps, *shape, 3), np.uint8)
        for t in range(steps):
            frame = first if t == 0 else record.frame(t)
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


class QueriesStage(Stage, QuerySettings):
    """Query points are chosen on the first cloud."""

    stage: Literal["queries"] = "queries"

    def process(self, record: ObservedDemo) -> QueriedDemo:
        """Choose the points to follow."""
        try:
            return QueriedDemo(record, sample_queries(record.first_cloud, self))
        except DataError as error:
            raise Rejected(str(error)) from error


class RigidFlowStage(Stage, RigidFlowSettings):
    """Exact tracks: simulated bodies carry their surface points along."""

    stage: Literal["rigid-flow"] = "rigid-flow"
    of = Rollout

    def process(self, record: QueriedDemo) -> Episode:
        """Follow the queries by the poses of what they lie on."""
        seen, queries = record.observed, record.queries
        demo = seen.demo
        assert isinstance(demo, Rollout)
        assert seen.owner is not None
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
            queries=queries,
            tracks=label(demo, queries, seen.depth, seen.owner, self),
            object_pose=demo.object_pose,
            depth=seen.depth,
            rgb=seen.rgb,
            extras=demo.extras,
        )


class AcceptStage(Stage):
    """Keeps failed demonstrations out."""

    stage: Literal["accept"] = "accept"
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

    stage: Literal["write"] = "write"
    depth: bool = False
    """Store the depth pictures too, so that clouds can be cropped anew later."""

    def process(self, record: Episode) -> Episode:
        """The episode without what is not stored."""
        return record if self.depth else replace(record, depth=None)

    def store(self, path: Path, episodes: Sequence[Episode], settings_digest: str) -> None:
        """Write the shard in one step."""
        write_shard(path, episodes, settings_digest)


STAGES: tuple[type[Stage], ...] = (
    ExpertStage,
    ObserverStage,
    QueriesStage,
    RigidFlowStage,
    AcceptStage,
    WriteStage,
)
