"""``flowlab track-real``."""

import json
import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from flowlab.cli.console import ProgressBar, echo, json_option, print_json, quiet_option, say, show_extraction
from flowlab.cli.paths import PATH
from flowlab.cli.values import PluginName, engine_option
from flowlab.errors import DataError, UsageError
from flowlab.registry import READERS, TRACKERS
from flowlab.text import counted

if TYPE_CHECKING:
    from flowlab.pipeline.recipe import Recipe


@click.command("track-real")
@click.argument("paths", nargs=-1, required=True, metavar="PATH...", type=PATH)
@click.option("--out", type=PATH, help="Folder of the dataset; not needed for --dry-run.")
@click.option("--task", help="Task of all these recordings [what they say, or the name of their folder].")
@click.option(
    "--tracker", type=PluginName(TRACKERS), help="Short for --set track.tracker=NAME [the recipe's: rigid-bodies]."
)
@click.option("--chunk", type=click.IntRange(min=1), help="Frames to a chunk [the recipe's: 33].")
@click.option("--stride", type=click.IntRange(min=1), help="Frames from one chunk to the next [the recipe's: 8].")
@click.option("--weights", type=PATH, help="File with a learned tracker's weights.")
@click.option(
    "--reader",
    type=PluginName(READERS),
    help="Short for --set recording.reader=NAME [the one that recognizes the recording].",
)
@click.option("--calibration", type=PATH, help="YAML file with calibration for all of them.")
@click.option("--recipe", default="real", show_default=True, help="A recipe's name, or a YAML file.")
@click.option("--set", "overrides", multiple=True, metavar="KEY=VALUE", help="Change a setting: queries.points=200.")
@click.option("--workers", type=click.IntRange(min=1), help="Processes [one for each core].")
@engine_option
@click.option("--shard", default="0/1", metavar="I/N", help="Do part I of N (from 0), for job arrays on one --out.")
@click.option("--repair", is_flag=True, help="Read all that is there, and make again what is damaged.")
@click.option("--dry-run", is_flag=True, help="Say what is recognized; write nothing.")
@click.option("--png", type=PATH, help="With --dry-run: draw a sheet of each recording here, to look at.")
@click.option("--estimate", is_flag=True, help="With --dry-run: label some frames to tell how long all would take.")
@quiet_option
@json_option
def track_real(
    paths: tuple[Path, ...],
    out: Path | None,
    task: str | None,
    tracker: str | None,
    chunk: int | None,
    stride: int | None,
    weights: Path | None,
    reader: str | None,
    calibration: Path | None,
    recipe: str,
    overrides: tuple[str, ...],
    workers: int | None,
    engine: str,
    shard: str,
    repair: bool,
    dry_run: bool,
    png: Path | None,
    estimate: bool,
    as_json: bool,
) -> None:
    """Make a dataset of every RGB-D recording at or below the given paths, with estimated 3D-flow labels.

    \b
      flowlab track-real recordings/pour --dry-run --png sheet.png
      flowlab track-real recordings/pour --out data/pour
      flowlab track-real recordings --out data/all --tracker cotracker3 --chunk 33 --stride 8

    The sheet that --png draws has pictures with edges of depth over them, the cloud from above, all streams over time,
    and what was checked; of several recordings each has its own, SHEET-TASK-NAME.png.

    An existing dataset with the same settings is continued or extended; recordings that are new get new numbers.
    """
    from flowlab.pipeline.units import JobShard

    short = {"track.chunks.length": chunk, "track.chunks.stride": stride, "recording.reader": reader}
    changes = [*overrides, *(f"{key}={json.dumps(value)}" for key, value in short.items() if value is not None)]
    share = JobShard.parse(shard)
    if out is None and not dry_run:
        raise UsageError("name the folder of the dataset, as in --out data/pour; or look first with --dry-run")
    if png is not None and not dry_run:
        raise UsageError("--png is about what is recognized; add --dry-run")
    known: dict[str, Any] = {"tracker": tracker, "calibration": calibration, "weights": weights}
    if out is None or dry_run:
        _dry_run(paths, task, workers, as_json, estimate, png, recipe=recipe, settings=changes, **known)
        return
    from flowlab.cli.reports import finish_extraction
    from flowlab.pipeline.labeling import label, labeling_recipe

    start = time.monotonic()
    _say_if_compiling(labeling_recipe(recipe, changes, **known))
    with ProgressBar() as bar:
        dataset = label(
            paths, out, task=task, tracker=tracker, calibration=calibration, weights=weights, recipe=recipe,
            settings=changes, engine=engine, workers=workers, shard=share,
            repair=repair, on_progress=lambda progress: show_extraction(bar, progress, "labeling", count_rejects=True),
        )  # fmt: skip
    finish_extraction(dataset, time.monotonic() - start, share, as_json)


def _say_if_compiling(recipe: "Recipe") -> None:
    """Tell why the first labeling on a machine takes longer to begin."""
    from flowlab.pipeline.compilation import NOTICE, will_compile

    if will_compile(recipe):
        say(f"flowlab: {NOTICE}")


def _dry_run(
    paths: tuple[Path, ...],
    task: str | None,
    workers: int | None,
    as_json: bool,
    estimate: bool,
    png: Path | None,
    **recipe: Any,
) -> None:
    """Say what is recognized of every recording, draw it, and if asked tell how long labeling would take."""
    from flowlab.cli.inspected import draw_sheet, facts_of, lines_of, sheet_paths
    from flowlab.pipeline.inspection import estimate_labeling, frame_count, inspect_recordings, workspace
    from flowlab.pipeline.labeling import find_jobs, labeling_recipe

    chosen = labeling_recipe(**recipe)
    jobs = find_jobs(chosen, paths, task)
    sheets = {} if png is None else sheet_paths(png, jobs)
    inspected, facts = [], []
    for one in inspect_recordings(chosen, jobs, previews=png is not None):
        inspected.append(replace(one, preview=None))
        facts.append(facts_of(one))
        if sheet := sheets.get(one.recorded):
            draw_sheet(one, sheet, workspace(chosen, one.recorded.task))
            facts[-1]["sheet"] = str(sheet)
        if not as_json:
            echo(*lines_of(facts[-1]))
    if estimate:
        _say_if_compiling(chosen)
    plan = asdict(estimate_labeling(chosen, inspected, workers)) if estimate else {"frames": frame_count(inspected)}
    if as_json:
        print_json({"recordings": facts} | plan)
    else:
        for name, value in plan.items():
            echo(f"{name.replace('_', ' '):<18} {value}")
    problems = sum(one.problem is not None for one in inspected)
    if problems:
        raise DataError(f"{problems} of {counted(len(inspected), 'recording')} cannot be used as they are; see above")
