"""An evaluated episode again, with pictures: as everyone can look at it."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from flowlab.errors import MissingLibraryError
from flowlab.evaluation.evaluate import CheckpointRef
from flowlab.evaluation.rollout import Attempt, SimulatorPool, roll_out
from flowlab.evaluation.trials import EpisodeResult, Trial
from flowlab.perception.queries import QuerySettings, queries_in
from flowlab.pipeline.stages.shared import ObserverStage, labeled
from flowlab.policies.checkpoint import load_policy
from flowlab.records import Episode, FlowPrediction, ObservedDemo, QueriedDemo
from flowlab.sim.recorder import EpisodeRecorder, Rollout, TaskSimulator
from flowlab.sim.simulation import SceneSettings
from flowlab.sim.tracks import RigidFlowSettings, label
from flowlab.viz.recording import write_rrd
from flowlab.viz.video import write_video

_TALLEST_PX = 480
"""MetaWorld's models let OpenGL draw no more rows than this."""


def film(subject: CheckpointRef, trial: Trial, folder: Path) -> Path:
    """Write a film (mp4) of an episode and a Rerun recording beside it; returns the film's path."""
    episode, prediction, outcome = replay(subject, trial)
    name = f"{subject.run.name}-{trial.task}-seed-{trial.seed}-{trial.episode}"
    how = f"solved at step {outcome.steps}" if outcome.success else f"not solved in {outcome.steps} steps"
    title = f"{subject.run.name}: {trial.task}, seed {trial.seed}, episode {trial.episode}, {how}"
    path = folder / f"{name}-{'solved' if outcome.success else 'failed'}.mp4"
    write_video(episode, path, title=title, prediction=prediction)
    write_rrd(episode, path.with_suffix(".rrd"), name=title, prediction=prediction)
    return path


def replay(subject: CheckpointRef, trial: Trial) -> tuple[Episode, FlowPrediction | None, EpisodeResult]:
    """Let a policy try an episode again, which goes as it went before, and label it as demonstrations are.

    The episode has the clouds that the policy's Observer makes, pictures that are large enough to watch, in color
    where OpenGL can be had, and true tracks: of the points whose motion the policy predicts, or would be given.
    """
    scene = SceneSettings.model_validate(subject.trained.scene).model_copy(update={"rgb": False})
    policy = load_policy(subject.weights).policy
    attempt = next(roll_out(policy, SimulatorPool(trial.task, scene), [trial], n_action_steps=subject.n_action_steps))
    observer = ObserverStage.model_validate({**(policy.spec.observer or {}), "stage": "observer"})
    seen = observer.process(attempt.rollout)
    queries = attempt.queries
    if queries is None:
        settings = QuerySettings.model_validate(policy.spec.queries)
        queries = queries_in(seen.first_cloud, seen.depth[0], settings)
    assert seen.owner is not None
    tracks = label(attempt.rollout, queries, seen.depth, seen.owner, RigidFlowSettings())
    shown = _with_large_pictures(seen, scene)
    episode = labeled(QueriedDemo(shown, queries), tracks, evaluated=attempt.outcome.model_dump(mode="json"))
    return episode, _prediction(attempt, tracks.xyz_world), attempt.outcome


def _prediction(attempt: Attempt, tracks_world: np.ndarray) -> FlowPrediction | None:
    if not attempt.predicted:
        return None
    step = np.array([s for s, _ in attempt.predicted])
    flow = np.stack([f for _, f in attempt.predicted])
    here = tracks_world[step][:, None]
    return FlowPrediction(step, np.concatenate([here, here + flow.cumsum(1)], 1).astype(np.float32))


def _with_large_pictures(seen: ObservedDemo, scene: SceneSettings) -> ObservedDemo:
    """The same, but pictures taken anew by a camera with more pixels in the same place."""
    rollout = seen.demo
    assert isinstance(rollout, Rollout)
    c = scene.camera
    factor = max(1, _TALLEST_PX // c.height)
    camera = c.model_copy(update={"width": factor * c.width, "height": factor * c.height})
    live = _begin_in_color(rollout, scene.model_copy(update={"camera": camera}))
    taken = replace(rollout, camera=live.camera, renderer=live.renderer)
    frames = [taken.frame(t) for t in range(len(taken))]
    rgb = None if frames[0].rgb is None else np.stack([f.rgb for f in frames if f.rgb is not None])
    return replace(seen, demo=taken, depth=np.stack([f.depth for f in frames]), owner=None, rgb=rgb)


def _begin_in_color(rollout: Rollout, scene: SceneSettings) -> EpisodeRecorder:
    """The layout of a rollout; without color where there is no OpenGL."""
    try:
        colored = scene.model_copy(update={"renderer": "gl", "rgb": True})
        return TaskSimulator(rollout.task, colored).begin(rollout.seed)
    except MissingLibraryError:
        return TaskSimulator(rollout.task, scene).begin(rollout.seed)
