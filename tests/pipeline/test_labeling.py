"""From recordings to a dataset, in this process: numbers, tasks, quality bars, and labels near the truth."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from synthetic import assert_same, make_episode, with_quality
from synthetic_clip import BOARD_M, CAMERA, WALL_M, film, record, truth

from flowlab.demonstrations import QueriedDemo
from flowlab.engines.base import UnitResult
from flowlab.errors import DataError, UsageError
from flowlab.pipeline.inspection import estimate_cost, inspect_recordings
from flowlab.pipeline.labeling import find_jobs, label_recordings
from flowlab.pipeline.recipe import Recipe, load_recipe
from flowlab.pipeline.stage import EpisodeRequest, Rejected
from flowlab.pipeline.stages.quality import QualityStage
from flowlab.pipeline.stages.recording import LiftStage, TrackStage
from flowlab.pipeline.units import WorkUnit
from flowlab.records import Episode, PositionSource
from flowlab.storage.dataset import Dataset
from flowlab.storage.receipts import Receipt
from flowlab.storage.validation import validate

SMALL = ("track.tracker=lucas-kanade", "observer.points=256", "queries.points=40")
ANY = ("quality.min_sure_share=0", "quality.max_median_sigma_m=9", "quality.max_lost_share=1")
"""No quality bar: what is tested does not depend on how errors are stated."""


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three recordings of one task."""
    folder = tmp_path_factory.mktemp("recordings") / "slide"
    for k, name in enumerate(("take 1", "take 2", "take 10")):
        record(folder / name, seed=k)
    return folder


@pytest.fixture(scope="module")
def recipe() -> Recipe:
    return load_recipe("real", [*SMALL, *ANY])


class InThisProcess:
    """Does the units here, one after the other."""

    workers = 1

    def __init__(self, work: Callable[[WorkUnit], Receipt]) -> None:
        self.work, self.units = work, list[WorkUnit]()

    def __enter__(self) -> "InThisProcess":
        return self

    def __exit__(self, *failure: object) -> None:
        pass

    def submit(self, unit: WorkUnit) -> None:
        self.units.append(unit)

    def next_result(self) -> UnitResult:
        unit = self.units.pop(0)
        return UnitResult(unit, self.work(unit))


label = partial(label_recordings, start_engine=InThisProcess)


