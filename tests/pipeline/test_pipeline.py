"""A pipeline carries records from stage to stage, and says where and why one was kept out."""

import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from synthetic import CAMERA, assert_same, make_episode, make_manifest

from flowlab.demonstrations import Demonstration, ObservedDemo, QueriedDemo
from flowlab.errors import DataError, UsageError
from flowlab.perception.observer import Box
from flowlab.perception.queries import EdgeSettings
from flowlab.pipeline.recipe import load_recipe
from flowlab.pipeline.stage import EpisodeRequest, Pipeline, Rejected, Stage, StageTally, Writer
from flowlab.pipeline.stages.accept import AcceptStage
from flowlab.pipeline.stages.observe import ObserverStage, QueriesStage
from flowlab.pipeline.stages.simulation import ExpertStage, RigidFlowStage
from flowlab.pipeline.stages.write import WriteStage
from flowlab.pipeline.units import WorkUnit
from flowlab.pipeline.worker import run_unit
from flowlab.records import Episode, Frame
from flowlab.storage.dataset import Dataset, begin
from flowlab.storage.shard import Shard


class Source(Stage):
    stage: str = "source"

    def process(self, record: EpisodeRequest) -> Episode:
        return make_episode(record.seed, task=record.task, depth=True, rgb=True)


class OnlyEven(Stage):
    stage: str = "only-even"

    def process(self, record: Episode) -> Episode:
        if record.seed % 2:
            raise Rejected(f"{record.seed} is odd")
        return record


class Kept(Stage):
    """Rejects the odd ones, but keeps them."""

    stage: str = "kept"

    def process(self, record: Episode) -> Episode:
        if record.seed % 2:
            raise Rejected(f"{record.seed} is odd", episode=record)
        return record


class Broken(Stage):
    stage: str = "broken"

    def process(self, record: Episode) -> Episode:
        raise ZeroDivisionError


class Recording(Demonstration):
    """A demonstration that is not simulated."""


class Camera(Stage):
    stage: str = "camera"

    def process(self, record: EpisodeRequest) -> Recording:
        raise NotImplementedError


def run_all(pipeline: Pipeline, seeds: Sequence[int]) -> tuple[list[Episode], dict[int, tuple[Any, ...]]]:
    episodes, rejected = [], {}
    for seed in seeds:
        try:
            episodes.append(pipeline.run(EpisodeRequest(task="roll", seed=seed)))
        except Rejected as error:
            rejected[seed] = error.stage, str(error)
    return episodes, rejected


def test_a_rejection_carries_stage_and_reason() -> None:
    episodes, rejected = run_all(Pipeline([Source(), OnlyEven(), WriteStage()]), range(5))
    assert [e.seed for e in episodes] == [0, 2, 4]
    assert rejected == {1: ("only-even", "1 is odd"), 3: ("only-even", "3 is odd")}


def test_tallies_count_calls_and_rejects_of_every_stage(tmp_path: Path) -> None:
    pipeline = Pipeline([Source(), OnlyEven(), WriteStage()])
    episodes, _ = run_all(pipeline, range(5))
    counts = {name: (t.calls, t.rejects) for name, t in pipeline.tallies.items()}
    assert counts == {"source": (5, 0), "only-even": (5, 2), "write": (3, 0)}
    before = dict(pipeline.tallies)
    pipeline.store(tmp_path / "unit.zarr.zip", episodes, "")
    since = pipeline.tallies["write"].since(before["write"])
    assert (since.calls, since.rejects) == (0, 0)
    assert since.cpu_s > 0
    assert pipeline.tallies["source"] == before["source"]
    assert before["write"].plus(since) == pipeline.tallies["write"]


def test_an_error_is_no_rejection() -> None:
    pipeline = Pipeline([Source(), Broken(), WriteStage()])
    with pytest.raises(ZeroDivisionError):
        pipeline.run(EpisodeRequest(task="roll", seed=0))
    assert pipeline.tallies["broken"] == StageTally(calls=1, cpu_s=pipeline.tallies["broken"].cpu_s)
    assert pipeline.tallies["write"].calls == 0


