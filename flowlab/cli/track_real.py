"""``flowlab track-real``."""

import json
import os
import sys
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from flowlab.cli.console import ProgressBar, console, print_json
from flowlab.errors import DataError, UsageError

if TYPE_CHECKING:
    from flowlab.pipeline.labeling import CostEstimate
    from flowlab.pipeline.recipe import Recipe
    from flowlab.pipeline.units import JobShard
    from flowlab.storage.recorded import Recorded


@click.command("track-real")
@click.argument("paths", nargs=-1, required=True, metavar="PATH...", type=click.Path(path_type=Path))
@click.option("--out", type=click.Path(path_type=Path), help="Folder of the dataset; not needed for --dry-run.")
@click.option("--task", help="Task of all these recordings [what they say, or the name of their folder].")
@click.option("--tracker", help="Short for --set track.tracker=NAME [the recipe's: rigid-bodies].")
@click.option("--chunk", type=click.IntRange(min=1), help="Frames to a chunk [the recipe's: 33].")
@click.option("--stride", type=click.IntRange(min=1), help="Frames from one chunk to the next [the recipe's: 8].")
@click.option("--weights", type=click.Path(path_type=Path), help="File with a learned tracker's weights.")
@click.option("--reader", help="Short for --set recording.reader=NAME [the one that recognizes the recording].")
@click.option("--calibration", type=click.Path(path_type=Path), help="YAML file with calibration for all of them.")
@click.option("--recipe", default="real", show_default=True, help="A recipe's name, or a YAML file.")
@click.option("--set", "overrides", multiple=True, metavar="KEY=VALUE", help="Change a setting: queries.points=200.")
@click.option("--workers", type=click.IntRange(min=1), help="Processes [one for each core].")
@click.option("--shard", default="0/1", metavar="I/N", help="Do part I of N (from 0), for job arrays on one --out.")
@click.option("--dry-run", is_flag=True, help="Say what is recognized and how long it would take; write nothing.")
@click.option("--json", "as_json", is_flag=True, help="Print the result as JSON, and no progress.")
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
    shard: str,
    dry_run: bool,
    as_json: bool,
) -> None:
    """Make a dataset of every RGB-D recording at or below the given paths, with estimated 3D-flow labels.

    \b
      flowlab track-real recordings/pour --dry-run
      flowlab track-real recordings/pour --out data/pour
      flowlab track-real recordings --out data/all --tracker cotracker3 --chunk 33 --stride 8

    An existing dataset with the same settings is continued or extended; recordings that are new get new numbers.
    """
    sys.path.insert(0, os.getcwd())  # a recipe's own stages may lie beside it
    from flowlab.pipeline.labeling import find_jobs
    from flowlab.pipeline.recipe import load_recipe
    from flowlab.pipeline.units import JobShard

    short = {
        "track.tracker": tracker,
        "track.chunks.length": chunk,
        "track.chunks.stride": stride,
        "track.options.weights": weights,
        "recording.reader": reader,
        "recording.calibration": calibration,
    }
    changes = [f"{key}={json.dumps(str(v) if isinstance(v, Path) else v)}" for key, v in short.items() if v is not None]
    chosen = load_recipe(recipe, [*overrides, *changes])
    share, workers = JobShard.parse(shard), workers or len(os.sched_getaffinity(0))
    if out is None and not dry_run:
        raise UsageError("name the folder of the dataset, as in --out data/pour; or look first with --dry-run")
    recordings = find_jobs(chosen, paths, task)
    if out is None or dry_run:
        _dry_run(chosen, recordings, workers, as_json)
    else:
        _label(chosen, recordings, out, share, workers, as_json)


def _label(
    recipe: "Recipe", recordings: "tuple[Recorded, ...]", out: Path, share: "JobShard", workers: int, as_json: bool
) -> None:
    from flowlab.cli.reports import extraction_report, print_extraction
    from flowlab.engines.local import LocalEngine
    from flowlab.pipeline.labeling import label_recordings
    from flowlab.pipeline.scheduling import ExtractionProgress

    start = time.monotonic()
    engine = partial(LocalEngine, workers=workers, imports=["flowlab.pipeline.stages.recording"])
    with ProgressBar(quiet=as_json) as bar:

        def show(progress: ExtractionProgress) -> None:
            note = f"labeling ({progress.rejected} rejected)" if progress.rejected else "labeling"
            bar.update(progress.accepted + progress.rejected, progress.wanted, note)

        dataset = label_recordings(recipe, recordings, out, start_engine=engine, share=share, report=show)
    report = extraction_report(dataset, time.monotonic() - start)
    if as_json:
        print_json(report)
        return
    print_extraction(report)
    if dataset.missing and share.count > 1:
        console.print("the rest belongs to the other shards", highlight=False)


def _dry_run(recipe: "Recipe", recordings: "tuple[Recorded, ...]", workers: int, as_json: bool) -> None:
    """Say what is recognized of every recording, and how long labeling would take."""
    from flowlab.cli.inspected import facts_of, lines_of
    from flowlab.pipeline.labeling import estimate_cost, inspect_recording

    rows: list[dict[str, Any]] = []
    for one in recordings:
        rows.append({"recording": one.source, "task": one.task} | facts_of(inspect_recording(recipe, one)))
        if not as_json:
            click.echo("\n".join(lines_of(rows[-1])))
    plan = _plan(estimate_cost(recipe, recordings), rows, workers)
    if as_json:
        print_json({"recordings": rows} | plan)
    else:
        for name, value in plan.items():
            click.echo(f"{name.replace('_', ' '):<18} {value}")
    problems = sum(row["problem"] is not None for row in rows)
    if problems:
        raise DataError(f"{problems} of {len(rows)} recordings cannot be used as they are; see above")


def _plan(cost: "CostEstimate", rows: list[dict[str, Any]], workers: int) -> dict[str, Any]:
    """How long labeling what can be labeled would take."""
    frames = sum(row["rows"] for row in rows if row["problem"] is None)
    seconds = cost.cpu_s_per_frame
    return {
        "frames": frames,
        "cpu_ms_per_frame": None if seconds is None else round(1e3 * seconds, 1),
        "workers": workers,
        "estimated_minutes": None if seconds is None else round(frames * seconds / workers / 60, 2),
        "estimate": cost.basis,
    }
