"""``flowlab viz``."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from flowlab.records import Episode, FlowPrediction
    from flowlab.storage.dataset import Dataset, RejectRef
    from flowlab.storage.episodes import EpisodeRef


@click.command()
@click.argument("source", type=click.Path(path_type=Path))
@click.option(
    "--episode",
    default=0,
    show_default=True,
    help="Position in the order of `flowlab info`: by task, then seed; of a RUN, the episode of the seed.",
)
@click.option("--task", help="Count episodes within this task; of a RUN, the task to try.")
@click.option("--seed", type=click.IntRange(min=0), help="Of a RUN: evaluation seed  [0].")
@click.option("--rejects", is_flag=True, help="Count among what was kept out of the dataset, and say why it was.")
@click.option("--save", type=click.Path(path_type=Path), help="Write a Rerun recording (.rrd) here.")
@click.option("--png", type=click.Path(path_type=Path), help="Draw a still here.")
@click.option("--mp4", type=click.Path(path_type=Path), help="Write a film of the pictures here, tracks drawn in.")
@click.option("--fps", type=click.FloatRange(min=0.1, max=240), help="Frames a second of the film [real time].")
def viz(
    source: Path,
    episode: int,
    task: str | None,
    seed: int | None,
    rejects: bool,
    save: Path | None,
    png: Path | None,
    mp4: Path | None,
    fps: float | None,
) -> None:
    """Draw an episode: cloud, query points, their tracks over time, and how a policy foresaw them.

    \b
      flowlab viz data/pour --episode 3 --mp4 pour.mp4
      flowlab viz data/pour --rejects --png why.png
      flowlab viz runs/push-fdp --task push --seed 3

    SOURCE is a dataset, or a RUN of `flowlab train` (or one of its checkpoints), which tries the episode that
    `flowlab eval` gives this number. Tracks that were estimated are colored by their stated error, exact ones by what
    they lie on. With none of --save, --png and --mp4, a recording is written beside you.
    """
    from flowlab.errors import UsageError

    if fps is not None and mp4 is None:
        raise UsageError("--fps is about the film; give --mp4 FILE too")
    is_run = source.suffix == ".safetensors" or (source / "policy.json").exists()
    if is_run and rejects:
        raise UsageError("--rejects is about datasets, and this is a training run")
    if not is_run and seed is not None:
        raise UsageError(f"--seed is about training runs; {source} is none, so give --episode (and --task)")
    shown = _tried(source, task, seed or 0, episode) if is_run else _stored(source, episode, task, rejects)
    if shown.note:
        click.echo(f"{shown.name} was {shown.note}")
    if png is not None:
        with _writing(png):
            _draw(shown, png)
        click.echo(f"{shown.name}: {png}")
    if mp4 is not None:
        from flowlab.viz.video import write_video

        with _writing(mp4):
            write_video(shown.episode, mp4, fps=fps, title=shown.name, note=shown.note, prediction=shown.prediction)
        click.echo(f"{shown.name}: {mp4}")
    if save is not None or (png is None and mp4 is None):
        from flowlab.viz.recording import write_rrd

        save = save or Path(f"{shown.episode.task}-{shown.episode.seed:06d}.rrd")
        name = f"{shown.name} (rejected)" if rejects else shown.name
        with _writing(save):
            write_rrd(shown.episode, save, name=name, about=shown.about, prediction=shown.prediction)
        click.echo(f"{shown.name}: {save}; open it with: rerun {save}")


@dataclass(frozen=True, slots=True)
class _Shown:
    """What is drawn, and what is said of it."""

    episode: "Episode"
    name: str
    note: str
    """Why it was kept out of its dataset, if it was."""
    about: str
    """Markdown for the recording's info panel."""
    prediction: "FlowPrediction | None" = None


def _stored(source: Path, episode: int, task: str | None, rejects: bool) -> _Shown:
    """An episode of a dataset."""
    from flowlab.storage.dataset import Dataset

    data = Dataset(source)
    shown, note = _rejected(data, episode, task) if rejects else (_accepted(data, episode, task), "")
    about = f"dataset {source}, fingerprint {data.fingerprint}, recipe {data.manifest.recipe}"
    return _Shown(shown, f"{shown.task} seed {shown.seed}", note, f"**{note}**\n\n{about}" if note else about)


def _tried(run: Path, task: str | None, seed: int, episode: int) -> _Shown:
    """An episode that a policy tries now."""
    from flowlab.errors import UsageError
    from flowlab.evaluation.evaluate import choose_tasks, find_checkpoint
    from flowlab.evaluation.replay import replay
    from flowlab.evaluation.trials import check_unseen, trials

    subject = find_checkpoint(run)
    tasks = choose_tasks([subject], [task] if task else [])
    if len(tasks) > 1:
        raise UsageError(f"{run}: knows several tasks; add --task, one of {', '.join(tasks)}")
    trial = trials(tasks, [seed], episode + 1)[-1]
    check_unseen([trial], subject.trained.scene_seeds, run)
    shown, prediction, outcome = replay(subject, trial)
    how = f"solved at step {outcome.steps}" if outcome.success else f"not solved in {outcome.steps} steps"
    name = f"{subject.run.name}: {trial.task}, seed {seed}, episode {episode}, {how}"
    return _Shown(shown, name, "", f"{subject.weights}, layout {trial.scene_seed}", prediction)


def _draw(shown: _Shown, png: Path) -> None:
    if shown.prediction is None:
        from flowlab.viz.still import draw_still

        draw_still(shown.episode, png, title=shown.name, note=shown.note)
        return
    from flowlab.viz.flow_prediction import draw_flow_prediction

    draw_flow_prediction(shown.episode, shown.prediction, png, title=shown.name)


def _accepted(data: "Dataset", episode: int, task: str | None) -> "Episode":
    return data.episode(_position(data, data.refs, "episode", episode, task))


def _rejected(data: "Dataset", episode: int, task: str | None) -> "tuple[Episode, str]":
    """What was kept out, and why."""
    position = _position(data, data.rejects, "reject", episode, task)
    ref = data.rejects[position]
    return data.rejected(position), f"rejected at {ref.stage}: {ref.reason}"


def _position(
    data: "Dataset", refs: "Sequence[EpisodeRef | RejectRef]", kind: str, episode: int, task: str | None
) -> int:
    """Where the ``episode``-th of a task (or of all) stands in the list."""
    from flowlab.errors import DataError

    positions = [k for k, ref in enumerate(refs) if task in (None, ref.task)]
    if not 0 <= episode < len(positions):
        where = f"{data.path}" if task is None else f"{data.path}, task '{task}'"
        raise DataError(f"{where}: no {kind} {episode}; there are {len(positions)}, counted from 0")
    return positions[episode]


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    from flowlab.errors import FlowlabError

    try:
        yield
    except OSError as error:
        raise FlowlabError(f"{path}: cannot be written ({error.strerror}); choose another file") from error
