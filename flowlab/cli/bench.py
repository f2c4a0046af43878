"""``flowlab bench``."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from flowlab.cli.console import console, print_json
from flowlab.cli.results import print_results
from flowlab.errors import UsageError

if TYPE_CHECKING:
    from flowlab.benchmark.results import PolicyResult


@click.command()
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Folder of the experiment.")
@click.option("--recipe", default="paper", show_default=True, help="An experiment's name, or a YAML file.")
@click.option("--group", "groups", multiple=True, help="All tasks of a difficulty, instead of the recipe's tasks.")
@click.option("--task", "tasks", multiple=True, help="A task, instead of the recipe's; may be repeated.")
@click.option("--policies", metavar="NAME,...", help="Of fdp, dp3, mba  [the recipe's].")
@click.option("--variants", metavar="NAME,...", help="Of the recipe's variants; none for no variants  [all].")
@click.option("--budget", metavar="TIME", help="Training of each policy, as 10m, 90s or 1.5h  [the recipe's].")
@click.option("--episodes", type=click.IntRange(min=1), help="Of each seed  [the recipe's].")
@click.option("--seeds", metavar="N,...", help="Evaluation seeds  [the recipe's].")
@click.option("--workers", type=click.IntRange(min=1), help="Policies trained at a time  [one for each core].")
@click.option("--device", help="Where to train: cpu, cuda  [a GPU if there is one].")
@click.option("--dry-run", is_flag=True, help="Say what would be done; do nothing.")
@click.option("--json", "as_json", is_flag=True, help="Print the results as JSON, and no progress.")
def bench(
    out: Path,
    recipe: str,
    groups: tuple[str, ...],
    tasks: tuple[str, ...],
    policies: str | None,
    variants: str | None,
    budget: str | None,
    episodes: int | None,
    seeds: str | None,
    workers: int | None,
    device: str | None,
    dry_run: bool,
    as_json: bool,
) -> None:
    """Run a whole experiment: extract, train, evaluate, report.

    \b
      flowlab bench --group hard --policies fdp,dp3,mba --budget 10m --out results/hard
      flowlab bench --out results/paper

    Every policy is a unit of work, done by one process. Ended early, the same command does the rest: a unit is done
    once its result is in OUT/units, and neither runs nor datasets are needed for it then.
    """
    from flowlab.benchmark import experiment
    from flowlab.cli.evaluate import numbers
    from flowlab.report.html import write_report

    changes: dict[str, Any] = {
        "tasks": (*groups, *tasks) or None,
        "policies": tuple(_names(policies)) if policies else None,
        "minutes": _minutes(budget) if budget else None,
        "episodes": episodes,
        "seeds": numbers(seeds) if seeds else None,
        "device": device,
    }
    asked = experiment.load_experiment(recipe, **{k: v for k, v in changes.items() if v is not None})
    if variants is not None:
        asked = experiment.with_variants(asked, [] if variants == "none" else _names(variants))
    units = experiment.plan_units(asked)
    workers = workers or len(os.sched_getaffinity(0))
    if dry_run:
        hours = len(units) * asked.minutes / 60
        for unit in units:
            click.echo(unit.name)
        click.echo(
            f"{len(units)} policies, {asked.minutes:g} minutes of training each: {hours:.1f} hours of one core, "
            f"{hours / workers:.1f} on {workers}"
        )
        return
    told: set[str] = set()

    def show(results: Sequence["PolicyResult"], of: int) -> None:
        fresh, before = [r for r in results if r.name not in told], bool(told)
        told.update(r.name for r in results)
        if as_json:
            return
        for r in fresh if before or len(fresh) < of else []:
            solved = sum(o.success for o in r.final)
            console.print(f"{r.name}: {solved} of {len(r.final)} solved", highlight=False)
        console.print(f"{len(results)} of {of} policies done", highlight=False)

    results = experiment.run_experiment(asked, out, workers, show)
    write_report(out, results)
    if as_json:
        print_json([r.model_dump(mode="json", exclude_defaults=True) for r in results])
        return
    print_results(results)
    click.echo(f"{out / 'report.html'}, with report.json, report.csv and episodes.csv beside it")


def _names(text: str) -> list[str]:
    return [name for name in text.replace(" ", "").split(",") if name]


def _minutes(text: str) -> float:
    units = {"s": 1 / 60, "m": 1.0, "h": 60.0}
    try:
        minutes = float(text[:-1]) * units[text[-1]]
    except (KeyError, ValueError, IndexError):
        minutes = 0.0
    if not 0 < minutes < float("inf"):
        raise UsageError(f"--budget {text}: must be a time, as in 10m, 90s or 1.5h")
    return minutes
