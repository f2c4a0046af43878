"""A whole grading run: recordings found or simulated, labeled by some trackers, and compared with their truth."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from flowlab.arguments import (
    check_count,
    check_names,
    check_optional_count,
    check_optional_name,
    check_path,
    check_paths,
    check_settings,
    check_size,
)
from flowlab.errors import UsageError, unknown_name
from flowlab.files import told_when_unwritable, write_json
from flowlab.grading.grade import TrackerGrade
from flowlab.grading.ground_truth import find_with_truth
from flowlab.grading.origin import seeds_in_words, sizes_in_words
from flowlab.grading.units import GradedRecording, grade_on_engine
from flowlab.sim.loading import load_mujoco
from flowlab.text import counted
from flowlab.tracking.base import Tracker, make_tracker
from flowlab.tracking.chunking import ChunkSettings
from flowlab.untrusted import parse_yaml

REPORT = "grade.json"
_SETTINGS_FORM = "a list of strings, as in settings=['chunk=33']"


@dataclass(frozen=True, slots=True)
class GradingReport:
    """What some trackers make of some recordings."""

    chunks: ChunkSettings
    simulated: Mapping[str, Any] | None
    """How recordings were simulated, as JSON values; None where none was."""
    trackers: tuple[TrackerGrade, ...]

    @property
    def graded(self) -> tuple[str, ...]:
        """What the tracks are of: tasks and families of scenes, and the names of recordings of somebody's own."""
        return tuple(dict.fromkeys(row.scene or row.recording for row in self.trackers[0].rows))

    @property
    def about(self) -> tuple[str, ...]:
        """How much was graded, and what it was recorded with, in words."""
        rows = self.trackers[0].rows
        frames, queries = sum(r.frames for r in rows), sum(r.queries for r in rows)
        seeds = seeds_in_words([row.origin.seed for row in rows if row.origin.seed is not None])
        simulated = ", ".join(dict.fromkeys(row.origin.sensor for row in rows if row.origin.sensor))
        sensors = [f"simulated sensor: {simulated}"] if simulated else []
        if not all(row.origin.sensor for row in rows):
            sensors.append("sensor of own recordings not stated")
        return (
            f"{len(rows)} recording{'s' if len(rows) > 1 else ''}" + (f" ({seeds})" if seeds else ""),
            f"{counted(frames, 'frame')}, {queries} query points",
            *sensors,
            sizes_in_words([row.size for row in rows]),
        )

    def to_json(self) -> dict[str, Any]:
        """All figures and the settings they were taken with, as JSON values."""
        return {
            "chunks": self.chunks.model_dump(mode="json"),
            "simulated": self.simulated,
            "trackers": [t.to_json() for t in self.trackers],
        }