@pytest.fixture(scope="module")
def dataset(recordings: Path, recipe: Recipe, tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return label(recipe, find_jobs(recipe, [recordings]), tmp_path_factory.mktemp("data") / "slide")


def test_labels_are_near_the_truth(dataset: Dataset) -> None:
    """Of the board, which moves, as of the wall, which does not."""
    for episode in dataset.episodes():
        xyz, visible = episode.tracks.xyz_world, episode.tracks.visible
        error = np.linalg.norm(xyz - truth(episode.queries.xyz_world, len(episode)), axis=-1)
        on_board = episode.queries.xyz_world[:, 2] < 0.9
        assert on_board.sum() > 3
        for part in (on_board, ~on_board):
            assert np.median(error[:, part][visible[:, part]]) < 0.004
        traveled = np.linalg.norm(xyz[-1] - xyz[0], axis=-1)
        assert np.median(traveled[on_board]) == pytest.approx(19 * BOARD_M / CAMERA.K[0, 0], abs=0.01)


def test_a_good_recording_passes_the_bars_as_they_are(recordings: Path, tmp_path: Path) -> None:
    recipe = load_recipe("real", SMALL)
    assert label(recipe, find_jobs(recipe, [recordings]), tmp_path / "d").rejects == []


def test_an_episode_is_what_the_recording_holds(dataset: Dataset) -> None:
    rgb, depth = film(seed=0)
    episode = dataset.episode(0)
    assert (episode.task, episode.seed) == ("slide", 0)
    np.testing.assert_array_equal(episode.rgb, rgb)
    np.testing.assert_allclose(episode.time_s, np.arange(20) / 10)
    np.testing.assert_array_equal(episode.state[:, 1], np.arange(20) ** 2)
    np.testing.assert_array_equal(episode.action[:-1], episode.state[1:])
    assert episode.success.tolist() == [False] * 19 + [True]
    np.testing.assert_allclose(episode.depth, depth, atol=5e-4)
    z = np.unique(episode.point_cloud[0, :, 2])
    np.testing.assert_allclose(z, [BOARD_M, WALL_M], atol=1e-6)
    np.testing.assert_allclose(episode.camera.K, CAMERA.K)


def test_an_episode_says_how_it_was_labeled(dataset: Dataset) -> None:
    about = dataset.episode(1).extras
    assert about["tracker"]["tracker"] == "lucas-kanade"
    assert about["tracker"]["license"]
    assert about["reader"] == "plain"
    assert dataset.manifest.settings["track"]["tracker"] == "lucas-kanade"
    assert dataset.manifest.settings["track"]["chunks"] == {"length": 33, "stride": 8}
    quality = dataset.episode(1).tracks.quality
    assert quality is not None
    assert (quality.source != PositionSource.SIMULATOR).all()


def test_queries_start_at_their_own_pixels(dataset: Dataset) -> None:
    for episode in dataset.episodes():
        pixel, _ = CAMERA.project(episode.queries.xyz_world.astype(np.float64))
        np.testing.assert_allclose(pixel, np.rint(pixel), atol=1e-3)
        assert episode.tracks.association_distance.max() < 1e-4
        np.testing.assert_allclose(episode.tracks.xyz_world[0], episode.queries.xyz_world, atol=1e-4)


def test_queries_keep_clear_of_the_edges_of_the_board(dataset: Dataset) -> None:
    _, depth = film()
    for episode in dataset.episodes():
        u, v = np.rint(CAMERA.project(episode.queries.xyz_world)[0]).astype(int).T
        for x, y in zip(u, v, strict=True):
            around = depth[0, max(y - 2, 0) : y + 3, max(x - 2, 0) : x + 3]
            assert around.min() == around.max()


def test_a_dataset_of_recordings_is_sound(dataset: Dataset) -> None:
    assert [str(f) for f in validate(dataset.path)] == []
    assert dataset.missing == {}
    assert [(r.task, r.name, r.seed) for r in dataset.manifest.recordings] == [
        ("slide", "take 1", 0), ("slide", "take 2", 1), ("slide", "take 10", 2),
    ]  # fmt: skip
    assert dataset.manifest.provenance.camera == {}
    assert 0 < dataset.stats["quality"]["visible_sigma_m"]["p50"] < 0.05
    assert "by the tracker lucas-kanade" in (dataset.path / "README.md").read_text()


def test_recordings_that_come_later_get_later_numbers(
    recordings: Path, recipe: Recipe, dataset: Dataset, tmp_path: Path
) -> None:
    parts = tmp_path / "parts"
    label(recipe, find_jobs(recipe, [recordings / "take 2"]), parts)
    first = {p.name: p.stat().st_mtime_ns for p in (parts / "receipts").iterdir()}
    joined = label(recipe, find_jobs(recipe, [recordings]), parts)
    assert [(r.name, r.seed) for r in joined.manifest.recordings] == [("take 2", 0), ("take 1", 1), ("take 10", 2)]
    assert {p.name: p.stat().st_mtime_ns for p in (parts / "receipts").iterdir() if p.name in first} == first
    assert joined.missing == {}
    assert_same(replace(joined.episode(0), seed=1), dataset.episode(1), "take 2 is the same whatever its number")


def test_a_recording_that_was_mended_is_tried_again(recordings: Path, recipe: Recipe, tmp_path: Path) -> None:
    folder = record(tmp_path / "slide" / "a")
    described = (folder / "recording.yaml").read_text()
    (folder / "recording.yaml").write_text("".join(x for x in described.splitlines(True) if "intrinsics" not in x))
    out = tmp_path / "d"
    found = find_jobs(recipe, [folder.parent])
    (reject,) = label(recipe, found, out).rejects
    assert (reject.stage, reject.shard, reject.source) == ("recording", None, str(folder))
    assert "intrinsics" in reject.reason
    before = (out / "receipts/slide-000000.json").stat().st_mtime_ns
    assert len(label(recipe, found, out).rejects) == 1
    assert (out / "receipts/slide-000000.json").stat().st_mtime_ns > before
    (folder / "recording.yaml").write_text(described)
    mended = label(recipe, found, out)
    assert (len(mended), mended.rejects) == (1, [])


def test_what_is_too_poor_is_rejected_and_can_be_looked_at(recordings: Path, tmp_path: Path) -> None:
    strict = load_recipe("real", [*SMALL, "quality.sure_m=0.000001", "write.rgb=false"])
    poor = label(strict, find_jobs(strict, [recordings]), tmp_path / "d")
    assert (len(poor), poor.missing) == (0, {})
    assert [(x.stage, x.seed, x.source) for x in poor.rejects] == [
        ("quality", k, str(recordings / name)) for k, name in enumerate(("take 1", "take 2", "take 10"))
    ]
    assert (
        "with a stated error below 0.001 mm, at least 25% asked for (quality.min_sure_share)" in poor.rejects[0].reason
    )
    shown = poor.rejected(2)
    assert (shown.seed, shown.rgb, shown.extras["tracker"]["tracker"]) == (2, None, "lucas-kanade")
    assert list(validate(tmp_path / "d")) == []
    before = {p.name: p.stat().st_mtime_ns for p in (tmp_path / "d/receipts").iterdir()}
    label(strict, find_jobs(strict, [recordings]), tmp_path / "d")
    assert {p.name: p.stat().st_mtime_ns for p in (tmp_path / "d/receipts").iterdir()} == before, "tried again"


def bars(sigma: float, visible: np.ndarray, count: int = 8, **values: Any) -> str:
    """What the quality stage says of an episode of 8 points and 20 steps; nothing if it may pass."""
    episode = with_quality(make_episode(steps=20))
    assert episode.tracks.quality is not None
    quality = replace(episode.tracks.quality, sigma=np.full(visible.shape, sigma, np.float32))
    episode = replace(
        episode,
        tracks=replace(episode.tracks, visible=visible, quality=quality),
        queries=replace(episode.queries, count=count),
    )
    try:
        passed = QualityStage(**values).process(episode)
    except Rejected as rejected:
        passed, complaint = rejected.episode, str(rejected)
    else:
        complaint = ""
    assert passed is episode
    return complaint


def seen(share: float) -> np.ndarray:
    """The first so many of the points are visible throughout."""
    return np.broadcast_to(np.arange(8) < 8 * share, (20, 8)).copy()


def test_every_bar_says_what_was_found_and_asked_for() -> None:
    everything = seen(1.0)
    assert bars(0.005, everything) == ""
    assert bars(0.005, seen(0.25)) == ""
    assert bars(0.005, seen(0.125)).startswith(
        "12% of all positions are seen with a stated error below 50 mm, at least"
    )
    assert bars(0.04, everything, min_sure_share=0.0) == ""
    complaint = bars(0.06, everything, min_sure_share=0.0)
    assert "median stated error of visible points is 60.0 mm, at most 50 mm" in complaint
    assert "stated error below 50 mm" in bars(0.06, everything)
    gone = everything.copy()
    gone[12:, :7] = False
    assert "88% of the points are lost for good before the end, at most 80% asked for" in bars(0.005, gone)
    assert bars(0.005, gone, max_lost_share=0.9) == ""
    gone[18] = True
    assert bars(0.005, gone) == "", "they come back, in the last tenth"
    assert "0%" in bars(0.005, seen(0.0))


def test_repeated_points_do_not_count_towards_the_bars() -> None:
    visible = seen(1.0)
    visible[:, :2] = False
    assert bars(0.005, visible) == ""
    assert "0% of all positions" in bars(0.005, visible, count=2)


def test_exact_tracks_pass_every_bar() -> None:
    episode = make_episode()
    assert QualityStage(min_sure_share=1.0, max_lost_share=0.0).process(episode) is episode


def queried(recordings: Path, recipe: Recipe) -> QueriedDemo:
    record: Any = EpisodeRequest(task="slide", seed=0, source=str(recordings / "take 1"))
    for stage in recipe.stages[:3]:
        record = stage.process(record)
    assert isinstance(record, QueriedDemo)
    return record


def test_a_recording_without_color_is_rejected_in_a_sentence(recordings: Path, recipe: Recipe) -> None:
    gray = queried(recordings, recipe)
    gray = replace(gray, observed=replace(gray.observed, rgb=None))
    with pytest.raises(Rejected, match="no color pictures"):
        TrackStage(tracker="lucas-kanade").process(gray)


def test_lifting_is_set_in_the_recipe(recordings: Path, recipe: Recipe) -> None:
    tracked = TrackStage(tracker="lucas-kanade").process(queried(recordings, recipe))
    one, other = (LiftStage(window_px=w).process(tracked) for w in (0, 3))
    assert isinstance(one, Episode)
    assert (one.tracks.xyz_world != other.tracks.xyz_world).any()


def test_a_task_is_what_the_user_says_or_the_recording_or_the_folder(tmp_path: Path, recipe: Recipe) -> None:
    plain, said = record(tmp_path / "rec/slide/a", 3), record(tmp_path / "rec/slide/b", 3, task="push it")
    found = find_jobs(recipe, [tmp_path / "rec"])
    assert [(r.task, r.name, r.seed, r.source) for r in found] == [
        ("push it", "b", 0, str(said)), ("slide", "a", 1, str(plain)),
    ]  # fmt: skip
    assert {r.task for r in find_jobs(recipe, [tmp_path / "rec"], "mine")} == {"mine"}
    calibrated = load_recipe("real", [*SMALL, f"recording.calibration={tmp_path / 'c.yaml'}"])
    (tmp_path / "c.yaml").write_text("task: all\n")
    assert {r.task for r in find_jobs(calibrated, [tmp_path / "rec"])} == {"all"}


@pytest.mark.parametrize("task", ["a/b", ".hidden", "/"])
def test_a_task_must_be_usable_as_a_file_name(tmp_path: Path, recipe: Recipe, task: str) -> None:
    record(tmp_path / "a", 3)
    with pytest.raises(UsageError, match="cannot be the name of a task; give one with --task"):
        find_jobs(recipe, [tmp_path], task)


def test_a_calibration_file_that_is_missing_is_told_before_any_work(tmp_path: Path, recordings: Path) -> None:
    recipe = load_recipe("real", [*SMALL, f"recording.calibration={tmp_path / 'none.yaml'}"])
    with pytest.raises(DataError, match=r"none\.yaml: there is no such file"):
        find_jobs(recipe, [recordings])


def test_a_recipe_of_simulation_cannot_take_recordings(recordings: Path) -> None:
    with pytest.raises(UsageError, match="recipe metaworld: track-real needs a 'recording' stage at the start"):
        find_jobs(load_recipe("metaworld"), [recordings])


def without_depth(folder: Path) -> None:
    """A recording of which somebody copied only half."""
    for picture in (record(folder, 5) / "depth").iterdir():
        picture.unlink()


def test_a_look_says_what_is_there_even_where_something_is_missing(tmp_path: Path, recipe: Recipe) -> None:
    record(tmp_path / "a/b", 5)
    without_depth(tmp_path / "a/c")
    whole, empty = inspect_recordings(recipe, find_jobs(recipe, [tmp_path / "a"]))
    assert whole.description is not None
    assert (whole.description.rows, whole.problem) == (5, None)
    assert empty.description is None
    assert empty.problem


def test_a_forecast_is_measured_on_what_can_be_labeled(tmp_path: Path, recordings: Path, recipe: Recipe) -> None:
    without_depth(tmp_path / "a/c")
    broken = find_jobs(recipe, [tmp_path / "a"])
    told = estimate_cost(recipe, [*broken, *find_jobs(recipe, [recordings])])
    assert told.cpu_s_per_frame is not None
    assert 1e-5 < told.cpu_s_per_frame < 1
    assert told.basis == "measured on the first 20 frames of slide/take 1"
    nothing = estimate_cost(recipe, broken)
    assert nothing.cpu_s_per_frame is None
    assert nothing.basis.startswith(f"no recording can be labeled: {tmp_path / 'a/c'}")


def test_recordings_of_another_width_are_rejected(recordings: Path, recipe: Recipe, tmp_path: Path) -> None:
    """Whatever else is in the folder, the dataset can be read, and says what to do with the other."""
    folder = tmp_path / "slide"
    record(folder / "1", action=np.ones((20, 4), np.float32))
    record(folder / "2")
    made = label(recipe, find_jobs(recipe, [folder]), tmp_path / "data")
    (kept,) = made
    assert kept.action.shape == (20, 4)
    assert made.stats["episodes"] == 1
    (reject,) = made.rejects
    assert reject.reason == (
        "its action has 2 numbers a step, that of the dataset's other episodes 4; choose the same ones in the same "
        "order, or label it into another --out"
    )


def test_recordings_whose_numbers_are_called_otherwise_are_rejected(recipe: Recipe, tmp_path: Path) -> None:
    """The same two joints in another order are as many, and something else."""
    folder = tmp_path / "slide"
    for name, columns in (("1", "a,b"), ("2", "b,a"), ("3", "a,b")):
        record(folder / name)
        lines = [f"{t}.5,{2 * t + 1}" for t in range(20)]
        (folder / name / "state.csv").write_text("\n".join([columns, *lines]))
        about = yaml.safe_load((folder / name / "recording.yaml").read_text())
        (folder / name / "recording.yaml").write_text(yaml.safe_dump({**about, "state": "state.csv"}))
    made = label(recipe, find_jobs(recipe, [folder]), tmp_path / "data")
    assert made.stats["episodes"] == 2
    (reject,) = made.rejects
    assert reject.source == str(folder / "2")
    assert reject.reason.startswith("its state is 'b', 'a', that of the dataset's other episodes 'a', 'b'; choose")
    with (folder / "2" / "recording.yaml").open("a") as about_the_second:
        about_the_second.write("state_columns: [a, b]\n")
    again = label(recipe, find_jobs(recipe, [folder]), tmp_path / "data")
    assert (again.stats["episodes"], list(again.rejects)) == (3, [])
    second = next(e for e in again if e.extras["source"].endswith("2"))
    assert second.state[0].tolist() == [1.0, 0.5]
