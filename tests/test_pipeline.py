"""A pipeline carries records from stage to stage, and says where and why one was kept out."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from synthetic import assert_same, make_episode

from flowlab.errors import UsageError
from flowlab.pipeline.recipe import load_recipe
from flowlab.pipeline.stage import EpisodeRequest, Pipeline, Rejected, Stage, StageTally, Writer
from flowlab.pipeline.stages import AcceptStage, ExpertStage, ObserverStage, QueriesStage, RigidFlowStage, WriteStage
from flowlab.records import Demonstration, Episode, ObservedDemo, QueriedDemo
from flowlab.storage.shard import Shard


class Source(Stage):
    stage: str = "source"

    def process(self, record: EpisodeRequest) -> Episode:
        return make_episode(record.seed, task=record.task, depth=True)


class OnlyEven(Stage):
    stage: str = "only-even"

    def process(self, record: Episode) -> Episode:
        if record.seed % 2:
            raise Rejected(f"{record.seed} is odd")
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
            rejected[seed] = error.args
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
    pipeline.store(tmp_path / "unit.zarr", episodes, "")
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


@pytest.mark.parametrize("depth", [False, True])
def test_write_stores_depth_only_if_asked(tmp_path: Path, depth: bool) -> None:
    pipeline = Pipeline([Source(), WriteStage(depth=depth)])
    made = pipeline.run(EpisodeRequest(task="roll", seed=3))
    source = make_episode(3, depth=True)
    assert_same(made, source if depth else replace(source, depth=None))
    pipeline.store(tmp_path / "unit.zarr", [made], "settings")
    assert_same(Shard(tmp_path / "unit.zarr").episode(0), made)


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


def test_a_real_rejection_names_the_stage() -> None:
    """A crop that holds nothing."""
    recipe = load_recipe("metaworld", ["observer.crop={low: [50, 50, 50], high: [51, 51, 51]}", "expert.max_steps=2"])
    pipeline = recipe.pipeline()
    with pytest.raises(Rejected) as rejected:
        pipeline.run(EpisodeRequest(task="drawer-open", seed=0))
    stage, reason = rejected.value.args
    assert stage == "observer"
    assert reason.startswith("step 0: drawer-open: no point of the frame lies in the crop")
    counts = {name: (t.calls, t.rejects) for name, t in pipeline.tallies.items()}
    assert counts["expert"] == (1, 0)
    assert counts["observer"] == (1, 1)
    assert counts["queries"] == (0, 0)
