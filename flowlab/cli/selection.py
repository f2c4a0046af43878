"""``flowlab merge``, ``flowlab subset`` and ``flowlab split``."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from flowlab.cli.console import echo, json_option, print_json, quiet_option
from flowlab.cli.paths import PATH
from flowlab.cli.values import names_option
from flowlab.text import counted

if TYPE_CHECKING:
    from flowlab.storage.dataset import Dataset


@click.command()
@click.argument("datasets", type=PATH, nargs=-1, required=True, metavar="DATASET DATASET...")
@click.option("--out", type=PATH, required=True, help="Folder of the new dataset.")
@quiet_option
@json_option
def merge(datasets: tuple[Path, ...], out: Path, as_json: bool) -> None:
    """Make one dataset of several that say the same of their frame, camera and numbers.

    Nothing of the datasets changes. Recordings whose numbers are taken get the next free ones, and an episode that is
    in several is kept once; both is said.
    """
    from flowlab.storage.merging import merge

    _tell([merge(datasets, out)], as_json)


@click.command()
@click.argument("dataset", type=PATH)
@names_option("--tasks", "--task", "tasks", help="Only these tasks.")
@click.option(
    "--episodes",
    metavar="N,A:B,...",
    help="Only these, counted from 0 within the tasks, in the order of 'flowlab viz --episode'; B is not in A:B.",
)
@click.option("--out", type=PATH, required=True, help="Folder of the new dataset.")
@quiet_option
@json_option
def subset(dataset: Path, tasks: tuple[str, ...], episodes: str | None, out: Path, as_json: bool) -> None:
    """Make a dataset of some episodes of another one.

    \b
      flowlab subset data/all --tasks push,hammer --out data/two
      flowlab subset data/all --tasks push --episodes 0:50 --out data/push-50
      flowlab subset data/all --episodes 3,10:20,-5: --out data/some
    """
    from flowlab.storage.selection import subset

    _tell([subset(dataset, out, tasks=tasks or None, episodes=episodes)], as_json)


@click.command()
@click.argument("dataset", type=PATH)
@click.option("--val", type=float, default=0.1, show_default=True, help="Share of each task's episodes to validate on.")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Of the draw.")
@click.option("--out", type=PATH, help="What the new names begin with: OUT-train, OUT-val  [DATASET].")
@quiet_option
@json_option
def split(dataset: Path, val: float, seed: int, out: Path | None, as_json: bool) -> None:
    """Make two datasets of one, to train on and to validate on: of every task the same share, drawn at random."""
    from flowlab.storage.selection import split

    _tell(list(split(dataset, out, val=val, seed=seed)), as_json)


def _tell(made: "list[Dataset]", as_json: bool) -> None:
    """Say what was made."""
    from flowlab.storage.overview import frame_count, task_totals

    facts = [
        {"dataset": str(d.path), "fingerprint": d.fingerprint, "episodes": len(d), "frames": frame_count(d),
         "tasks": {t.task: t.episodes for t in task_totals(d)}, "rejected": len(d.rejects)}
        for d in made
    ]  # fmt: skip
    if as_json:
        print_json(facts if len(facts) > 1 else facts[0])
        return
    for dataset in made:
        tasks = ", ".join(f"{t.task} {t.episodes}" for t in task_totals(dataset))
        held = f"{counted(len(dataset), 'episode')}, {counted(frame_count(dataset), 'frame')}"
        echo(f"{dataset.path}: {held} ({tasks})")
