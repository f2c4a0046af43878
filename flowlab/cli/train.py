"""``flowlab train``."""

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from flowlab.cli.console import STEPS_LINE, ProgressBar, console, print_json, print_table, show_training
from flowlab.errors import UsageError

if TYPE_CHECKING:
    from flowlab.training.trainer import Trainer


@click.command()
@click.argument("source", type=click.Path(path_type=Path))
@click.option(
    "--policy", help="fdp (3D Flow Diffusion Policy), dp3 (3D Diffusion Policy) or mba (Motion Before Action)."
)
@click.option("--out", type=click.Path(path_type=Path), help="Folder of the run.")
@click.option("--profile", help="fast, paper, or a YAML file with all settings  [fast].")
@click.option("--minutes", type=click.FloatRange(min=0, min_open=True), help="Train as long as this; see --help's end.")
@click.option("--set", "overrides", multiple=True, metavar="KEY=VALUE", help="Change a setting: motion.points=50.")
@click.option("--seed", type=click.IntRange(min=0), help="Short for --set run.seed=...")
@click.option("--overfit", type=click.IntRange(min=1), metavar="N", help="Train on N demonstrations, and test on them.")
@click.option("--from", "began_from", type=click.Path(path_type=Path), help="Begin with the weights of this run.")
@click.option("--resume", is_flag=True, help="Go on with the run that SOURCE is.")
@click.option("--device", help="cpu, cuda or cuda:1  [a GPU if there is one].")
@click.option("--threads", type=click.IntRange(min=1), help="CPU threads of each process  [1].")
@click.option("--precision", type=click.Choice(["fp32", "bf16"]), help="[bf16 where the device has units for it].")
@click.option("--log", "logs", multiple=True, metavar="NAME", help="Also log to tensorboard or wandb.")
@click.option("--json", "as_json", is_flag=True, help="Print the result as JSON, and no progress.")
def train(
    source: Path,
    policy: str | None,
    out: Path | None,
    profile: str | None,
    minutes: float | None,
    overrides: tuple[str, ...],
    seed: int | None,
    overfit: int | None,
    began_from: Path | None,
    resume: bool,
    device: str | None,
    threads: int | None,
    precision: str | None,
    logs: tuple[str, ...],
    as_json: bool,
) -> None:
    """Train a policy on the dataset SOURCE.

    \b
      flowlab train data/push --policy fdp --out runs/push-fdp
      flowlab train data/push --policy dp3 --profile paper --out runs/push-dp3
      flowlab train runs/push-fdp --resume
      torchrun --nproc-per-node 4 -m flowlab train data/push --policy fdp --out runs/push-fdp

    SOURCE is what extract-sim or track-real made, or, for dp3, a store in DP3's layout.

    --minutes is CPU time of one thread, so that what else the machine does changes nothing; on a GPU it is time by
    the clock. The learning rate falls to zero within it.

    Ended early, a run goes on with --resume as if it had never stopped.
    """
    if resume:
        given = {"--policy": policy, "--out": out, "--profile": profile, "--minutes": minutes, "--set": overrides,
                 "--seed": seed, "--overfit": overfit, "--from": began_from}  # fmt: skip
        if changed := [name for name, value in given.items() if value not in (None, ())]:
            raise UsageError(f"--resume goes on as the run began, so leave out {', '.join(changed)}")
    elif policy is None or out is None:
        raise UsageError(
            f"say what to train and where to keep it, as in 'flowlab train {source} --policy fdp --out runs/fdp'; "
            "--resume goes on with a run"
        )
    from flowlab.policies.settings import load_settings
    from flowlab.training import run

    asked_for = {"device": device, "threads": threads, "precision": precision, "logs": logs or None}
    machine = {name: value for name, value in asked_for.items() if value is not None}
    if resume:
        trainer = run.resume_run(source, **machine)
    else:
        assert policy is not None
        assert out is not None
        changes = [f"run.minutes={minutes}", "run.steps=null"] if minutes else []
        changes += [f"run.seed={seed}"] if seed is not None else []
        settings = load_settings(profile or "fast", policy, [*overrides, *changes])
        trainer = run.prepare_run(
            source, out, settings, run.ComputeSettings(**machine), overfit=overfit, began_from=began_from
        )
    first = trainer.processes.is_first
    if first and not as_json:
        _describe(trainer)
    with ProgressBar(as_json or not first, STEPS_LINE) as bar, _stop_on_signal() as asked:
        finished = run.run(trainer, partial(show_training, bar), lambda: bool(asked))
    if first:
        _finish(trainer, finished, as_json)
    if not finished:
        sys.exit(130)


def _describe(trainer: "Trainer") -> None:
    """Say what was found and what will be done, before it takes long."""
    spec, run = trainer.policy.spec, trainer.run
    millions = sum(p.numel() for p in trainer.policy.parameters()) / 1e6
    console.print(
        f"{spec.settings.policy}, {millions:.1f} M weights, {run.steps - trainer.step:,} steps on "
        f"{len(run.train)} demonstrations of {', '.join(spec.tasks)}; {len(run.held_out)} held out; "
        f"{trainer.processes.description}",
        highlight=False,
        soft_wrap=True,
    )
    if spec.settings.encoder.relative and spec.channels.gripper is None:
        console.print(
            "points are given in the world frame: the data do not tell where in it the gripper is",
            highlight=False,
            soft_wrap=True,
        )


def _finish(trainer: "Trainer", finished: bool, as_json: bool) -> None:
    """Draw the curve, and print what came out."""
    from flowlab.policies.checkpoint import writing_run
    from flowlab.training.metrics import METRICS, last_metrics
    from flowlab.viz.training_figure import draw_training

    folder = trainer.folder
    metrics = folder / METRICS
    report: dict[str, Any] = {
        "run": str(folder),
        "policy": trainer.settings.policy,
        "step": trainer.step,
        "steps": trainer.run.steps,
        "finished": finished,
        "training": last_metrics(metrics, "train"),
        "validation": last_metrics(metrics, "validation"),
    }
    if report["training"] or report["validation"]:
        with writing_run(folder):
            draw_training(metrics, folder / "curve.png")
    if as_json:
        print_json(report)
        return
    if report["validation"]:
        print_table(
            ["on held-out demonstrations", "policy", "doing nothing", "going on as before"], _rows(report["validation"])
        )
    if not finished:
        click.echo(
            f"stopped at step {trainer.step} of {trainer.run.steps}; go on with: flowlab train {folder} --resume"
        )
    else:
        click.echo(f"{folder}: trained for {trainer.step} steps; the curve is {folder / 'curve.png'}")


def _rows(errors: dict[str, float]) -> list[list[object]]:
    """Each error beside the two that cost nothing."""
    names = [name for name in errors if not name.endswith(("_zero", "_hold", "_constant"))]
    return [
        [name, errors[name], errors[f"{name}_zero"], errors.get(f"{name}_hold", errors.get(f"{name}_constant", ""))]
        for name in names
    ]


@contextmanager
def _stop_on_signal() -> Iterator[list[int]]:
    """A list that holds a signal once one asked to stop; a second one stops at once."""
    asked: list[int] = []

    def ask(number: int, _: object) -> None:
        if asked:
            raise KeyboardInterrupt
        asked.append(number)

    before = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
