"""``flowlab viz``."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import click


@click.command()
@click.argument("dataset", type=click.Path(path_type=Path))
@click.option(
    "--episode", default=0, show_default=True, help="Position in the order of `flowlab info`: by task, then seed."
)
@click.option("--task", help="Count episodes within this task.")
@click.option("--save", type=click.Path(path_type=Path), help="Write a Rerun recording (.rrd) here.")
@click.option("--png", type=click.Path(path_type=Path), help="Draw a still here.")
def viz(dataset: Path, episode: int, task: str | None, save: Path | None, png: Path | None) -> None:
    """Draw an episode: cloud, query points by owner, their tracks over time.

    With neither --save nor --png, a recording is written beside you.
    """
    from flowlab.errors import DataError
    from flowlab.storage.dataset import Dataset

    data = Dataset(dataset)
    positions = [k for k, ref in enumerate(data.refs) if task in (None, ref.task)]
    if not 0 <= episode < len(positions):
        where = f"{dataset}" if task is None else f"{dataset}, task '{task}'"
        raise DataError(f"{where}: no episode {episode}; there are {len(positions)}, counted from 0")
    shown = data.episode(positions[episode])
    name = f"{shown.task} seed {shown.seed}"
    if png is not None:
        from flowlab.viz.still import draw_still

        with _writing(png):
            draw_still(shown, png, title=name)
        click.echo(f"{name}: {png}")
    if save is not None or png is None:
        from flowlab.viz.recording import write_recording

        save = save or Path(f"{shown.task}-{shown.seed:06d}.rrd")
        about = f"dataset {dataset}, fingerprint {data.fingerprint}, recipe {data.manifest.recipe}"
        with _writing(save):
            write_recording(shown, save, name=name, about=about)
        click.echo(f"{name}: {save}; open it with: rerun {save}")


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    from flowlab.errors import FlowlabError

    try:
        yield
    except OSError as error:
        raise FlowlabError(f"{path}: cannot be written ({error.strerror}); choose another file") from error
