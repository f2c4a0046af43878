"""Where a dataset comes from is said by its stages, whoever wrote them and whatever they are called."""

import json
from pathlib import Path

import numpy as np
import pytest
from synthetic import call_cli, files_below

from flowlab.pipeline.recipe import load_recipe
from flowlab.sim.scene_settings import SceneSettings
from flowlab.sim.simulation import Simulation
from flowlab.storage.dataset import Dataset

OWN_EXPERT = '''
from flowlab.pipeline.stages.simulation import ExpertStage
from flowlab.pipeline.stage import EpisodeRequest
from flowlab.sim.recorder import Rollout


class Mine(ExpertStage):
    """As the built-in one, and says so."""

    def process(self, record: EpisodeRequest) -> Rollout:
        return super().process(record)
'''


def test_an_own_subclass_of_the_expert_makes_the_same_dataset(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The same bytes, fingerprint and provenance, though its stage has another name; neither goes on the other's."""
    place = tmp_path / "recipes"
    place.mkdir()
    (place / "own_expert.py").write_text(OWN_EXPERT)
    rest = ["observer", "queries", "rigid-flow", "accept", "write"]
    for name, expert in (("mine", "own_expert:Mine"), ("theirs", "expert")):
        stages = [{"stage": s} for s in (expert, *rest)]
        (place / f"{name}.yaml").write_text(json.dumps({"name": "test", "episodes": 2, "stages": stages}))
    for name in ("mine", "theirs"):
        command = ("extract-sim", "drawer-open", "--recipe", place / f"{name}.yaml", "--workers", 1)
        code, _, errors = call_cli(capsys, *map(str, command), "--out", tmp_path / name)
        assert code == 0, errors
    mine, theirs = Dataset(tmp_path / "mine"), Dataset(tmp_path / "theirs")
    assert list(mine.manifest.settings) == ["own_expert:Mine", *rest]
    bytes_of = [
        {name: content for name, (content, _) in files_below(d.path / "shards").items()} for d in (mine, theirs)
    ]
    assert bytes_of[0] == bytes_of[1]
    assert mine.fingerprint == theirs.fingerprint
    assert mine.manifest.provenance == theirs.manifest.provenance
    assert call_cli(capsys, "validate", mine.path)[0] == 0
    code, _, errors = call_cli(
        capsys, "extract-sim", "drawer-open", "--recipe", place / "mine.yaml", "--out", theirs.path
    )
    assert code == 3
    assert "own_expert:Mine" in errors


def test_a_simulated_dataset_says_what_its_numbers_mean(small_dataset: Path) -> None:
    """Against the simulator: the state says where hand and fingers are, actions where the hand is to go."""
    dataset = Dataset(small_dataset)
    known, episode = dataset.manifest.provenance, dataset.episode(0)
    assert (known.kind, known.simulator, known.tracks, known.tracker) == ("simulated", "metaworld", "exact", "")
    assert episode.camera.to_json() == known.camera
    assert known.state is not None
    assert known.action is not None
    place = {c.name: c for c in known.state}
    simulation = Simulation(episode.task, SceneSettings.model_validate(known.scene))
    simulation.reset(episode.seed)
    bodies = {"hand": "hand", "right finger": "rightclaw", "left finger": "leftclaw"}
    for name, body in bodies.items():
        where = episode.state[0, list(place[name].index)]
        assert np.linalg.norm(where - simulation.data.body(body).xpos) < 0.06
        assert (place[name].frame, place[name].unit, place[name].kind) == ("world", "m", "position")
    hand, gripper = known.action
    assert (hand.unit, hand.kind, hand.frame, gripper.kind) == ("cm", "displacement", "world", "effort")
    asked = episode.action[:, list(hand.index)].sum(0) * 0.01
    moved = episode.state[-1, :3] - episode.state[0, :3]
    assert asked @ moved / np.linalg.norm(asked) / np.linalg.norm(moved) > 0.9
    assert known.action_limits is not None
    low, high = known.action_limits
    assert ((episode.action >= low) & (episode.action <= high)).all()
    assert known.observer == dataset.manifest.settings["observer"]
    assert known.queries == dataset.manifest.settings["queries"]


def test_in_dp3s_frame_the_state_stays_in_the_simulators() -> None:
    known = load_recipe("metaworld-dp3").pipeline().provenance("hammer")
    assert known.state is not None
    assert known.action is not None
    assert {c.frame for c in known.state} == {"simulator"}
    assert [c.frame for c in known.action] == ["simulator", ""]
    assert known.camera["T_world_cam"][0][3] == 0
    assert known.world_frame.startswith("DP3's")


def test_a_dataset_of_recordings_says_what_is_known_of_it() -> None:
    known = load_recipe("real", ["track.tracker=lucas-kanade", "queries.points=8"]).pipeline().provenance("pour")
    assert (known.kind, known.tracks, known.tracker) == ("recorded", "estimated", "lucas-kanade")
    assert (known.state, known.action, known.action_limits, known.scene) == (None, None, None, None)
    assert known.camera == {}
    assert known.queries is not None
    assert known.queries["points"] == 8
