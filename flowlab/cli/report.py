"""``flowlab report``."""

from pathlib import Path

import click

from flowlab.cli.console import json_option, print_json, print_tables, quiet_option
from flowlab.cli.evaluate import echo_report
from flowlab.cli.paths import PATH
from flowlab.errors import UsageError


@click.command()
@click.argument("sources", nargs=-1, required=True, metavar="SOURCE...", type=PATH)
@click.option("--out", type=PATH, help="Folder to write  [SOURCE, if it is an experiment].")
@click.option("--recipe", help="The experiment's, so that the report says what is missing: a name, or a YAML file.")
@quiet_option
@json_option
def report(sources: tuple[Path, ...], out: Path | None, recipe: str | None, as_json: bool) -> None:
    """Write a report of evaluations: report.html, report.json, CSV.

    \b
      flowlab report results/hard
      flowlab report results/table1 --recipe table1
      flowlab report runs/push-fdp runs/push-dp3 --out results/push
      flowlab report trials.csv --out results/robot

    A SOURCE is the folder of a bench, a run that `flowlab eval` has evaluated, or a CSV file of trials on a robot that
    somebody scored, with the columns policy, task, trial, success.
    """
    from flowlab.benchmark.expert_results import read_experts
    from flowlab.benchmark.recipe import load_experiment
    from flowlab.benchmark.results import read_results
    from flowlab.benchmark.units import plan_units

    tables = [source for source in sources if source.suffix == ".csv"]
    if out is None:
        if len(sources) != 1 or tables:
            raise UsageError("--out: say where to write the report, as in --out results/robot")
        out = sources[0]
    if tables:
        from flowlab.benchmark.robot_trials import read_robot_trials
    robot_trials = [trial for table in tables for trial in read_robot_trials(table)]
    folders = [source for source in sources if source.suffix != ".csv"]
    results = read_results(folders)
    planned = None if recipe is None else plan_units(load_experiment(recipe))
    experts = read_experts(folders)
    # What writes it takes seconds to load, and does when nothing was refused.
    from flowlab.benchmark.summary import summarize
    from flowlab.report.tables import robot_trial_tables, summary_tables
    from flowlab.report.write import write_report

    summary = summarize(results, experts=experts, planned=planned)
    write_report(out, summary, results, robot_trials=robot_trials)
    if as_json:
        print_json(summary.to_json())
        return
    print_tables([*(summary_tables(summary) if results else []), *robot_trial_tables(robot_trials)])
    echo_report(out)
