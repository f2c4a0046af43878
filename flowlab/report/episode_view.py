"""One episode to look at: of a dataset, of what was kept out of it, or one that a policy tries now."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from flowlab.errors import DataError, UsageError
from flowlab.records import Episode, FlowPrediction
from flowlab.storage.dataset import Dataset, RejectRef
from flowlab.storage.episodes import EpisodeRef
from flowlab.text import markdown


@dataclass(frozen=True, slots=True)
class EpisodeView:
    """An episode, and what is said of it."""

    episode: Episode
    name: str
    about: str
    """Markdown for a recording's info panel."""
    note: str = ""
    """Why it was kept out of its dataset, if it was."""
    prediction: FlowPrediction | None = None
    """What a policy predicted in it, if one did."""

    def write_png(self, path: Path) -> None:
        """Draw a still: of the predicted flow where there is one, else of the tracks."""
        if self.prediction is None:
            from flowlab.viz.still import draw_still

            draw_still(self.episode, path, title=self.name, note=self.note)
        else:
            from flowlab.viz.flow_prediction import draw_flow_prediction

            draw_flow_prediction(self.episode, self.prediction, path, title=self.name)

    def write_mp4(self, path: Path, *, fps: float | None = None) -> None:
        """Write a video of the pictures with tracks drawn in; ``fps`` is real time by default."""
        from flowlab.viz.video import write_video

        write_video(self.episode, path, fps=fps, title=self.name, note=self.note, prediction=self.prediction)

    def write_rrd(self, path: Path) -> None:
        """Write a Rerun recording."""
        from flowlab.viz.recording import write_rrd

        name = f"{self.name} (rejected)" if self.note else self.name
        write_rrd(self.episode, path, name=name, about=self.about, prediction=self.prediction)


def view_episode(
    source: Path, episode: int = 0, *, task: str | None = None, seed: int | None = None, rejects: bool = False
) -> EpisodeView:
    """The episode that is meant.

    Args:
        source: A dataset, or a run (or one of its checkpoints), whose policy then tries the episode.
        episode: Position in the dataset, by task and then seed; of a run, the episode of the evaluation seed.
        task: Count within this task; of a run, the task to try, needed where it knows several.
        seed: Evaluation seed of a run.
        rejects: Count among what was kept out of the dataset.

    Raises:
        UsageError: An argument does not fit the source.
        DataError: There is no such episode.
    """
    if is_run(source):
        if rejects:
            raise UsageError("--rejects is about datasets, and this is a training run")
        return _view_attempt(source, task, seed or 0, episode)
    if seed is not None:
        raise UsageError(f"--seed is about training runs; {source} is none, so give --episode (and --task)")
    return _view_stored(Dataset(source), episode, task, rejects)


def is_run(source: Path) -> bool:
    """Whether a path is that of a training run, or of a checkpoint."""
    return source.suffix == ".safetensors" or (source / "policy.json").exists()


def _view_stored(data: Dataset, episode: int, task: str | None, rejects: bool) -> EpisodeView:
    """An episode of a dataset, or of what was kept out of it."""
    about = markdown(f"dataset {data.path}, fingerprint {data.fingerprint}, recipe {data.manifest.recipe}")
    if not rejects:
        shown = data.episode(_position(data, data.refs, "episode", episode, task))
        return EpisodeView(shown, f"{shown.task} seed {shown.seed}", about)
    position = _position(data, data.rejects, "reject", episode, task)
    ref, shown = data.rejects[position], data.rejected(position)
    note = f"rejected at {ref.stage}: {ref.reason}"
    return EpisodeView(shown, f"{shown.task} seed {shown.seed}", f"**{markdown(note)}**\n\n{about}", note)


def _view_attempt(run: Path, task: str | None, seed: int, episode: int) -> EpisodeView:
    """An episode that the policy of a run tries now."""
    from flowlab.evaluation.checkpoints import common_tasks, find_checkpoint
    from flowlab.evaluation.replay import replay_episode
    from flowlab.evaluation.trials import check_unseen, list_trials

    checkpoint = find_checkpoint(run)
    tasks = common_tasks([checkpoint], [task] if task else [])
    if len(tasks) > 1:
        raise UsageError(f"{run}: knows several tasks; add --task, one of {', '.join(tasks)}")
    trial = list_trials(tasks, [seed], episode + 1)[-1]
    check_unseen([trial], checkpoint.trained.scene_seeds, run)
    shown = replay_episode(checkpoint, trial)
    name = f"{checkpoint.run.name}: {trial.task}, seed {seed}, episode {episode}, {shown.result.ending}"
    about = markdown(f"{checkpoint.weights}, scene seed {trial.scene_seed}")
    return EpisodeView(shown.episode, name, about, prediction=shown.prediction)


def _position(data: Dataset, refs: Sequence[EpisodeRef | RejectRef], kind: str, episode: int, task: str | None) -> int:
    """Where the ``episode``-th of a task (or of all) stands in the list."""
    positions = [k for k, ref in enumerate(refs) if task in (None, ref.task)]
    if not 0 <= episode < len(positions):
        where = f"{data.path}" if task is None else f"{data.path}, task '{task}'"
        raise DataError(f"{where}: no {kind} {episode}; there are {len(positions)}, counted from 0")
    return positions[episode]
