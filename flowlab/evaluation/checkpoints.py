"""Checkpoints to be evaluated, and what is kept of their evaluations in the run's folder."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pydantic import ValidationError

from flowlab.config import explain
from flowlab.errors import DataError, UsageError, unknown_name
from flowlab.evaluation.episode_log import EPISODES, read_results
from flowlab.evaluation.results import CheckpointEvaluation
from flowlab.evaluation.trials import Trial
from flowlab.policies.trained import (
    POLICY,
    TrainedPolicy,
    all_checkpoints,
    newest_checkpoint,
    read_trained,
    step_of,
    warn_of_lost_checkpoints,
)
from flowlab.sim.scene_settings import SceneSettings

FOLDER = "evaluation"
"""Of a run: holds a folder for every checkpoint and number of executed steps."""
CHOOSING = "execution"
"""Likewise, of episodes that decided how many steps of a plan to execute, and count for nothing else."""
_FOLDER_NAME = re.compile(r"step-(\d{1,18})-execute-(\d{1,9})")


@dataclass(frozen=True, slots=True)
class CheckpointRef:
    """A checkpoint to be evaluated."""

    run: Path
    weights: Path
    step: int
    n_action_steps: int
    """Steps of every plan that are executed."""
    trained: TrainedPolicy
    folder: str = FOLDER
    """Of the run, where its episodes are kept."""

    @property
    def episodes(self) -> Path:
        """The file that keeps how its episodes went."""
        return self.run / self.folder / f"step-{self.step:08d}-execute-{self.n_action_steps}" / EPISODES

    @property
    def scene(self) -> SceneSettings:
        """The simulated scene that its policy knows, with color where the policy needs it."""
        color = self.trained.policy.settings.needs.rgb
        try:
            return SceneSettings.model_validate(self.trained.scene).model_copy(update={"rgb": color})
        except ValidationError as error:
            raise DataError(f"{self.run / POLICY}: scene: {explain(error, SceneSettings)}") from error

    def read_evaluation(self, trials: Sequence[Trial]) -> CheckpointEvaluation:
        """Those of the trials that have been tried."""
        known = read_results(self.episodes)
        outcomes = tuple(known[t] for t in trials if t in known)
        return CheckpointEvaluation(step=self.step, n_action_steps=self.n_action_steps, outcomes=outcomes)


def find_checkpoint(path: Path, n_action_steps: int | None = None) -> CheckpointRef:
    """The newest checkpoint of a run, or the one that is given.

    Args:
        path: The folder of a run, or one of its checkpoints.
        n_action_steps: Steps of every plan to execute; None executes as many as the policy was trained to.

    Raises:
        DataError: There is no checkpoint, or the policy was not trained in simulation.
        UsageError: Its plans are shorter than ``n_action_steps`` steps.
    """
    if path.suffix == ".safetensors":
        weights, run = path, path.absolute().parents[1]
    else:
        weights, run = newest_checkpoint(path), path
        warn_of_lost_checkpoints(run)
    trained = read_trained(run)
    s = trained.policy.settings
    if trained.scene is None or (trained.policy.observer is None and _needs_cloud(trained)):
        raise DataError(
            f"{path}: was trained on recordings or on a DP3 store ({trained.dataset}), so no simulation shows what it "
            f"knows; compare it with held-out demonstrations by 'flowlab eval {path} --offline'"
        )
    if s.needs.rgb and not trained.scene.get("rgb"):
        raise DataError(
            f"{path}: needs color, and the scene that it was trained in has none; train it on a dataset that was made "
            "with --renderer gl --set expert.scene.rgb=true"
        )
    most = s.horizon - s.n_obs_steps + 1
    if n_action_steps is not None and not 1 <= n_action_steps <= most:
        raise UsageError(f"--execute {n_action_steps}: {path} plans {most} steps ahead, so execute 1 to {most}")
    step = step_of(weights)
    if weights.name != f"step-{step:08d}.safetensors":
        raise DataError(f"{weights}: holds the weights after {step} steps; call it step-{step:08d}.safetensors")
    return CheckpointRef(run, weights, step, n_action_steps or s.n_action_steps, trained)


def find_checkpoints(run: Path, n_action_steps: int | None = None) -> list[CheckpointRef]:
    """Every checkpoint of a run, oldest first. Raises what :func:`find_checkpoint` does."""
    warn_of_lost_checkpoints(run)
    return [find_checkpoint(path, n_action_steps) for path in all_checkpoints(run)]


def common_tasks(checkpoints: Sequence[CheckpointRef], asked: Sequence[str] = ()) -> tuple[str, ...]:
    """The tasks that are asked for, or else all that every policy knows.

    Raises:
        UsageError: A policy does not know a task that is asked for, or there is none that all know.
    """
    known = [set(c.trained.policy.tasks) for c in checkpoints]
    for checkpoint, tasks in zip(checkpoints, known, strict=True):
        for task in asked:
            if task not in tasks:
                raise UsageError(f"{checkpoint.run}: {unknown_name('task that it was trained on', task, tasks)}")
    common = set.intersection(*known)
    if not common:
        each = "; ".join(f"{c.run} {', '.join(sorted(k))}" for c, k in zip(checkpoints, known, strict=True))
        raise UsageError(f"no task is common to all runs ({each}); evaluate them apart, or make one report of them")
    return tuple(dict.fromkeys(asked)) or tuple(sorted(common))


def _needs_cloud(trained: TrainedPolicy) -> bool:
    """Whether the policy is shown point clouds, or points that are chosen of them."""
    needs = trained.policy.settings.needs
    return needs.point_cloud is not None or needs.flow is not None


def read_evaluations(run: Path) -> list[CheckpointEvaluation]:
    """All that is kept of a run's evaluations, in order of steps."""
    found = []
    for folder in sorted((run / FOLDER).glob("step-*-execute-*")):
        if (name := _FOLDER_NAME.fullmatch(folder.name)) is None:  # not ours
            continue
        step, n_action_steps = map(int, name.groups())
        outcomes = sorted(read_results(folder / EPISODES).values(), key=lambda o: o.trial)
        if outcomes:
            found.append(CheckpointEvaluation(step=step, n_action_steps=n_action_steps, outcomes=tuple(outcomes)))
    return found