@pytest.mark.parametrize("rgb", [False, True])
@pytest.mark.parametrize("depth", [False, True])
def test_write_stores_pictures_only_if_asked(tmp_path: Path, depth: bool, rgb: bool) -> None:
    pipeline = Pipeline([Source(), WriteStage(depth=depth, rgb=rgb)])
    made = pipeline.run(EpisodeRequest(task="roll", seed=3))
    source = make_episode(3, depth=True, rgb=True)
    assert_same(made, replace(source, depth=source.depth if depth else None, rgb=source.rgb if rgb else None))
    pipeline.store(tmp_path / "unit.zarr.zip", [made], "settings")
    assert_same(Shard(tmp_path / "unit.zarr.zip").episode(0), made)


@pytest.mark.parametrize(("solved", "asked", "passes"), [(5, 5, True), (4, 5, False), (0, 0, True), (12, 13, False)])
def test_accept_counts_solved_steps(solved: int, asked: int, passes: bool) -> None:
    episode = replace(make_episode(steps=12), success=np.arange(12) < solved)
    stage = AcceptStage(success_steps=asked)
    if passes:
        assert stage.process(episode) is episode
    else:
        with pytest.raises(Rejected, match=f"solved for {solved} steps of 12, at least {asked} asked for"):
            stage.process(episode)


@pytest.mark.parametrize(
    ("stages", "sentence"),
    [
        ([], "the last stage must store the episodes"),
        ([Source()], "the last stage must store the episodes, as 'write' does, but the last is stage 'source'"),
        ([Source(), WriteStage(), OnlyEven()], "the last stage must store the episodes"),
        ([OnlyEven()], "stage 'only-even' takes Episode, but the pipeline's start gives EpisodeRequest"),
        ([Source(), ObserverStage()], "stage 'observer' takes Demonstration, but stage 'source' gives Episode"),
        (
            [Camera(), ObserverStage(), QueriesStage(), RigidFlowStage(), WriteStage()],
            "stage 'rigid-flow' works on demonstrations of type Rollout only, and these are of type Recording",
        ),
    ],
)
def test_stages_that_do_not_fit_are_refused(stages: list[Stage], sentence: str) -> None:
    with pytest.raises(UsageError) as error:
        Pipeline(stages)
    assert sentence in str(error.value)


def test_stages_say_what_they_take_and_give() -> None:
    assert ExpertStage.takes() is EpisodeRequest
    assert issubclass(ExpertStage.gives(), Demonstration)
    assert (ObserverStage.takes(), ObserverStage.gives()) == (Demonstration, ObservedDemo)
    assert (QueriesStage.takes(), QueriesStage.gives()) == (ObservedDemo, QueriedDemo)
    assert (Writer.takes(), Writer.gives()) == (Episode, Episode)


STAGES_HERE = "name: here\nstages: [{stage: 'test_pipeline:Source'}, {stage: 'test_pipeline:%s'}, {stage: write}]"


def test_what_was_rejected_with_its_episode_can_be_looked_at(tmp_path: Path) -> None:
    (tmp_path / "receipts").mkdir()
    unit = WorkUnit(task="roll", seeds=(0, 1, 2, 3), sources=("/a", "/b", "/c", "/d"))
    begin(tmp_path, make_manifest({"roll": 4}))
    receipt = run_unit(STAGES_HERE % "Kept", None, "digest", tmp_path, unit)
    assert receipt.accepted == (0, 2)
    assert [(x.seed, x.stage, x.reason, x.source, x.position) for x in receipt.rejects] == [
        (1, "test_pipeline:Kept", "1 is odd", "/b", 0), (3, "test_pipeline:Kept", "3 is odd", "/d", 1),
    ]  # fmt: skip
    dataset = Dataset(tmp_path)
    as_stored = replace(make_episode(3, rgb=True, depth=True), depth=None)
    assert_same(dataset.rejected(1), as_stored)
    assert [e.seed for e in dataset.episodes()] == [0, 2]


