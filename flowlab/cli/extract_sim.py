"""``flowlab extract-sim``."""

import os
import sys
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from flowlab.cli.console import ProgressBar, console, print_json
from flowlab.errors import MissingLibraryError, UsageError

if TYPE_CHECKING:
    from flowlab.pipeline.recipe import Recipe


@click.command("extract-sim")
@click.argument("tasks", nargs=-1, metavar="[TASK]...")
@click.option("--group", "groups", multiple=True, help="All tasks of a difficulty: easy, medium, hard, very-hard, all.")
@click.option("--episodes", type=click.IntRange(min=1), help="Successful episodes per task [the recipe's: 10].")
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Folder of the dataset.")
@click.option("--workers", type=click.IntRange(min=1), help="Processes [one for each core].")
@click.option("--recipe", default="metaworld", show_default=True, help="A recipe's name, or a YAML file.")
@click.option("--set", "overrides", multiple=True, metavar="KEY=VALUE", help="Change a setting: observer.points=512.")
@click.option("--renderer", type=click.Choice(["zbuffer", "gl"]), help="Short for --set expert.scene.renderer=...")
@click.option("--shard", default="0/1", metavar="I/N", help="Do part I of N (from 0), for job arrays on one --out.")
@click.option("--dry-run", is_flag=True, help="Say what would be done, with an estimate; write nothing.")
@click.option("--json", "as_json", is_flag=True, help="Print the result as JSON, and no progress.")
def extract_sim(
    tasks: tuple[str, ...],
    groups: tuple[str, ...],
    episodes: int | None,
    out: Path,
    workers: int | None,
    recipe: str,
    overrides: tuple[str, ...],
    renderer: str | None,
    shard: str,
    dry_run: bool,
    as_json: bool,
) -> None:
    """Make a dataset of MetaWorld demonstrations with exact 3D-flow labels.

    \b
      flowlab extract-sim hammer push --episodes 10 --out data/demo
      flowlab extract-sim --group hard --out data/hard --workers 4
      flowlab extract-sim hammer --recipe metaworld-dp3 --out data/dp3

    An existing dataset with the same settings is continued or extended; ended early, the same command
    does the rest.
    """
    sys.path.insert(0, os.getcwd())  # a recipe's own stages may lie beside it
    try:
        import flowlab.pipeline.stages.simulation  # noqa: F401 - MuJoCo comes with it
        from flowlab.engines.local import LocalEngine
        from flowlab.pipeline.extraction import extract
        from flowlab.pipeline.recipe import load_recipe
        from flowlab.pipeline.scheduling import ExtractionProgress
    except Exception as error:
        if "MUJOCO_GL" not in os.environ:
            raise
        # MuJoCo loads the back end it is told of on import, needed or not.
        raise MissingLibraryError(
            f"MuJoCo cannot load OpenGL as MUJOCO_GL={os.environ['MUJOCO_GL']} asks ({error}); unset MUJOCO_GL, or "
            "install it with 'apt-get install libegl1 libgl1-mesa-dri libosmesa6'"
        ) from error
    from flowlab.pipeline.units import JobShard
    from flowlab.sim.tasks import GROUPS, select_tasks

    changes = [*overrides, *([f"expert.scene.renderer={renderer}"] if renderer else [])]
    chosen_recipe = load_recipe(recipe, [*changes, *([f"episodes={episodes}"] if episodes else [])])
    asked = [*tasks, *(() if tasks or groups else chosen_recipe.tasks)]
    chosen = select_tasks([t for t in asked if t not in GROUPS], [*groups, *(t for t in asked if t in GROUPS)])
    if not chosen:
        raise UsageError("name the tasks to extract, as in 'flowlab extract-sim hammer push --out data/demo'")
    share, workers = JobShard.parse(shard), workers or len(os.sched_getaffinity(0))
    if dry_run:
        _dry_run(chosen_recipe, chosen, out, workers, as_json)
        return
    start = time.monotonic()
    with ProgressBar(quiet=as_json) as bar:

        def show(progress: ExtractionProgress) -> None:
            note = f"extracting ({progress.rejected} rejected)" if progress.rejected else "extracting"
            bar.update(progress.accepted, progress.wanted, note)

        dataset = extract(
            chosen_recipe, chosen, out, start_engine=partial(LocalEngine, workers=workers), share=share, report=show
        )
    from flowlab.cli.reports import extraction_report, print_extraction

    report = extraction_report(dataset, time.monotonic() - start)
    if as_json:
        print_json(report)
        return
    print_extraction(report)
    if dataset.missing and share.count > 1:
        console.print("the rest belongs to the other shards", highlight=False)


def _dry_run(recipe: "Recipe", tasks: tuple[str, ...], out: Path, workers: int, as_json: bool) -> None:
    """Time one episode, write it nowhere, and say what the run would do."""
    from flowlab.pipeline.extraction import estimate

    plan = estimate(recipe, tasks, out, workers)
    if as_json:
        print_json(plan)
        return
    for name, value in plan.items():
        click.echo(f"{name.replace('_', ' '):<24} {value}")
