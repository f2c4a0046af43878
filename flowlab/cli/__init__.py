"""The command line. Commands are imported when they are called, so that help is instant."""

import importlib
import io
import os
import sys
from typing import Any

import click

from flowlab.errors import FlowlabError, UsageError
from flowlab.text import printable
from flowlab.version import __version__

_COMMANDS = {
    "tasks": ("flowlab.cli.tasks:tasks", "List MetaWorld's 50 tasks."),
    "extract-sim": ("flowlab.cli.extract_sim:extract_sim", "Make a 3D-flow dataset of simulated demonstrations."),
    "track-real": ("flowlab.cli.track_real:track_real", "Make a 3D-flow dataset of RGB-D recordings of a robot."),
    "label-actions": (
        "flowlab.cli.label_actions:label_actions",
        "Infer the actions of films from how the robot moves.",
    ),
    "train": ("flowlab.cli.train:train", "Train a policy on a dataset: 3D FDP, DP3 or MBA."),
    "eval": ("flowlab.cli.evaluate:evaluate", "Let policies act in simulation, and count how often they succeed."),
    "serve": ("flowlab.cli.serve:serve", "Serve a policy to a robot on another machine."),
    "bench": ("flowlab.cli.bench:bench", "Run an experiment: extract, train, evaluate, report."),
    "report": ("flowlab.cli.report:report", "Write a report of evaluations, beside the paper's numbers."),
    "grade": ("flowlab.cli.grade:grade", "Measure the error of estimated tracks against known ones."),
    "info": ("flowlab.cli.datasets:info", "Describe a dataset, or a training run."),
    "validate": ("flowlab.cli.datasets:validate", "Check a dataset, a run or an experiment."),
    "viz": ("flowlab.cli.viz:viz", "Draw an episode: a Rerun recording, a film or a PNG."),
    "merge": ("flowlab.cli.selection:merge", "Make one dataset of several."),
    "subset": ("flowlab.cli.selection:subset", "Make a dataset of some tasks or episodes of another one."),
    "split": ("flowlab.cli.selection:split", "Make two datasets of one, to train and to validate on."),
    "hub": ("flowlab.cli.hub:hub", "Share datasets and policies on the Hugging Face Hub: push, pull."),
    "export": ("flowlab.cli.datasets:export", "Write a dataset in another tool's layout."),
    "doctor": ("flowlab.cli.doctor:doctor", "Say what this machine has of what flowlab can use."),
    "plugins": ("flowlab.cli.plugins:plugins", "List trackers, readers, stages, policies and more, and from where."),
}


class _Commands(click.Group):
    """A group that imports a command only to run it or to show its own help."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(_COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in _COMMANDS:
            return None
        module, _, attribute = _COMMANDS[cmd_name][0].partition(":")
        command: click.Command = getattr(importlib.import_module(module), attribute)
        return command

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command that was asked for, which is never silent for long."""
        from flowlab.cli.console import show
        from flowlab.cli.heartbeat import beating

        with beating(ctx, show):
            return super().invoke(ctx)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        if args and args[0] not in _COMMANDS and not args[0].startswith("-"):
            from flowlab.errors import unknown_name

            ctx.fail(str(unknown_name("command", args[0], _COMMANDS)))
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl([(name, about) for name, (_, about) in _COMMANDS.items()])


@click.group(
    cls=_Commands,
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog="Exit codes: 0 done; 1 failed; 2 wrong usage; 3 data invalid; 4 some units failed; 130 interrupted. "
    "What ended early, for whatever reason, goes on when the same command is given again.",
)
@click.version_option(__version__)
def cli() -> None:
    """3D-flow datasets from robot demonstrations, and policies trained on them."""


def _check_folder() -> None:
    """Libraries take settings from such files wherever one works, and with them code to run or a picture's look."""
    for name in ("matplotlibrc", ".numba_config.yaml"):
        if os.path.lexists(name):
            raise UsageError(f"{name}: libraries would take settings from it; delete it or work in another folder")


def main(*args: Any) -> None:
    """Run the command line; every foreseen error is one sentence and an exit code."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # what a terminal cannot show is escaped
    asked = os.environ.get("PYTHONSAFEPATH")
    os.environ["PYTHONSAFEPATH"] = "1"  # of Pythons that libraries start: nothing of the current folder is imported
    try:
        _check_folder()
        cli.main(list(args) or None, prog_name="flowlab", standalone_mode=False)
    except click.exceptions.Exit as end:
        sys.exit(end.exit_code)
    except click.ClickException as error:
        text = io.StringIO()
        error.show(text)
        click.echo(printable(text.getvalue()), err=True, nl=False)
        sys.exit(error.exit_code)
    except FlowlabError as error:
        click.echo(f"flowlab: {error}", err=True)
        sys.exit(error.exit_code)
    except (KeyboardInterrupt, click.Abort):
        click.echo("\nflowlab: interrupted; what was finished is kept, the same command does the rest", err=True)
        sys.exit(130)
    finally:
        if asked is None:
            del os.environ["PYTHONSAFEPATH"]
