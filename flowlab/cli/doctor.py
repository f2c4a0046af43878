"""``flowlab doctor``."""

import sys
from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING

import click

from flowlab.cli.console import echo, json_option, print_json

if TYPE_CHECKING:
    from flowlab.diagnosis.record import Diagnosis

_MARKS = {"ok": " ", "note": "-", "problem": "!"}


@click.command()
@json_option
def doctor(as_json: bool) -> None:
    """Say what this machine has of what flowlab can use, and what to do where something is missing.

    Versions, libraries, extras, memory, GPU, OpenGL and EGL devices, caches, plug-ins, licenses of trackers. Nothing is
    changed, downloaded or sent: put the output into a bug report. Lines with - are about what not everybody needs;
    with ! about what flowlab cannot do without: then it exits with 1.
    """
    from flowlab.diagnosis.examine import examine

    found = list(examine())
    if as_json:
        print_json([asdict(diagnosis) for diagnosis in found])
    else:
        _show(found)
    if any(diagnosis.verdict == "problem" for diagnosis in found):
        sys.exit(1)


def _show(found: "Sequence[Diagnosis]") -> None:
    """A line for each, below the name of its topic; what to do below that."""
    for k, diagnosis in enumerate(found):
        if k == 0 or diagnosis.topic != found[k - 1].topic:
            echo(f"{diagnosis.topic}:")
        echo(f"{_MARKS[diagnosis.verdict]} {diagnosis.name}: {diagnosis.found}")
        if diagnosis.remedy:
            echo(f"    {diagnosis.remedy}")
