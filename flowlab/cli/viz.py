"""``flowlab viz``."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from flowlab.records import Episode
    from flowlab.storage.dataset import Dataset, EpisodeRef, RejectRef


@click.command()
@click.argument("dataset", type=click.Path(path_type=Path))
@click.option(
    "--episode", default=0, show_default=True, help="Position in the order of `flowlab info`: by task, then seed."
)
@click.option("--task", help="Count episodes within this task.")
@click.option("--rejects", is_flag=True, help="Count among what was kept out of the dataset, and say why it was.")
@click.option("--save", type=click.Path(path_type=Path), help="Write a Rerun recording (.rrd) here.")
@click.option("--png", type=click.Path(path_type=Path), help="Draw a still here.")
@click.option("--mp4", type=click.Path(path_type=Path), help="Write a film of the pictures here, tracks drawn in.")
@click.option("--fps", type=click.FloatRange(min=0.1, max=240), help="Frames a second of the film [real time].")
def viz(
    dataset: Path,
    episode: int,
    task: str | None,
    rejects: bool,
    save: Path | None,
    png: Path | None,
    mp4: Path | None,
    fps: float | None,
) -> None:
    """Draw an episode: cloud, query points, their tracks over time.

    \b
      flowlab viz data/pour --episode 3 --mp4 pour.mp4
      flowlab viz data/pour --rejects --png why.png

    Tracks that were estimated are coloured by their stated error, exact ones by what they lie on. With none of
    --save, --png and --mp4, a recording is written beside you.
    """
    from flowlab.errors import UsageError
    from flowlab.storage.dataset import Dataset

    if fps is not None and mp4 is None:
        raise UsageError("--fps is about the film; give --mp4 FILE too")
    data = Dataset(dataset)
    shown, note = _rejected(data, episode, task) if rejects else (_accepted(data, episode, task), "")
    name = f"{shown.task} seed {shown.seed}"
    if note:
        click.echo(f"{name} was {note}")
    if png is not None:
        from flowlab.viz.still import draw_still

        with _writing(png):
            draw_still(shown, png, title=name, note=note)
        click.echo(f"{name}: {png}")
    if mp4 is not None:
        from flowlab.viz.video import write_video

        with _writing(mp4):
            write_video(shown, mp4, fps=fps, title=name, note=note)
        click.echo(f"{name}: {mp4}")
    if save is not None or (png is None and mp4 is None):
        from flowlab.viz.recording import write_recording

        save = save or Path(f"{shown.task}-{shown.seed:06d}.rrd")
        about = f"dataset {dataset}, fingerprint {data.fingerprint}, recipe {data.manifest.recipe}"
        if note:
            about = f"**{note}**\n\n{about}"
        with _writing(save):
            write_recording(shown, save, name=f"{name} (rejected)" if note else name, about=about)
        click.echo(f"{name}: {save}; open it with: rerun {save}")


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
