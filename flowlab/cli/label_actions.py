"""``flowlab label-actions``."""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from flowlab.cli.console import ProgressBar, echo, json_option, print_table, quiet_option, show_extraction
from flowlab.cli.paths import PATH
from flowlab.cli.values import engine_option
from flowlab.provenance import Channels, Inferred, Provenance
from flowlab.text import counted


@click.command("label-actions")
@click.argument("films", type=PATH)
@click.option("--from", "labeled", type=PATH, required=True, help="Dataset of demonstrations with state and actions.")
@click.option("--out", type=PATH, required=True, help="Folder of the new dataset.")
@click.option("--set", "overrides", multiple=True, metavar="KEY=VALUE", help="Change a setting: max_position_m=0.01.")
@click.option("--workers", type=click.IntRange(min=1), help="Processes [one for each core].")
@engine_option
@click.option("--shard", default="0/1", metavar="I/N", help="Do part I of N (from 0), for job arrays on one --out.")
@click.option("--repair", is_flag=True, help="Read all that is there, and make again what is damaged.")
@quiet_option
@json_option
def label_actions(
    films: Path,
    labeled: Path,
    out: Path,
    overrides: tuple[str, ...],
    workers: int | None,
    engine: str,
    shard: str,
    repair: bool,
    as_json: bool,
) -> None:
    """Infer the actions of FILMS, and their state where they have none, from how the gripper moves.

    \b
      flowlab label-actions data/films --from data/pour --out data/films-labeled
      flowlab train data/pour data/films-labeled --policy dp3 --out runs/pour

    FILMS is a dataset whose episodes have no actions, as of recordings without a robot's log. A few demonstrations of
    the same task, robot and camera, at least two, teach what the gripper looks like and which action makes it move how.
    Each inferred number states its error, which training weighs it by; films that are too uncertain are kept out.
    """
    from flowlab.actions.labeling import label_actions as label
    from flowlab.cli.reports import finish_extraction
    from flowlab.pipeline.units import JobShard

    start, share = time.monotonic(), JobShard.parse(shard)
    with ProgressBar() as bar:
        dataset = label(
            films, labeled, out, settings=overrides, engine=engine, workers=workers, shard=share, repair=repair,
            on_progress=lambda progress: show_extraction(bar, progress, "labeling", count_rejects=True),
        )  # fmt: skip
    if not as_json and dataset.provenance.inferred is not None:
        print_inferred(dataset.provenance, dataset.provenance.inferred)
    finish_extraction(dataset, time.monotonic() - start, share, as_json)


def print_inferred(provenance: Provenance, inferred: Inferred) -> None:
    """What was inferred, from what, and how far off it was on demonstrations that were left out."""
    for task, count in inferred.demonstrations.items():
        echo(
            f"{' and '.join(inferred.what)} of {task}: inferred by what {counted(count, 'demonstration')} of "
            f"{inferred.labeled} taught ({inferred.method}); on demonstrations left out:"
        )
        rows = [
            [f"{e.array}[{e.index}]", _name(getattr(provenance, e.array), e.index), f"{e.mean_error:.3g}",
             f"{e.varies:.3g}", f"{e.within_sigma:.0%}"]
            for e in inferred.left_out.get(task, ())
        ]  # fmt: skip
        print_table(["number", "is", "mean error", "varies by", "within 1 σ"], rows)


def _name(channels: Sequence[Channels] | None, index: int) -> str:
    """What a number is called, with its unit; empty where nobody said."""
    for c in channels or ():
        if index in c.index:
            axis: Any = " xyz"[1 + c.index.index(index)] if len(c.index) == 3 else ""
            return f"{c.name} {axis}".strip() + (f" [{c.unit}]" if c.unit else "")
    return ""
