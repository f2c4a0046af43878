"""Videos of evaluated episodes."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from flowlab.evaluation.checkpoints import CheckpointRef, find_checkpoint
from flowlab.evaluation.replay import replay_episode
from flowlab.evaluation.results import EpisodeResult, PolicyResult
from flowlab.evaluation.trials import Trial
from flowlab.text import file_name
from flowlab.viz.recording import write_rrd
from flowlab.viz.video import write_video

FOLDER = "films"


def write_videos(
    runs: Sequence[Path],
    results: Sequence[PolicyResult],
    count: int,
    out: Path | None = None,
) -> list[Path]:
    """Videos and Rerun recordings of the first successes and failures of every policy and task.

    Args:
        runs: As they were given to :func:`flowlab.evaluate`.
        results: What it returned.
        count: How many successes, and how many failures, of each policy and task.
        out: The report's folder; by default each run keeps its own, beside its episodes.

    Returns:
        The videos.
    """
    newest: dict[Path, CheckpointRef] = {}
    for ref in (find_checkpoint(path) for path in runs):
        newest[ref.run] = max(newest.get(ref.run, ref), ref, key=lambda r: r.step)
    made = []
    for ref, result in zip(newest.values(), results, strict=True):
        checkpoint = replace(ref, n_action_steps=result.evaluations[-1].n_action_steps)
        folder = (checkpoint.episodes.parent if out is None else out) / FOLDER
        made += [write_episode_video(checkpoint, trial, folder) for trial in _first_of_each(result.final, count)]
    return made


def write_episode_video(checkpoint: CheckpointRef, trial: Trial, folder: Path) -> Path:
    """Write a video (mp4) of an episode and a Rerun recording beside it; returns the video's path."""
    shown = replay_episode(checkpoint, trial)
    run, result = checkpoint.run.name, shown.result
    title = f"{run}: {trial.task}, seed {trial.seed}, episode {trial.episode}, {result.ending}"
    ending = "solved" if result.success else "failed"
    path = folder / f"{file_name(f'{run}-{trial.task}-seed-{trial.seed}-{trial.episode}-{ending}')}.mp4"
    write_video(shown.episode, path, title=title, prediction=shown.prediction)
    write_rrd(shown.episode, path.with_suffix(".rrd"), name=title, prediction=shown.prediction)
    return path


def _first_of_each(outcomes: Sequence[EpisodeResult], count: int) -> Iterator[Trial]:
    """Of every task the first successes, then the first failures."""
    for task in dict.fromkeys(o.task for o in outcomes):
        for solved in (True, False):
            yield from [o.trial for o in outcomes if o.task == task and o.success == solved][:count]
