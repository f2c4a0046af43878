"""``flowlab bench``."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from flowlab.cli.console import echo, json_option, print_json, print_tables, quiet_option, say, warn
from flowlab.cli.evaluate import echo_report
from flowlab.cli.paths import PATH
from flowlab.cli.values import (
    engine_option,
    installed,
    names_option,
    numbers_option,
    tasks_and_groups,
)
from flowlab.cli.values import groups as group_names
from flowlab.errors import UsageError
from flowlab.registry import POLICIES
from flowlab.text import counted

if TYPE_CHECKING:
    from flowlab.benchmark.expert_results import ExpertResult
    from flowlab.benchmark.recipe import ExperimentRecipe
    from flowlab.evaluation.results import PolicyResult
    from flowlab.pipeline.units import JobShard


@click.command()
@click.option("--out", type=PATH, required=True, help="Folder of the experiment.")
@click.option("--recipe", default="paper", show_default=True, help="An experiment's name, or a YAML file.")
@names_option("--group", "groups", known=group_names, help="All tasks of a difficulty, instead of the recipe's.")
@names_option("--tasks", "--task", "tasks", known=tasks_and_groups, help="Tasks, instead of the recipe's.")
@names_option("--policies", known=installed(POLICIES), help="'flowlab plugins' lists policies  [the recipe's].")
@names_option("--variants", help="Of the recipe's variants; none for no variants  [all].")
@click.option("--budget", metavar="TIME", help="Training of each policy, as 10m, 90s or 1.5h  [the recipe's].")
@click.option("--episodes", type=click.IntRange(min=1), help="Of each seed  [the recipe's].")
@numbers_option("--seeds", help="Evaluation seeds  [the recipe's].")
@engine_option
@click.option("--workers", type=click.IntRange(min=1), help="Policies trained at a time  [one for each core].")
@click.option("--shard", default="0/1", metavar="I/N", help="Do part I of N (from 0) of the tasks, for job arrays.")
@click.option("--device", help="Where to train: cpu, cuda  [a GPU if there is one].")
@click.option("--expert", is_flag=True, help="Let MetaWorld's own expert try the same episodes, instead of policies.")
@click.option("--dry-run", is_flag=True, help="Say what would be done; do nothing.")
@quiet_option
@json_option
def bench(
    out: Path,
    recipe: str,
    groups: tuple[str, ...],
    tasks: tuple[str, ...],
    policies: tuple[str, ...],
    variants: tuple[str, ...],
    budget: str | None,
    episodes: int | None,
    seeds: tuple[int, ...],
    engine: str,
    workers: int | None,
    shard: str,
    device: str | None,
    expert: bool,
    dry_run: bool,
    as_json: bool,
) -> None:
    """Run a whole experiment: extract, train, evaluate, report.

    \b
      flowlab bench --group hard --policies fdp,dp3,mba --budget 10m --out results/hard
      flowlab bench --out results/paper
      flowlab bench --recipe table1 --out results/table1 --shard 0/4    # the other parts: 1/4, 2/4, 3/4
      flowlab bench --recipe table1 --out results/table1 --expert --episodes 20

    Recipes that come with flowlab: paper, and the paper's tables whole: table1 and ablations.

    With --expert, MetaWorld's scripted experts try the episodes of the recipe, on the layouts that policies get: what
    they solve is kept in OUT/expert, and the report has it beside the policies.

    Every policy is a unit of work, done by one process. Ended early, the same command does the rest: a unit is done
    once its result is in OUT/units, and neither runs nor datasets are needed for it then. The parts of --shard may
    share one OUT, or have one each whose OUT/units are brought together.
    """
    from flowlab.benchmark.recipe import load_experiment, with_variants
    from flowlab.pipeline.units import JobShard

    changes: dict[str, Any] = {
        "tasks": (*groups, *tasks) or None,
        "policies": policies or None,
        "episodes": episodes,
        "seeds": seeds or None,
        "device": device,
    }
    changes = {k: v for k, v in changes.items() if v is not None}
    if budget:
        changes |= {"minutes": _minutes(budget), "steps": None}
    part = JobShard.parse(shard)
    asked = load_experiment(recipe, **changes)
    if variants:
        asked = with_variants(asked, [name for name in variants if name != "none"])
    if expert:
        _check_trains_nothing(policies=policies, variants=variants, budget=budget, device=device)
        _run_experts(asked, out, engine, workers, part, dry_run, as_json)
        return
    if dry_run:
        _say_what_is_left(asked, out, part, workers, as_json)
        return
    from flowlab.benchmark.experiment import run_experiment

    results = run_experiment(asked, out, engine=engine, workers=workers, shard=part, on_progress=_print_progress)
    if not results:
        warn(f"nothing of this experiment is done yet, and nothing of it belongs to part {shard}")
        if as_json:
            print_json([])
        return
    from flowlab.benchmark.expert_results import read_experts
    from flowlab.benchmark.summary import summarize
    from flowlab.benchmark.units import plan_units
    from flowlab.report.tables import summary_tables
    from flowlab.report.write import write_report

    summary = summarize(results, experts=read_experts([out]), planned=plan_units(asked))
    write_report(out, summary, results)
    if as_json:
        print_json([r.model_dump(mode="json", exclude_defaults=True) for r in results])
        return
    print_tables(summary_tables(summary))
    echo_report(out)


def _check_trains_nothing(**given: str | tuple[str, ...] | None) -> None:
    """Refuse options that are about policies, where none is trained."""
    if about_policies := [f"--{name}" for name, value in given.items() if value]:
        raise UsageError(f"--expert trains nothing, so leave out {', '.join(about_policies)}")


def _run_experts(
    recipe: "ExperimentRecipe",
    out: Path,
    engine: str,
    workers: int | None,
    shard: "JobShard",
    dry_run: bool,
    as_json: bool,
) -> None:
    """Let experts try what they have not tried yet, and print how often they succeed; or only name what is left."""
    from flowlab.benchmark.expert_run import missing_trials, run_experts
    from flowlab.report.tables import expert_table

    if dry_run:
        left = missing_trials(recipe, out, shard)
        trials = {unit.name: len(unit.trials) for unit in left}
        if as_json:
            print_json({"left": trials})
            return
        for name, count in trials.items():
            echo(f"{name}: {counted(count, 'episode')}")
        echo(f"{counted(len(left), 'task')}, {counted(sum(trials.values()), 'episode')} of their experts left")
        return

    def tell(result: "ExpertResult") -> None:
        say(f"{result.task}: {sum(o.success for o in result.outcomes)} of {len(result.outcomes)} solved")

    results = run_experts(recipe, out, engine=engine, workers=workers, shard=shard, on_result=tell)
    if as_json:
        print_json([r.model_dump(mode="json") for r in results])
        return
    print_tables([expert_table(results)])


def _say_what_is_left(
    recipe: "ExperimentRecipe", out: Path, shard: "JobShard", workers: int | None, as_json: bool
) -> None:
    """Name the units that a run would do, and say what they cost and how many are done."""
    from flowlab.benchmark.experiment import known_results
    from flowlab.benchmark.units import plan_cost, plan_units, share_of_units

    units = plan_units(recipe)
    known = known_results(recipe, units, out)
    left = [u for u in share_of_units(units, shard) if u.name not in known]
    cost = plan_cost(recipe, len(left), workers)
    if as_json:
        print_json({"left": [unit.name for unit in left], "done": len(known), "units": len(units), "cost": cost})
        return
    for unit in left:
        echo(unit.name)
    if known:
        echo(_standing(len(known), len(units)))
    echo(cost)


def _print_progress(fresh: Sequence["PolicyResult"], done: int, total: int) -> None:
    """Say how new results went, and how many are there."""
    for r in fresh:
        solved = sum(o.success for o in r.final)
        say(f"{r.name}: {solved} of {len(r.final)} solved")
    say(_standing(done, total))


def _standing(done: int, total: int) -> str:
    """How far the whole experiment is."""
    return f"{done} of {counted(total, 'policy', 'policies')} done" + (f", {total - done} left" if done < total else "")


def _minutes(text: str) -> float:
    """Minutes from a time such as ``90s``. Raises :class:`UsageError` where it is none."""
    units = {"s": 1 / 60, "m": 1.0, "h": 60.0}
    try:
        minutes = float(text[:-1]) * units[text[-1]]
    except (KeyError, ValueError, IndexError):
        minutes = 0.0
    if not 0 < minutes < float("inf"):
        raise UsageError(f"--budget {text}: must be a time, as in 10m, 90s or 1.5h")
    return minutes
