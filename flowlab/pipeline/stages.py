"""The stages that come with flowlab. Each is a thin skin over the function that does the work."""

from functools import lru_cache
from typing import Literal

import numpy as np
from pydantic import Field

from flowlab.errors import DataError
from flowlab.perception.observer import Observer, ObserverSettings
from flowlab.perception.queries import QuerySettings, sample_queries
from flowlab.pipeline.stage import EpisodeRequest, Rejected, Stage, UnitEpisodes, WrittenShard
from flowlab.records import Demonstration, Episode, ObservedDemo, QueriedDemo
from flowlab.sim.environment import SceneSettings
from flowlab.sim.rollout import ExpertSettings, Rollout, Studio
from flowlab.sim.tracks import RigidFlowSettings, label
from flowlab.storage.shard import episode_digest, write_shard


class ExpertStage(Stage, ExpertSettings):
    """MetaWorld's scripted expert tries the task."""

    stage: Literal["expert"] = "expert"
    scene: SceneSettings = SceneSettings()

    def process(self, record: EpisodeRequest) -> Rollout:
        """Let the expert solve the layout of the seed."""
        return self.studio(record.task).record_expert(record.seed, self)

    def studio(self, task: str) -> Studio:
        """The simulation of a task, kept between episodes."""
        return _studio(task, self.scene)


@lru_cache(maxsize=1)  # each further one costs some 25 MB, and units come task by task
def _studio(task: str, scene: SceneSettings) -> Studio:
    return Studio(task, scene)


class ObserverStage(Stage, ObserverSettings):
    """The Observer looks at every frame."""

    stage: Literal["observer"] = "observer"

    def process(self, record: Demonstration) -> ObservedDemo:
        """Unproject, crop and sample every frame."""
        observer = Observer(self, record.task)
        frames = [record.frame(t) for t in range(len(record))]
        first_cloud = observer.cloud(frames[0])
        try:
            seen = [observer.observe(f) for f in frames]
        except DataError as error:
            raise Rejected(str(error)) from error
        owners = [f.owner for f in frames if f.owner is not None]
        colours = [f.rgb for f in frames if f.rgb is not None]
        return ObservedDemo(
            record,
            np.stack([o.points_world for o in seen]),
            np.array([o.count for o in seen], np.int32),
            first_cloud,
            np.stack([f.depth for f in frames]),
            np.stack(owners) if owners else None,
            np.stack(colours) if colours else None,
        )


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


class WriteStage(Stage):
    """Writes the episodes of a unit into its shard."""

    stage: Literal["write"] = "write"
    depth: bool = False
    """Store the depth pictures too, so that clouds can be cropped anew later."""

    def process(self, record: UnitEpisodes) -> WrittenShard:
        """Write the shard in one step."""
        write_shard(record.path, record.episodes, record.settings_digest, depth=self.depth)
        return WrittenShard(tuple(episode_digest(e, depth=self.depth) for e in record.episodes))


STAGES: tuple[type[Stage], ...] = (
    ExpertStage,
    ObserverStage,
    QueriesStage,
    RigidFlowStage,
    AcceptStage,
    WriteStage,
)
