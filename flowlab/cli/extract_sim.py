"""``flowlab extract-sim``."""

import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import click

from flowlab.cli.console import ProgressBar, echo, json_option, print_json, quiet_option, show_extraction
from flowlab.cli.paths import PATH
from flowlab.cli.values import engine_option, groups, names_argument, names_option, tasks_and_groups


@click.command("extract-sim")
@names_argument("tasks", known=tasks_and_groups, metavar="[TASK]...")
@names_option("--group", "groups", known=groups, help="All tasks of a difficulty: easy, medium, hard, very-hard, all.")
@click.option("--episodes", type=click.IntRange(min=1), help="Successful episodes per task [the recipe's: 10].")
@click.option("--out", type=PATH, required=True, help="Folder of the dataset.")
@click.option("--workers", type=click.IntRange(min=1), help="Processes [one for each core].")
@engine_option
@click.option("--recipe", default="metaworld", show_default=True, help="A recipe's name, or a YAML file.")
@click.option("--set", "overrides", multiple=True, metavar="KEY=VALUE", help="Change a setting: observer.points=512.")
@click.option("--renderer", type=click.Choice(["zbuffer", "gl"]), help="Short for --set expert.scene.renderer=...")
@names_option(
    "--without",
    known=lambda: ["actions", "state"],
    metavar="WHAT",
    help="Leave out 'actions', 'state' or 'actions,state', as films do.",
)
@click.option("--shard", default="0/1", metavar="I/N", help="Do part I of N (from 0), for job arrays on one --out.")
@click.option("--repair", is_flag=True, help="Read all that is there, and make again what is damaged.")
@click.option("--dry-run", is_flag=True, help="Say what would be done, with an estimate; write nothing.")
@quiet_option
@json_option
def extract_sim(
    tasks: tuple[str, ...],
    groups: tuple[str, ...],
    episodes: int | None,
    out: Path,
    workers: int | None,
    engine: str,
    recipe: str,
    overrides: tuple[str, ...],
    renderer: str | None,
    without: tuple[str, ...],
    shard: str,
    repair: bool,
    dry_run: bool,
    as_json: bool,
) -> None:
    """Make a dataset of MetaWorld demonstrations with exact 3D-flow labels.

    \b
      flowlab extract-sim hammer push --episodes 10 --out data/demo
      flowlab extract-sim --group hard --out data/hard --workers 4
      flowlab extract-sim hammer --recipe metaworld-dp3 --out data/dp3
      flowlab extract-sim push --episodes 47 --without actions,state --out data/films

    An existing dataset with the same settings is continued or extended; ended early, the same command
    does the rest.
    """
    from flowlab.pipeline.extraction import extract
    from flowlab.pipeline.units import JobShard
    from flowlab.sim.tasks import select_tasks, tasks_named

    chosen = [*tasks_named(tasks), *select_tasks([], groups)]
    changes = [*overrides, *([f"expert.scene.renderer={renderer}"] if renderer else [])]
    share = JobShard.parse(shard)
    if dry_run:
        about = {"episodes": episodes, "recipe": recipe, "settings": changes, "without": without}
        _dry_run(chosen, out, as_json, **about, workers=workers)
        return
    start = time.monotonic()
    with ProgressBar() as bar:
        dataset = extract(
            chosen, out, episodes=episodes, recipe=recipe, settings=changes, without=without,
            engine=engine, workers=workers, shard=share, repair=repair,
            on_progress=lambda progress: show_extraction(bar, progress, "extracting"),
        )  # fmt: skip
    from flowlab.cli.reports import finish_extraction

    finish_extraction(dataset, time.monotonic() - start, share, as_json)


def _dry_run(tasks: Sequence[str], out: Path, as_json: bool, **options: Any) -> None:
    """Say what the run would do, by one episode that is written nowhere."""
    from flowlab.pipeline.extraction import estimate

    plan = asdict(estimate(tasks, out, **options))
    if as_json:
        print_json(plan)
        return
    for name, value in plan.items():
        echo(f"{name.replace('_', ' '):<24} {value}")
