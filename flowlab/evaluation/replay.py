"""An evaluated episode again, with pictures large enough to watch, labeled as demonstrations are."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32

from flowlab.demonstrations import ObservedDemo, QueriedDemo
from flowlab.errors import MissingLibraryError
from flowlab.evaluation.checkpoints import CheckpointRef
from flowlab.evaluation.results import EpisodeResult
from flowlab.evaluation.rollout import PolicyRollout, SimulatorPool, roll_out
from flowlab.evaluation.trials import Trial
from flowlab.perception.queries import QuerySettings, queries_in
from flowlab.pipeline.stages.labeled import labeled
from flowlab.pipeline.stages.observe import ObserverStage
from flowlab.policies.base import PolicyNetwork
from flowlab.policies.checkpoint import load_policy
from flowlab.records import Episode, FlowPrediction, Queries
from flowlab.sim.exact_tracks import RigidFlowSettings, label
from flowlab.sim.recorder import EpisodeRecorder, Rollout, TaskSimulator
from flowlab.sim.render.gl import GLRenderer
from flowlab.sim.scene_settings import SceneSettings

_TALLEST_PX = 480
"""MetaWorld's models let OpenGL draw no more rows than this."""
_SHADOW_PX = 1024
"""Of the map that shadows are drawn from: MuJoCo's own 4096 take most of a picture's time without a GPU."""


@dataclass(frozen=True, slots=True)
class ReplayedEpisode:
    """An episode as everyone can look at it."""

    episode: Episode
    """The clouds that the policy's Observer makes, pictures in color where OpenGL can be had, and true tracks: of the
    points whose motion the policy predicts, or would be given."""
    prediction: FlowPrediction | None
    """None for policies that predict no flow."""
    result: EpisodeResult


def replay_episode(checkpoint: CheckpointRef, trial: Trial) -> ReplayedEpisode:
    """Let a policy try an episode again, which goes as it went before."""
    policy = load_policy(checkpoint.weights).policy
    simulators = SimulatorPool(trial.task, checkpoint.scene)
    tried = next(roll_out(policy, simulators, [trial], n_action_steps=checkpoint.n_action_steps))
    observer = ObserverStage.model_validate({**(policy.spec.observer or {}), "stage": "observer"})
    observed = observer.process(tried.rollout)
    queries = tried.queries if tried.queries is not None else _would_be_queries(policy, observed)
    assert observed.owner is not None
    tracks = label(tried.rollout, queries, observed.depth, observed.owner, RigidFlowSettings())
    demo = QueriedDemo(_with_large_pictures(observed, checkpoint.scene), queries)
    episode = labeled(demo, tracks, evaluated=tried.result.model_dump(mode="json"))
    return ReplayedEpisode(episode, _prediction(tried, tracks.xyz_world), tried.result)


def _would_be_queries(policy: PolicyNetwork, observed: ObservedDemo) -> Queries:
    """The points that a dataset of such scenes has."""
    return queries_in(observed.first_cloud, observed.depth[0], QuerySettings.model_validate(policy.spec.queries))


def _prediction(tried: PolicyRollout, tracks_world: Float32[np.ndarray, "T M 3"]) -> FlowPrediction | None:
    """The paths that every plan predicted, from where its points were."""
    if not tried.predicted:
        return None
    step = np.array([s for s, _ in tried.predicted])
    flow = np.stack([f for _, f in tried.predicted])
    here = tracks_world[step][:, None]
    return FlowPrediction(step, np.concatenate([here, here + flow.cumsum(1)], 1).astype(np.float32))


def _with_large_pictures(observed: ObservedDemo, scene: SceneSettings) -> ObservedDemo:
    """The same, but pictures taken anew by a camera with more pixels in the same place."""
    rollout = observed.demo
    assert isinstance(rollout, Rollout)
    c = scene.camera
    factor = max(1, _TALLEST_PX // c.height)
    camera = c.model_copy(update={"width": factor * c.width, "height": factor * c.height})
    recorder = _begin_in_color(rollout, scene.model_copy(update={"camera": camera}))
    taken = replace(rollout, camera=recorder.camera, renderer=recorder.renderer)
    if isinstance(recorder.renderer, GLRenderer):  # which takes as long for depth as for color
        depth = observed.depth.repeat(factor, 1).repeat(factor, 2)
        rgb = np.stack([recorder.renderer.color(taken.poses.at(t)) for t in range(len(taken))])
    else:
        depth, rgb = np.stack([taken.frame(t).depth for t in range(len(taken))]), None
    return replace(observed, demo=taken, depth=depth, owner=None, rgb=rgb)


def _begin_in_color(rollout: Rollout, scene: SceneSettings) -> EpisodeRecorder:
    """The scene of a rollout; without color where there is no OpenGL."""
    try:
        colored = scene.model_copy(update={"renderer": "gl", "rgb": True})
        simulator = TaskSimulator(rollout.task, colored)
        quality = simulator.simulation.scene.model.vis.quality
        quality.shadowsize, quality.offsamples = _SHADOW_PX, 0
        return simulator.begin(rollout.seed)
    except MissingLibraryError:
        return TaskSimulator(rollout.task, scene).begin(rollout.seed)
