"""``flowlab eval``."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from flowlab.cli.console import ProgressBar, print_json, print_table
from flowlab.cli.results import print_results
from flowlab.errors import UsageError

if TYPE_CHECKING:
    from flowlab.benchmark.results import PolicyResult
    from flowlab.evaluation.evaluate import CheckpointRef


@click.command("eval")
@click.argument("runs", nargs=-1, required=True, metavar="RUN...", type=click.Path(path_type=Path))
@click.option("--episodes", type=click.IntRange(min=1), default=20, show_default=True, help="Of each task and seed.")
@click.option("--seeds", default="0,1,2", show_default=True, metavar="N,...", help="Evaluation seeds.")
@click.option("--task", "tasks", multiple=True, help="May be repeated  [all that every policy was trained on].")
@click.option("--execute", type=click.IntRange(min=1), help="Steps of a plan to execute: 1 or 8, say  [the policy's].")
@click.option("--checkpoints", is_flag=True, help="Evaluate every checkpoint of the runs: a learning curve.")
@click.option("--workers", type=click.IntRange(min=1), help="Processes  [one for each core].")
@click.option("--device", default="cpu", show_default=True, help="Where plans are made: cpu, cuda, cuda:1.")
@click.option("--films", type=click.IntRange(min=0), default=0, metavar="N", help="Film N successes and N failures.")
@click.option("--out", type=click.Path(path_type=Path), help="Write a report into this folder.")
@click.option("--offline", is_flag=True, help="No simulator: errors on held-out demonstrations.")
@click.option("--data", type=click.Path(path_type=Path), help="With --offline: another dataset than the run's own.")
@click.option("--json", "as_json", is_flag=True, help="Print the results as JSON, and no progress.")
def evaluate(
    runs: tuple[Path, ...],
    episodes: int,
    seeds: str,
    tasks: tuple[str, ...],
    execute: int | None,
    checkpoints: bool,
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
    scene. All meet the same layouts, none of which was demonstrated, so that they can be compared episode by episode;
    the outcome is the same for any number of workers. Every episode is kept in the run's folder as it ends: ended
    early, the same command does the rest, and more episodes add to those that are there.
    """
    if offline:
        given = {"--task": tasks, "--execute": execute, "--checkpoints": checkpoints, "--workers": workers,
                 "--films": films, "--out": out}  # fmt: skip
        if about_rollouts := [name for name, value in given.items() if value]:
            raise UsageError(f"--offline tries no episodes, so leave out {', '.join(about_rollouts)}")
        _offline(runs, data, as_json)
        return
    if data is not None:
        raise UsageError("--data is about held-out demonstrations; add --offline")
    from flowlab.benchmark.collect import collect
    from flowlab.evaluation import evaluate as work
    from flowlab.evaluation.trials import trials

    if checkpoints:
        subjects = [s for run in runs for s in work.find_checkpoints(run, execute)]
    else:
        subjects = [work.find_checkpoint(run, execute) for run in runs]
    chosen = work.choose_tasks(subjects, tasks)
    wanted = trials(chosen, numbers(seeds), episodes)
    workers = workers or len(os.sched_getaffinity(0))
    with ProgressBar(quiet=as_json) as bar:
        evaluations = work.evaluate(
            subjects,
            wanted,
            start_engine=work.local_engine(workers),
            workers=workers,
            device=device,
            report=lambda done, of: bar.update(done, of, "evaluating"),
        )
    results = collect(subjects, evaluations)
    films_made = _film(subjects, results, films, out) if films else []
    if out is not None:
        from flowlab.report.html import write_report

        write_report(out, results, films=films_made)
    if as_json:
        print_json([r.model_dump(mode="json", exclude_defaults=True) for r in results])
        return
    print_results(results)
    for path in films_made:
        click.echo(f"film: {path}")
    if out is not None:
        click.echo(f"{out / 'report.html'}, with report.json, report.csv and episodes.csv beside it")


def _film(
    subjects: Sequence["CheckpointRef"], results: Sequence["PolicyResult"], count: int, out: Path | None
) -> list[Path]:
    """Films and recordings of the first successes and failures of every policy and task."""
    from flowlab.evaluation.replay import film

    made = []
    for subject in {s.run: s for s in subjects}.values():  # of each run the newest checkpoint
        result = next(r for r in results if r.name == subject.run.name)
        for task in dict.fromkeys(o.task for o in result.final):
            for solved in (True, False):
                chosen = [o.trial for o in result.final if o.task == task and o.success == solved][:count]
                folder = (subject.episodes.parent if out is None else out) / "films"
                made += [film(subject, trial, folder) for trial in chosen]
    return made


def _offline(runs: Sequence[Path], data: Path | None, as_json: bool) -> None:
    from flowlab.evaluation.offline import demonstration_rows, evaluate_offline, offline_rows
    from flowlab.policies.checkpoint import load_policy

    reports = {run: evaluate_offline(load_policy(run), data) for run in runs}
    if as_json:
        print_json({str(run): report.model_dump(mode="json") for run, report in reports.items()})
        return
    for run, report in reports.items():
        print_table(*offline_rows(report), f"{run}: errors on demonstrations it was not trained on")
        print_table(*demonstration_rows(report), "every demonstration")


def numbers(text: str) -> list[int]:
    """Whole numbers from a list with commas."""
    parts = [p for p in text.replace(" ", "").split(",") if p]
    if not parts or not all(p.isdecimal() for p in parts):
        raise UsageError(f"--seeds {text}: must be whole numbers, as in --seeds 0,1,2")
    return [int(p) for p in parts]
