"""``flowlab grade``."""

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import yaml
from pydantic import ValidationError

from flowlab.cli.console import console, print_json, print_table
from flowlab.errors import DataError, FlowlabError, MissingLibraryError, UsageError, unknown_name

if TYPE_CHECKING:
    from flowlab.grading.grade import Grade, Grades
    from flowlab.grading.metrics import TrackErrors
    from flowlab.grading.simulate import SimulatedRecording
    from flowlab.tracking.base import Tracker
    from flowlab.tracking.chunking import ChunkSettings


@click.command()
@click.argument("recordings", nargs=-1, metavar="[RECORDING]...", type=click.Path(path_type=Path))
@click.option("--tracker", "names", multiple=True, default=["rigid-bodies"], show_default=True, help="May be repeated.")
@click.option("--tasks", default="", metavar="TASK,...", help="Simulate recordings of these tasks.")
@click.option("--episodes", type=click.IntRange(min=1), default=1, show_default=True, help="Recordings of each task.")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Of the first recording.")
@click.option("--sensor", type=click.Choice(["kinect", "clean"]), default="kinect", show_default=True)
@click.option("--size", default="320x240", show_default=True, metavar="WxH", help="Of simulated pictures [px].")
@click.option("--set", "changes", multiple=True, metavar="[TRACKER.]KEY=VALUE", help="Change a tracker's option.")
@click.option("--weights", type=click.Path(path_type=Path), help="File of a learned tracker's weights.")
@click.option("--chunk", type=click.IntRange(min=2), help="Frames tracked at a time.")
@click.option("--stride", type=click.IntRange(min=1), help="Frames from one chunk to the next.")
@click.option(
    "--out", type=click.Path(path_type=Path), default=Path("grade"), show_default=True, help="Folder to write."
)
@click.option("--json", "as_json", is_flag=True, help="Print the grades as JSON, and no progress.")
def grade(
    recordings: tuple[Path, ...],
    names: tuple[str, ...],
    tasks: str,
    episodes: int,
    seed: int,
    sensor: str,
    size: str,
    changes: tuple[str, ...],
    weights: Path | None,
    chunk: int | None,
    stride: int | None,
    out: Path,
    as_json: bool,
) -> None:
    """Label recordings whose truth is known, without looking at it, and say how far off the labels are.

    \b
      flowlab grade --tracker rigid-bodies --tasks hammer,door-open
      flowlab grade rec/sample --tracker rigid-bodies --tracker lucas-kanade --out graded

    A RECORDING is a folder with a ground_truth.npz, or holds such folders. With --tasks, MetaWorld's experts
    are recorded by a simulated depth camera; the recordings are kept in OUT/recordings, and used again by the
    next run with the same settings. OUT/grade.json and OUT/grade.png are written.
    """
    if not recordings and not tasks:
        raise UsageError("nothing to grade; give folders with a ground_truth.npz, or --tasks hammer,door-open")
    _import_simulation()
    from flowlab.grading.grade import grade as grade_all
    from flowlab.tracking.lifting import LiftSettings

    chunks, settings = _chunk_settings(chunk, stride), _recording_settings(sensor, size)
    trackers = [_make_tracker(name, names, changes, weights) for name in dict.fromkeys(names)]
    folders = [r for path in recordings for r in _find(path)]

    def say(text: str) -> None:
        if not as_json:
            console.print(text, highlight=False, soft_wrap=True)

    def report(row: "Grade") -> None:
        say(f"{row.recording}: {row.frames} frames in {row.cpu_s:.1f} s of CPU time")

    with _writing(out):
        folders += _simulate(tasks, range(seed, seed + episodes), settings, out, say)
    folders = list({folder.resolve(): folder for folder in folders}.values())
    results = []
    for tracker in trackers:
        say(f"labeling with {tracker.name}")
        results.append(grade_all(folders, tracker, chunks, LiftSettings(), report=report))
    document = {
        "chunks": chunks.model_dump(mode="json"),
        "simulated": settings.model_dump(mode="json") if tasks else None,
        "trackers": [r.to_json() for r in results],
    }
    with _writing(out):
        _write(out, results, document)
    if as_json:
        print_json(document)
        return
    _print(results)
    click.echo(f"{out / 'grade.json'} and {out / 'grade.png'}")


def _write(out: Path, results: Sequence["Grades"], document: dict[str, Any]) -> None:
    from flowlab.files import write_json
    from flowlab.viz.grade_figure import draw_grades

    out.mkdir(parents=True, exist_ok=True)
    write_json(out / "grade.json", document)
    rows = results[0].rows
    about = f"{len(rows)} recordings, {sum(r.frames for r in rows)} frames, {sum(r.queries for r in rows)} query points"
    draw_grades({r.name: r.mean for r in results}, out / "grade.png", title="error of tracks", about=about)


def _import_simulation() -> None:
    try:
        import mujoco  # noqa: F401
    except Exception as error:
        if "MUJOCO_GL" not in os.environ:
            raise
        raise MissingLibraryError(
            f"MuJoCo cannot load OpenGL as MUJOCO_GL={os.environ['MUJOCO_GL']} asks ({error}); unset MUJOCO_GL, or "
            "install it with 'apt-get install libegl1 libgl1-mesa-dri libosmesa6'"
        ) from error