def test_a_second_try_at_a_unit_leaves_nothing_of_the_first(tmp_path: Path) -> None:
    """Its recording was mended, or its rules were changed: a shard that its receipt knows nothing of must not stay."""
    (tmp_path / "receipts").mkdir()
    unit = WorkUnit(task="roll", seeds=(1,))
    run_unit(STAGES_HERE % "Kept", None, "digest", tmp_path, unit)
    assert [p.parent.name for p in tmp_path.glob("*/*.zarr.zip")] == ["rejects"]
    run_unit(STAGES_HERE % "AsItIs", None, "digest", tmp_path, unit)
    assert [p.parent.name for p in tmp_path.glob("*/*.zarr.zip")] == ["shards"]
    run_unit(STAGES_HERE % "OnlyEven", None, "digest", tmp_path, unit)
    assert list(tmp_path.glob("*/*.zarr.zip")) == []


class AsItIs(Stage):
    stage: str = "as-it-is"

    def process(self, record: Episode) -> Episode:
        return record


@dataclass(frozen=True, slots=True, kw_only=True)
class Still(Demonstration):
    """Three times the same picture, one of which cannot be read."""

    picture: Frame
    bad: int = -1

    def frame(self, t: int) -> Frame:
        if t == self.bad:
            raise DataError(f"depth/{t}.png is torn")
        return self.picture


def still(depth: np.ndarray, bad: int = -1) -> Still:
    zeros = np.zeros((3, 1), np.float32)
    return Still(
        task="roll", seed=0, camera=CAMERA, time_s=np.arange(3.0), state=zeros, action=zeros, success=np.ones(3, bool),
        picture=Frame(depth, CAMERA), bad=bad,
    )  # fmt: skip


ANYWHERE = ObserverStage(crop=Box(low=(-9, -9, -9), high=(9, 9, 9)))


@pytest.mark.parametrize("bad", range(3))
def test_a_frame_that_cannot_be_read_rejects_its_recording(bad: int) -> None:
    """And does not end the run."""
    with pytest.raises(Rejected, match=f"step {bad}: depth/{bad}.png is torn"):
        ANYWHERE.process(still(np.ones((12, 16), np.float32), bad))


def test_queries_keep_clear_of_edges_if_asked() -> None:
    depth = np.full((12, 16), 1.0, np.float32)
    depth[:, 8:] = 0.5
    observed = ANYWHERE.process(still(depth))
    columns = {}
    for avoid in (None, EdgeSettings(margin_px=2)):
        queries = QueriesStage(points=150, avoid_edges=avoid).process(observed).queries
        columns[avoid is None] = set(np.rint(CAMERA.project(queries.xyz_world)[0][:, 0]).astype(int).tolist())
    assert columns[True] == set(range(16))
    assert columns[False] == set(range(16)) - set(range(5, 11))


def test_simulation_needs_no_trackers_and_recordings_no_simulator() -> None:
    for recipe, foreign in (
        ("metaworld", ["cv2", "torch", "open3d", "flowlab.recordings"]),
        ("real", ["mujoco", "torch", "open3d"]),
    ):
        code = "import sys; from flowlab.pipeline import worker, filling\n"
        code += "from flowlab.pipeline.recipe import load_recipe\n"
        code += f"load_recipe({recipe!r}).pipeline(); print([m for m in {foreign!r} if m in sys.modules])"
        result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
        assert result.stdout.strip() == "[]"


def test_a_real_rejection_names_the_stage() -> None:
    """A crop that holds nothing."""
    recipe = load_recipe("metaworld", ["observer.crop={low: [50, 50, 50], high: [51, 51, 51]}", "expert.max_steps=2"])
    pipeline = recipe.pipeline()
    with pytest.raises(Rejected) as rejected:
        pipeline.run(EpisodeRequest(task="drawer-open", seed=0))
    stage, reason = rejected.value.stage, str(rejected.value)
    assert stage == "observer"
    assert reason.startswith("step 0: drawer-open: no point of the frame lies in the crop")
    counts = {name: (t.calls, t.rejects) for name, t in pipeline.tallies.items()}
    assert counts["expert"] == (1, 0)
    assert counts["observer"] == (1, 1)
    assert counts["queries"] == (0, 0)