def grade(
    recordings: Sequence[Path | str] | Path | str = (),
    out: Path | str = "grade",
    *,
    trackers: Sequence[str] | str = ("rigid-bodies",),
    tasks: Sequence[str] | str = (),
    scenes: Sequence[str] | str = (),
    episodes: int = 1,
    seed: int = 0,
    sensor: str | None = None,
    size: tuple[int, int] | None = None,
    camera: str | None = None,
    settings: Sequence[str] = (),
    weights: Path | None = None,
    chunks: ChunkSettings = ChunkSettings(),
    engine: str = "local",
    workers: int | None = None,
    on_progress: Callable[[str], None] = lambda _: None,
) -> GradingReport:
    """Label recordings whose truth is known, without looking at it, and say how far off the labels are.

    Args:
        recordings: Folders with a ``ground_truth.npz``, or that hold such folders.
        out: Folder to write: ``grade.json``, and the simulated recordings, which the next run uses again.
        trackers: Names of trackers, or import paths ``module:Class``.
        tasks: MetaWorld's tasks, or groups of them, whose experts are recorded by a simulated depth camera.
        scenes: Families of procedural scenes that are filmed (see :mod:`flowlab.grading.scenes`), or ``all``.
        episodes: Recordings of each task and family.
        seed: Of the first of them. Films of seeds from 1000 on are for reporting: no tracker may be made with them.
        sensor: What the simulated camera errs like: ``kinect``, ``stereo``, ``tof`` or ``clean``. Without it tasks are
            recorded by a Kinect, and every film's seed chooses.
        size: Width and height of its pictures [px]. Without it tasks have 320 x 240, and every film's seed chooses.
        camera: Of films, whether it is ``fixed``, ``hand-held`` or ``traveling`` past the scene; the last two also with
            ``, poses known``. Without it every film's seed chooses, and none travels.
        settings: ``key=value`` of every tracker's options, or ``tracker.key=value`` of one tracker's.
        weights: File of a learned tracker's weights.
        chunks: How a recording is cut for trackers that take it in parts.
        engine: Name or import path of what runs the workers, each of which makes and labels one recording at a time.
        workers: How many; by default as many as the engine has cores.
        on_progress: Is told in words what is done.

    Returns:
        Every figure, by tracker and recording.

    Raises:
        UsageError: There is nothing to grade, or a name or an option does not exist.
        DataError: A recording cannot be read, or its truth is not known.
        FlowlabError: The folder cannot be written, or a library is missing.
    """
    recordings = check_paths(recordings, "recordings")
    tasks, scenes = check_names(tasks, "tasks"), check_names(scenes, "scenes")
    trackers, settings = check_names(trackers, "trackers"), check_settings(settings, form=_SETTINGS_FORM)
    episodes, seed, out = check_count(episodes, "episodes"), check_count(seed, "seed", 0), check_path(out, "out")
    if not recordings and not tasks and not scenes:
        raise UsageError(
            "nothing to grade; give folders with a ground_truth.npz, --scenes tabletop,hands or --tasks hammer,push"
        )
    sensor, camera = check_optional_name(sensor, "sensor"), check_optional_name(camera, "camera")
    size = check_size(size, "size")
    if camera is not None and not scenes:
        raise UsageError(f"--camera {camera} is of films; give --scenes tabletop,hands, too")
    workers = check_optional_count(workers, "workers")
    made = [make_graded_tracker(name, trackers, settings, weights) for name in dict.fromkeys(trackers)]
    own = [GradedRecording(folder.resolve()) for path in recordings for folder in find_with_truth(path)]
    seeds, place = range(seed, seed + episodes), (out / "recordings").resolve()
    of_tasks, tasks_made = _simulations(tasks, seeds, sensor or "kinect", size or (320, 240), place)
    of_scenes, scenes_made = _films(scenes, seeds, sensor, size, camera, place)
    every = {r.folder: r for r in (*own, *of_tasks, *of_scenes)}
    with told_when_unwritable(out, "choose another --out"):
        out.mkdir(parents=True, exist_ok=True)
    grades = grade_on_engine(
        list(every.values()), made, chunks, out, engine=engine, workers=workers, on_progress=on_progress
    )
    report = GradingReport(chunks, tasks_made | scenes_made or None, tuple(grades))
    with told_when_unwritable(out, "choose another --out"):
        write_json(out / REPORT, report.to_json())
    return report


def make_graded_tracker(name: str, names: Sequence[str], settings: Sequence[str], weights: Path | None) -> Tracker:
    """A tracker with the options that are meant for it: those without a tracker's name are for all of ``names``."""
    options: dict[str, Any] = {} if weights is None else {"weights": str(weights)}
    for change in settings:
        key, equals, value = change.partition("=")
        whose, _, option = key.rpartition(".")
        if not equals or not option:
            raise UsageError(f"--set {change}: must look like KEY=VALUE, or {names[0]}.KEY=VALUE for one tracker")
        if whose and whose not in names:
            raise UsageError(f"--set {change}: {unknown_name('tracker of this run', whose, names)}")
        if whose in ("", name):
            try:
                options[option] = parse_yaml(value)
            except ValueError as error:
                raise UsageError(f"--set {change}: not valid YAML: '{value}'") from error
    return make_tracker(name, options)


def _simulations(
    names: Sequence[str], seeds: range, sensor: str, size: tuple[int, int], place: Path
) -> tuple[list[GradedRecording], dict[str, Any]]:
    """The recordings of tasks, and how those are made that are not there yet."""
    if not names:
        return [], {}
    load_mujoco()
    from flowlab.grading.simulate import SimulatedRecording, simulate_recording
    from flowlab.sim.tasks import tasks_named

    how = SimulatedRecording.with_camera(sensor, size)
    recordings = [
        GradedRecording(place / f"{task}-{seed}", partial(simulate_recording, task=task, seed=seed, settings=how))
        for task in tasks_named(names)
        for seed in seeds
    ]
    return recordings, {"tasks": how.model_dump(mode="json")}


def _films(
    names: Sequence[str],
    seeds: range,
    sensor: str | None,
    size: tuple[int, int] | None,
    camera: str | None,
    place: Path,
) -> tuple[list[GradedRecording], dict[str, Any]]:
    """The films of families of scenes, and how those are made that are not there yet."""
    if not names:
        return [], {}
    load_mujoco()
    from flowlab.grading.scenes.families import FAMILIES
    from flowlab.grading.scenes.film import check_film, film_settings, make_film

    how = film_settings(sensor=sensor, size=size, camera=camera)
    recordings = []
    for family in FAMILIES if list(names) == ["all"] else names:
        check_film(family, how)
        films = {seed: partial(make_film, family=family, seed=seed, settings=how) for seed in seeds}
        recordings += [GradedRecording(place / f"{family}-{seed}", film) for seed, film in films.items()]
    return recordings, {"scenes": how.model_dump(mode="json")}