def _chunk_settings(chunk: int | None, stride: int | None) -> "ChunkSettings":
    """The defaults, but for what is asked for."""
    from flowlab.tracking.chunking import ChunkSettings

    asked = {"length": chunk, "stride": stride}
    try:
        return ChunkSettings.model_validate({k: v for k, v in asked.items() if v is not None})
    except ValidationError as error:
        raise UsageError(f"--chunk, --stride: {error.errors()[0]['msg'].removeprefix('Value error, ')}") from error


def _make_tracker(name: str, names: Sequence[str], changes: Sequence[str], weights: Path | None) -> "Tracker":
    """A tracker with the options that are meant for it: those without a tracker's name are for all."""
    from flowlab.tracking.base import make_tracker

    options: dict[str, Any] = {} if weights is None else {"weights": str(weights)}
    for change in changes:
        key, equals, value = change.partition("=")
        whose, _, option = key.rpartition(".")
        if not equals or not option:
            raise UsageError(f"--set {change}: must look like KEY=VALUE, or {names[0]}.KEY=VALUE for one tracker")
        if whose and whose not in names:
            raise UsageError(f"--set {change}: {unknown_name('tracker of this run', whose, names)}")
        if whose in ("", name):
            try:
                options[option] = yaml.safe_load(value)
            except yaml.YAMLError as error:
                raise UsageError(f"--set {change}: not valid YAML: '{value}'") from error
    return make_tracker(name, options)


def _find(path: Path) -> list[Path]:
    """The recordings with known truth at or below a path."""
    from flowlab.grading.ground_truth import FILE_NAME

    if not path.exists():
        raise DataError(f"{path}: there is no such folder")
    found = sorted(file.parent for file in path.rglob(FILE_NAME))
    if not found:
        raise DataError(
            f"{path}: no recording at or below it has a {FILE_NAME}, so its truth is not known (see docs/grading.md); "
            "without recordings of your own, give --tasks hammer,door-open"
        )
    return found


def _recording_settings(sensor: str, size: str) -> "SimulatedRecording":
    from flowlab.grading.simulate import SimulatedRecording
    from flowlab.sim.sensor import PRESETS

    width, times, height = size.partition("x")
    if not (times and width.isdecimal() and height.isdecimal() and int(width) > 0 and int(height) > 0):
        raise UsageError(f"--size {size}: must look like 320x240")
    settings = SimulatedRecording(sensor=PRESETS[sensor])
    scene = settings.expert.scene
    camera = scene.camera.model_copy(update={"width": int(width), "height": int(height)})
    expert = settings.expert.model_copy(update={"scene": scene.model_copy(update={"camera": camera})})
    return settings.model_copy(update={"expert": expert})


def _simulate(
    tasks: str, seeds: range, settings: "SimulatedRecording", out: Path, say: Callable[[str], None]
) -> list[Path]:
    """Record what is not there yet."""
    from flowlab.grading.simulate import simulate_recording
    from flowlab.sim.tasks import GROUPS, select_tasks

    asked = [name for name in tasks.replace(" ", "").split(",") if name]
    folders = []
    for task in select_tasks([t for t in asked if t not in GROUPS], [t for t in asked if t in GROUPS]):
        for seed in seeds:
            folder = out / "recordings" / f"{task}-{seed}"
            made = simulate_recording(folder, task, seed, settings)
            say(f"{folder}: {'recorded' if made else 'there already'}")
            folders.append(folder)
    return folders


@contextmanager
def _writing(out: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise FlowlabError(f"{out}: cannot be written ({error.strerror}); choose another --out") from error


def _print(results: Sequence["Grades"]) -> None:
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
    columns = ["tracker", "3D-AJ", "APD", "OA", "kept", "< 1 σ", "< 2 σ", "rank σ", "ms"]
    print_table(columns, [_summary(r) for r in results], "TAPVid-3D without rescaling; stated error σ; CPU per frame")
    columns = ["recording", "tracker", "all mm", "moved mm", "< 20", "APD", "3D-AJ"]
    print_table(columns, [_row(r.name, row) for r in results for row in r.rows], "every recording")
    left_out = {row.recording: row.unusable_queries for row in results[0].rows if row.unusable_queries}
    if left_out:
        each = ", ".join(f"{name} {n}" for name, n in left_out.items())
        click.echo(f"not graded, because the sensor's first depth there is not that of the surface: {each} queries")


def _error_figures(errors: "TrackErrors") -> list[object]:
    shares = errors.within_5mm, errors.within_10mm, errors.within_20mm, errors.within_40mm
    return [round(errors.median_mm, 1), round(errors.p95_mm, 1), *(round(s, 2) for s in shares)]


def _summary(grades: "Grades") -> list[object]:
    t, c = grades.mean.tapvid, grades.mean.calibration
    sigma = ["-"] * 3 if c is None else [_share(x) for x in (c.within_1_sigma, c.within_2_sigma, c.rank_correlation)]
    figures = [_share(x) for x in (t.average_jaccard, t.apd, t.occlusion_accuracy, grades.mean.survival)]
    return [grades.name, *figures, *sigma, round(grades.ms_per_frame, 1)]


def _row(tracker: str, grade: "Grade") -> list[object]:
    m, t = grade.metrics, grade.metrics.tapvid
    visible = "-" if m.all is None else round(m.all.median_mm, 1)
    moved = ["-", "-"] if m.moving is None else [round(m.moving.median_mm, 1), round(m.moving.within_20mm, 2)]
    return [grade.recording, tracker, visible, *moved, _share(t.apd), _share(t.average_jaccard)]


def _share(value: float) -> object:
    return round(value, 3) if value == value else "-"
