"""``flowlab train``."""

import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from flowlab.cli.console import (
    STEPS_LINE,
    ProgressBar,
    echo,
    json_option,
    print_json,
    print_table,
    quiet_option,
    say,
    show_training,
)
from flowlab.cli.heartbeat import be_quiet
from flowlab.cli.paths import PATH, PATH_OR_HUB
from flowlab.cli.values import Names, PluginName, flat, installed
from flowlab.errors import UsageError
from flowlab.registry import LOGGERS, POLICIES, Registry

if TYPE_CHECKING:
    from flowlab.training.precision import Precision
    from flowlab.training.train import TrainedRun


class PluginOption(click.Option):
    """An option whose value is a name of a registry: its help lists those that are installed."""

    def __init__(self, *declarations: Any, registry: Registry[Any], **attributes: Any) -> None:
        super().__init__(*declarations, **({"type": PluginName(registry)} | attributes))
        self._registry = registry

    def get_help_record(self, ctx: click.Context) -> tuple[str, str] | None:
        """The option as ``--help`` shows it."""
        record = super().get_help_record(ctx)
        names = ", ".join(self._registry.plugins())
        return record and (record[0], f"{record[1]} There are: {names}; or module:Class.")


@click.command()
@click.argument("sources", type=PATH_OR_HUB, nargs=-1, required=True, metavar="SOURCE...")
@click.option(
    "--weights", metavar="W,W,...", help="Of several datasets, the share of windows that each has: 0.7,0.3 or 7,3."
)
@click.option("--policy", cls=PluginOption, registry=POLICIES, help="What to train.")
@click.option("--out", type=PATH, help="Folder of the run.")
@click.option("--profile", help="fast, paper, or a YAML file with the settings that differ  [fast].")
@click.option("--minutes", type=click.FloatRange(min=0, min_open=True), help="Train as long as this; see --help's end.")
@click.option("--set", "overrides", multiple=True, metavar="KEY=VALUE", help="Change a setting: motion.points=50.")
@click.option("--seed", type=click.IntRange(min=0), help="Short for --set run.seed=...")
@click.option("--overfit", type=click.IntRange(min=1), metavar="N", help="Train on N demonstrations, and test on them.")
@click.option("--from", "began_from", type=PATH, help="Begin with the weights of this run.")
@click.option("--resume", is_flag=True, help="Go on with the run that SOURCE is.")
@click.option("--device", help="cpu, cuda or cuda:1  [a GPU if there is one].")
@click.option("--threads", type=click.IntRange(min=1), help="CPU threads of each process  [1].")
@click.option("--precision", type=click.Choice(["fp32", "bf16"]), help="[bf16 where the device has units for it].")
@click.option(
    "--log", "logs", cls=PluginOption, registry=LOGGERS, type=Names(installed(LOGGERS)), callback=flat, multiple=True,
    metavar="NAME,...", help="Also log there.",
)  # fmt: skip
@quiet_option
@json_option
def train(
    sources: tuple[Path, ...],
    weights: str | None,
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
    precision: "Precision | None",
    logs: tuple[str, ...],
    as_json: bool,
) -> None:
    """Train a policy on the dataset SOURCE, or on several.

    \b
      flowlab train data/push --policy fdp --out runs/push-fdp
      flowlab train data/push --policy dp3 --profile paper --out runs/push-dp3
      flowlab train data/push data/films-labeled --policy dp3 --out runs/push-all
      flowlab train data/push data/films-labeled --weights 0.7,0.3 --policy dp3 --out runs/push-all
      flowlab train hub:user/pour@1.0 --policy fdp --out runs/pour-fdp
      flowlab train runs/push-fdp --resume
      torchrun --nproc-per-node 4 -m flowlab train data/push --policy fdp --out runs/push-fdp

    SOURCE is what extract-sim, track-real or label-actions made, or, for dp3, a store in DP3's layout. Several datasets
    must say the same of their frame, their camera, and what their numbers mean. hub:user/name is a dataset on the
    Hugging Face Hub, which is pulled into the cache first; 'flowlab hub pull' does it without training.

    All windows of several datasets are drawn alike, so that the larger ones have more of them; with --weights each
    dataset has its share, whatever its size. The numbers are in the order of the datasets, and need not add up to 1.

    --minutes is CPU time of one thread, so that what else the machine does changes nothing; on a GPU it is time by
    the clock. The learning rate falls to zero within it.

    Ended early, a run goes on as if it had never stopped: by the same command, or with --resume.
    """
    if resume:
        given = {"--policy": policy, "--out": out, "--profile": profile, "--minutes": minutes, "--set": overrides,
                 "--seed": seed, "--overfit": overfit, "--from": began_from, "--weights": weights}  # fmt: skip
        if changed := [name for name, value in given.items() if value not in (None, ())]:
            raise UsageError(f"--resume goes on as the run began, so leave out {', '.join(changed)}")
        if len(sources) > 1:
            raise UsageError(
                f"--resume goes on with one run, and {len(sources)} folders are given; give the run's alone"
            )
    elif policy is None or out is None:
        raise UsageError(
            f"say what to train and where to save it, as in 'flowlab train {sources[0]} --policy fdp --out runs/fdp'; "
            "--resume goes on with a run"
        )
    else:
        from flowlab.training.request import check_request

        timed = minutes is not None
        check_request(sources, policy=policy, profile=profile or "fast", settings=overrides, timed=timed, logs=logs)
    from flowlab.training import train as training
    from flowlab.training.distributed import is_first_process

    first = is_first_process()
    if not first:
        be_quiet()
    with ProgressBar(STEPS_LINE) as bar, training.stop_on_signal() as should_stop:
        watch = training.Watch(say, partial(show_training, bar), should_stop)
        if resume:
            done = training.resume(
                sources[0], device=device, threads=threads, precision=precision, logs=logs or None, watch=watch
            )
        else:
            assert policy is not None
            assert out is not None
            done = training.train(
                sources, out, policy=policy, profile=profile or "fast", minutes=minutes, settings=overrides, seed=seed,
                overfit=overfit, began_from=began_from, device=device or "auto", threads=threads or 1,
                precision=precision or "auto", logs=logs, watch=watch, weights=_numbers(weights),
            )  # fmt: skip
    if first:
        _print(done, as_json)
    if not done.finished:
        sys.exit(130)


def _numbers(text: str | None) -> list[float] | None:
    """Numbers with commas between them."""
    if text is None:
        return None
    try:
        return [float(word) for word in text.split(",")]
    except ValueError as error:
        raise UsageError(f"--weights {text}: must be numbers with commas between them, as in 0.7,0.3") from error


def _print(done: "TrainedRun", as_json: bool) -> None:
    """What came out."""
    if as_json:
        print_json(done.to_json())
        return
    if done.validation:
        print_table(
            ["on held-out demonstrations", "policy", "doing nothing", "going on as before"], _rows(done.validation)
        )
    if done.finished:
        echo(f"{done.folder}: trained for {done.step} steps; the curve is {done.curve}")
    else:
        echo(f"stopped at step {done.step} of {done.steps}; go on with: flowlab train {done.folder} --resume")


def _rows(errors: dict[str, float]) -> list[list[object]]:
    """Each error beside the two that cost nothing."""
    names = [name for name in errors if not name.endswith(("_zero", "_hold", "_constant"))]
    return [
        [name, errors[name], errors[f"{name}_zero"], errors.get(f"{name}_hold", errors.get(f"{name}_constant", ""))]
        for name in names
    ]
