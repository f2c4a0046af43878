"""Where a dataset comes from is said by its stages, whoever wrote them and whatever they are called."""

import json
import re
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


@pytest.mark.parametrize(
    ("body", "sentence"),
    [
        ("return None", "its describe returns None, expected a Provenance"),
        ("raise KeyError('x')", r"its describe fails \(KeyError: 'x'\)"),
        ("return known.model_copy(update={'action_limits': 'abc'})", "its describe says action_limits"),
        ("return known.model_copy(update={'action_limits': ((1.0,), (0.0,))})", "number 0 is from 1 to 0"),
        ("return known.model_copy(update={'action_limits': ((1.0,), (2.0, 3.0))})", "1 least and 2 greatest values"),
        ("return known.model_copy(update={'state': 5})", "its describe says state"),
        ("return known.model_copy(update={'scene': {'a': object()}})", "scene: holds what is no JSON"),
        (
            "c = Channels(name='g', index=(99,), kind='other', frame='', unit='1')\n"
            "        return known.model_copy(update={'action': (c,), 'action_limits': ((0.0,), (1.0,))})",
            "action: the channel 'g' has number 99, and there are 1",
        ),
    ],
)
def test_what_a_stage_says_wrong_is_told_before_anything_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], body: str, sentence: str
) -> None:
    name = f"stage_{abs(hash(body))}"
    (tmp_path / f"{name}.py").write_text(
        "from flowlab.pipeline.stages.simulation import ExpertStage\nfrom flowlab.provenance import Channels\n\n\n"
        f"class Odd(ExpertStage):\n    def describe(self, known, task):\n        {body}\n"
    )
    stages = [{"stage": s} for s in (f"{name}:Odd", "observer", "queries", "rigid-flow", "accept", "write")]
    (tmp_path / "r.yaml").write_text(json.dumps({"name": "test", "episodes": 1, "stages": stages}))
    code, _, errors = call_cli(
        capsys, "extract-sim", "drawer-open", "--recipe", tmp_path / "r.yaml", "--out", tmp_path / "d"
    )
    assert code == 2, errors
    assert f"stage '{name}:Odd'" in errors
    assert re.search(sentence, errors)
    assert not (tmp_path / "d/flowlab.json").exists()
