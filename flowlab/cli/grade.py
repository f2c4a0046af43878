"""``flowlab grade``."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click
from pydantic import ValidationError

from flowlab.cli.console import echo, json_option, print_json, print_table, quiet_option, say
from flowlab.cli.paths import PATH
from flowlab.cli.values import engine_option, installed, names_option, tasks_and_groups
from flowlab.errors import UsageError
from flowlab.registry import TRACKERS

if TYPE_CHECKING:
    from flowlab.grading.grade import RecordingGrade, TrackerGrade
    from flowlab.grading.metrics import TrackErrors, TrackMetrics
    from flowlab.tracking.chunking import ChunkSettings


_FAMILIES = "tabletop, hands, clutter, thin, plain, flat, rolling, swarm, large, kitchen, articulated"
"""A test holds it to the families there are."""

_CAMERAS = ["fixed", "hand-held", "hand-held, poses known", "traveling", "traveling, poses known"]

_ABOUT_SUMMARY = (
    "TAPVid-3D without rescaling; stated error σ; wrong: seen, above 20 mm and above 4 σ; CPU time per frame"
)


@click.command()
@click.argument("recordings", nargs=-1, metavar="[RECORDING]...", type=PATH)
@names_option(
    "--tracker",
    "names",
    known=installed(TRACKERS),
    default=["rigid-bodies"],
    help="What labels  [rigid-bodies].",
)
@names_option("--tasks", "--task", "tasks", known=tasks_and_groups, help="Simulate recordings of these tasks.")
@names_option(
    "--scenes",
    known=lambda: _FAMILIES.split(", "),
    metavar="FAMILY,...",
    help=f"Film procedural scenes: {_FAMILIES}, or all.",
)
@click.option(
    "--episodes", type=click.IntRange(min=1), default=1, show_default=True, help="Recordings of each task and family."
)
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Of the first recording.")
@click.option(
    "--sensor",
    type=click.Choice(["kinect", "stereo", "tof", "clean"]),
    help="What the simulated camera errs like  [of tasks: kinect; of scenes: by their seed]",
)
@click.option("--size", metavar="WxH", help="Of simulated pictures [px]  [of tasks: 320x240; of scenes: by their seed]")
@click.option(
    "--camera",
    type=click.Choice(_CAMERAS),
    help="How the camera of films moves  [by their seed: fixed or hand-held]",
)
@click.option("--set", "changes", multiple=True, metavar="[TRACKER.]KEY=VALUE", help="Change a tracker's option.")
@click.option("--weights", type=PATH, help="File of a learned tracker's weights.")
@click.option("--chunk", type=click.IntRange(min=2), help="Frames tracked at a time.")
@click.option("--stride", type=click.IntRange(min=1), help="Frames from one chunk to the next.")
@engine_option
@click.option("--workers", type=click.IntRange(min=1), help="Recordings at a time  [one for each core].")
@click.option("--out", type=PATH, default=Path("grade"), show_default=True, help="Folder to write.")
@quiet_option
@json_option
def grade(
    recordings: tuple[Path, ...],
    names: tuple[str, ...],
    tasks: tuple[str, ...],
    scenes: tuple[str, ...],
    episodes: int,
    seed: int,
    sensor: str | None,
    size: str | None,
    camera: str | None,
    changes: tuple[str, ...],
    weights: Path | None,
    chunk: int | None,
    stride: int | None,
    engine: str,
    workers: int | None,
    out: Path,
    as_json: bool,
) -> None:
    """Label recordings whose truth is known, without looking at it, and say how far off the labels are.

    \b
      flowlab grade --tracker rigid-bodies --tasks hammer,door-open
      flowlab grade --scenes tabletop,hands --episodes 6 --seed 1000
      flowlab grade rec/sample --tracker rigid-bodies,lucas-kanade --out graded

    A RECORDING is a folder with a ground_truth.npz, or holds such folders. With --tasks, MetaWorld's experts
    are recorded by a simulated depth camera, with --scenes, things that move on a table are filmed; the recordings
    are kept in OUT/recordings, and used again by the next run with the same settings. OUT/grade.json and
    OUT/grade.png are written; the picture says what was graded, with which sensor, and by which trackers.
    """
    from flowlab.grading.run import REPORT
    from flowlab.grading.run import grade as run_grading
    from flowlab.sim.tasks import tasks_named

    report = run_grading(
        recordings,
        out,
        trackers=names,
        tasks=tasks_named(tasks),
        scenes=scenes,
        episodes=episodes,
        seed=seed,
        sensor=sensor,
        size=None if size is None else _size(size),
        camera=camera,
        settings=changes,
        weights=weights,
        chunks=_chunk_settings(chunk, stride),
        engine=engine,
        workers=workers,
        on_progress=say,
    )
    from flowlab.viz.grade_figure import draw_grades

    picture = out / "grade.png"
    draw_grades({t.name: t.mean for t in report.trackers}, picture, graded=report.graded, about=report.about)
    if as_json:
        print_json(report.to_json())
        return
    _print(report.trackers)
    echo(f"{out / REPORT} and {picture}")


def _size(text: str) -> tuple[int, int]:
    """Width and height of ``320x240``."""
    width, times, height = text.partition("x")
    if not (times and width.isdecimal() and height.isdecimal() and int(width) > 0 and int(height) > 0):
        raise UsageError(f"--size {text}: must look like 320x240")
    return int(width), int(height)


def _chunk_settings(chunk: int | None, stride: int | None) -> "ChunkSettings":
    """The defaults, but for what is asked for."""
    from flowlab.tracking.chunking import ChunkSettings

    asked = {"length": chunk, "stride": stride}
    try:
        return ChunkSettings.model_validate({k: v for k, v in asked.items() if v is not None})
    except ValidationError as error:
        raise UsageError(f"--chunk, --stride: {error.errors()[0]['msg'].removeprefix('Value error, ')}") from error


def _print(results: Sequence["TrackerGrade"]) -> None:
    """Means over the recordings, trackers below each other; then every recording."""
    groups = {"visible": "all", "moved": "moving", "objects": "object", "hidden": "occluded"}
    errors = [
        [label, r.name, *_error_figures(getattr(r.mean, group))]
        for label, group in groups.items()
        for r in results
        if getattr(r.mean, group) is not None
    ]
    columns = ["points", "tracker", "median", "p95", "< 5", "< 10", "< 20", "< 40"]
    print_table(columns, errors, "error in mm and share within limits, mean over recordings")
    columns = ["tracker", "3D-AJ", "APD", "OA", "kept", "< 1 σ", "< 2 σ", "rank σ", "wrong", "ms"]
    print_table(columns, [_summary(r) for r in results], _ABOUT_SUMMARY)
    scenes = [[scene, r.name, *_scene_figures(mean)] for r in results for scene, mean in r.by_scene().items()]
    if scenes:
        columns = ["scenes", "tracker", "moved mm", "< 20", "APD", "OA", "< 1 σ", "rank σ", "wrong"]
        print_table(columns, sorted(scenes, key=lambda row: str(row[0])), "by family of scenes, or task")
    columns = ["recording", "tracker", "all mm", "moved mm", "< 20", "APD", "3D-AJ"]
    print_table(columns, [_row(r.name, row) for r in results for row in r.rows], "every recording")
    left_out = {row.recording: row.unusable_queries for row in results[0].rows if row.unusable_queries}
    if left_out:
        each = ", ".join(f"{name} {n}" for name, n in left_out.items())
        echo(f"not graded, because the sensor's first depth there is not that of the surface: {each} queries")


def _error_figures(errors: "TrackErrors") -> list[object]:
    """Errors in mm and shares, rounded for a table."""
    shares = errors.within_5mm, errors.within_10mm, errors.within_20mm, errors.within_40mm
    return [round(errors.median_mm, 1), round(errors.p95_mm, 1), *(round(s, 2) for s in shares)]


def _summary(grades: "TrackerGrade") -> list[object]:
    """A tracker's row in the table of TAPVid-3D's figures and stated errors."""
    t, c = grades.mean.tapvid, grades.mean.calibration
    sigma = ["-"] * 3 if c is None else [_share(x) for x in (c.within_1_sigma, c.within_2_sigma, c.rank_correlation)]
    figures = [_share(x) for x in (t.average_jaccard, t.apd, t.occlusion_accuracy, grades.mean.survival)]
    return [grades.name, *figures, *sigma, _percent(grades.mean.confidently_wrong), round(grades.ms_per_frame, 1)]


def _scene_figures(mean: "TrackMetrics") -> list[object]:
    """A family's row."""
    c, moved = mean.calibration, ["-", "-"]
    if mean.moving is not None:
        moved = [f"{mean.moving.median_mm:.1f}", f"{mean.moving.within_20mm:.2f}"]
    stated = ["-", "-"] if c is None else [_share(c.within_1_sigma), _share(c.rank_correlation)]
    figures = [_share(mean.tapvid.apd), _share(mean.tapvid.occlusion_accuracy)]
    return [*moved, *figures, *stated, _percent(mean.confidently_wrong)]


def _percent(share: float | None) -> str:
    """A share in percent; a dash where there is none."""
    return "-" if share is None or share != share else f"{share:.2%}"


def _row(tracker: str, grade: "RecordingGrade") -> list[object]:
    """A recording's row."""
    m, t = grade.metrics, grade.metrics.tapvid
    visible = "-" if m.all is None else round(m.all.median_mm, 1)
    moved = ["-", "-"] if m.moving is None else [round(m.moving.median_mm, 1), round(m.moving.within_20mm, 2)]
    return [grade.recording, tracker, visible, *moved, _share(t.apd), _share(t.average_jaccard)]


def _share(value: float) -> object:
    """A share, rounded for a table; a dash where it is no number."""
    return round(value, 3) if value == value else "-"
