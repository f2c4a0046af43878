"""``flowlab eval``."""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import click

from flowlab.cli.console import ProgressBar, echo, json_option, print_json, print_tables, quiet_option
from flowlab.cli.paths import PATH
from flowlab.cli.values import StepsOrAuto, engine_option, names_option, numbers_option, tasks_and_groups
from flowlab.errors import UsageError


@click.command("eval")
@click.argument("runs", nargs=-1, required=True, metavar="RUN...", type=PATH)
@click.option("--episodes", type=click.IntRange(min=1), default=20, show_default=True, help="Of each task and seed.")
@numbers_option("--seeds", default=["0,1,2"], help="Evaluation seeds  [0,1,2].")
@names_option("--tasks", "--task", "tasks", known=tasks_and_groups, help="[all that every policy was trained on]")
@click.option(
    "--execute",
    type=StepsOrAuto(),
    help="Steps of a plan to execute: 1 or 8, say; auto tries 20 other layouts of each task  [the policy's].",
)
@click.option("--checkpoints", is_flag=True, help="Evaluate every checkpoint of the runs: a learning curve.")
@engine_option
@click.option("--workers", type=click.IntRange(min=1), help="Processes  [one for each core].")
@click.option("--device", default="cpu", show_default=True, help="Where plans are made: cpu, cuda, cuda:1.")
@click.option("--films", type=click.IntRange(min=0), default=0, metavar="N", help="Film N successes and N failures.")
@click.option("--out", type=PATH, help="Write a report into this folder.")
@click.option("--offline", is_flag=True, help="No simulator: errors on held-out demonstrations.")
@click.option("--data", type=PATH, help="With --offline: another dataset than the run's own.")
@quiet_option
@json_option
def evaluate(
    runs: tuple[Path, ...],
    episodes: int,
    seeds: tuple[int, ...],
    tasks: tuple[str, ...],
    execute: int | Literal["auto"] | None,
    checkpoints: bool,
    engine: str,
    workers: int | None,
    device: str,
    films: int,
    out: Path | None,
    offline: bool,
    data: Path | None,
    as_json: bool,
) -> None:
    """Let trained policies act in simulation, and count how often they succeed.

    \b
      flowlab eval runs/push-fdp --episodes 200 --seeds 0,1,2 --workers 4
      flowlab eval runs/push-fdp runs/push-dp3 --out results/push
      flowlab eval runs/pour --offline

    A RUN is what `flowlab train` made, or one of its checkpoints. Policies see what their own Observer makes of the
    scene. All meet the same scenes, none of which was demonstrated, so that they can be compared episode by episode;
    the outcome is the same for any number of workers. Every episode is kept in the run's folder as it ends: ended
    early, the same command does the rest, and more episodes add to those that are there.
    """
    if offline:
        given = {"--tasks": tasks, "--execute": execute, "--checkpoints": checkpoints, "--workers": workers,
                 "--films": films, "--out": out}  # fmt: skip
        if about_rollouts := [name for name, value in given.items() if value]:
            raise UsageError(f"--offline tries no episodes, so leave out {', '.join(about_rollouts)}")
        _evaluate_offline(runs, data, as_json)
        return
    if data is not None:
        raise UsageError("--data is about held-out demonstrations; add --offline")
    from flowlab.evaluation import evaluate as evaluation

    with ProgressBar() as bar:
        results = evaluation.evaluate(
            runs,
            tasks=tasks,
            seeds=seeds,
            episodes=episodes,
            n_action_steps=execute,
            checkpoints=checkpoints,
            engine=engine,
            workers=workers,
            device=device,
            on_progress=lambda done, of: bar.update(done, of, "evaluating"),
            on_choosing=lambda done, of: bar.update(done, of, "choosing how many steps to execute"),
        )
    videos: list[Path] = []
    if films:
        from flowlab.report.videos import write_videos

        videos = write_videos(runs, results, films, out)
    from flowlab.benchmark.summary import summarize

    summary = summarize(results)
    if out is not None:
        from flowlab.report.write import write_report

        write_report(out, summary, results, videos=videos)
    if as_json:
        print_json([r.model_dump(mode="json", exclude_defaults=True) for r in results])
        return
    from flowlab.report.tables import summary_tables

    print_tables(summary_tables(summary))
    for result in results:
        if result.execution is not None:
            echo(f"{result.name}: {result.execution}")
    for path in videos:
        echo(f"film: {path}")
    if out is not None:
        echo_report(out)


def _evaluate_offline(runs: Sequence[Path], data: Path | None, as_json: bool) -> None:
    """Errors on held-out demonstrations, as JSON or as tables."""
    from flowlab.evaluation.offline import evaluate_offline
    from flowlab.policies.checkpoint import load_policy
    from flowlab.report.tables import demonstration_table, offline_table

    reports = {run: evaluate_offline(load_policy(run), data) for run in runs}
    if as_json:
        print_json({str(run): report.model_dump(mode="json") for run, report in reports.items()})
        return
    for run, report in reports.items():
        print_tables(
            [
                offline_table(report, f"{run}: errors on demonstrations it was not trained on"),
                demonstration_table(report, "every demonstration"),
            ]
        )


def echo_report(folder: Path) -> None:
    """Say where a report is."""
    echo(f"{folder / 'report.html'}, with report.json, report.csv and episodes.csv beside it")
