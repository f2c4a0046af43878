"""The stages of simulation, with those it shares. Each is a thin skin over the function that does the work."""

from flowlab.demonstrations import QueriedDemo
from flowlab.errors import DataError
from flowlab.pipeline.memory import return_freed_memory
from flowlab.pipeline.stage import EpisodeRequest, Rejected, Stage
from flowlab.pipeline.stages.accept import AcceptStage
from flowlab.pipeline.stages.labeled import labeled
from flowlab.pipeline.stages.observe import ObserverStage, QueriesStage
from flowlab.pipeline.stages.write import WriteStage
from flowlab.provenance import Provenance
from flowlab.records import Episode
from flowlab.sim.exact_tracks import RigidFlowSettings, label
from flowlab.sim.recorder import ExpertSettings, Rollout, TaskSimulator
from flowlab.sim.scene_settings import SceneSettings, describe_scene

__all__ = ["AcceptStage", "ExpertStage", "ObserverStage", "QueriesStage", "RigidFlowStage", "WriteStage"]


class ExpertStage(Stage, ExpertSettings):
    """MetaWorld's scripted expert tries the task."""

    stage: str = "expert"
    scene: SceneSettings = SceneSettings()
    """What the camera is shown."""

    def process(self, record: EpisodeRequest) -> Rollout:
        """Let the expert solve the layout of the seed."""
        try:
            return self.simulator(record.task).record_expert(record.seed, self)
        except DataError as error:
            raise Rejected(str(error)) from error

    def describe(self, provenance: Provenance, task: str) -> Provenance:
        """Simulated by MetaWorld, whose camera and channels are known."""
        camera = TaskSimulator(task, self.scene).begin(seed=0).camera
        known = describe_scene(self.scene)
        return provenance.model_copy(update={**known, "camera": camera.to_json()})

    def simulator(self, task: str) -> TaskSimulator:
        """The simulation of a task; the last one used is kept, since units come task by task."""
        key = task, self.scene
        if key not in _last_simulator:
            _last_simulator.clear()
            return_freed_memory()
            _last_simulator[key] = TaskSimulator(*key)
        return _last_simulator[key]


_last_simulator: dict[tuple[str, SceneSettings], TaskSimulator] = {}


class RigidFlowStage(Stage, RigidFlowSettings):
    """Exact tracks: simulated bodies carry their surface points along."""

    stage: str = "rigid-flow"
    of = Rollout

    def process(self, record: QueriedDemo) -> Episode:
        """Follow the queries by the poses of what they lie on."""
        seen, demo = record.observed, record.observed.demo
        assert isinstance(demo, Rollout)
        assert seen.owner is not None
        return labeled(record, label(demo, record.queries, seen.depth, seen.owner, self))

    def describe(self, provenance: Provenance, task: str) -> Provenance:
        """The tracks are exact."""
        return provenance.model_copy(update={"tracks": "exact"})
