"""Datasets that flowlab made before it had provenance (commit 79a7dbb): they open, mean the same, and go on growing.

What they must say of themselves, ``fixtures/old/datasets.json``, was written by the flowlab that made them.
"""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from synthetic import call_cli, files_below

from flowlab.storage.dataset import Dataset
from flowlab.storage.manifest import MANIFEST
from flowlab.storage.schema import SCHEMA
from flowlab.storage.shard import episode_digest

OLD = Path(__file__).parents[1] / "fixtures" / "old"
GOLDEN = json.loads((OLD / "datasets.json").read_text())
SAME_SIM = (
    "first_seed=76",
    "expert.max_steps=44",
    "expert.hold=5",
    "observer.points=32",
    "queries.points=12",
    "observer.remove_outliers.neighbors=15",
    "observer.remove_outliers.std_ratio=2.5",
)
SAME_REAL = (
    "observer.points=32",
    "queries.points=8",
    "observer.remove_outliers={neighbors: 12, std_ratio: 3.0}",
    "observer.remove_table={min_share: 0.95, trials: 50}",
    "quality.max_median_sigma_m=0.1",  # the default then
)


def sets(*changes: str) -> list[str]:
    return [word for change in changes for word in ("--set", change)]


@pytest.mark.parametrize("name", GOLDEN)
def test_an_old_dataset_holds_what_it_held(name: str) -> None:
    told, dataset = GOLDEN[name], Dataset(OLD / name)
    assert dataset.fingerprint == told["fingerprint"]
    assert dataset.manifest.settings_digest == told["settings_digest"]
    episodes = [dataset.episode(k) for k in range(len(dataset))]
    assert [(e.task, e.seed, len(e), episode_digest(e)) for e in episodes] == [
        (e["task"], e["seed"], e["frames"], e["digest"]) for e in told["episodes"]
    ]
    for spec in SCHEMA:
        parts = [part for e in episodes if (part := spec.of(e)) is not None]
        assert (spec.path in told["means"]) == bool(parts)
        if parts:
            mean = np.concatenate([p.reshape(-1) for p in parts]).mean(dtype=np.float64)
            assert mean == pytest.approx(told["means"][spec.path], rel=1e-6)


def test_an_old_simulated_dataset_says_where_it_comes_from() -> None:
    known = Dataset(OLD / "dataset-sim").manifest.provenance
    assert (known.kind, known.simulator, known.tracks) == ("simulated", "metaworld", "exact")
    assert known.scene is not None
    assert known.scene["camera"]["position"] == [0.6, 0.295, 0.8]
    assert known.state is not None
    assert [(c.name, c.index, c.frame, c.unit) for c in known.state] == [
        ("hand", (0, 1, 2), "world", "m"), ("right finger", (3, 4, 5), "world", "m"),
        ("left finger", (6, 7, 8), "world", "m"),
    ]  # fmt: skip
    assert known.action_limits == ((-1,) * 4, (1,) * 4)
    assert known.observer is not None
    assert known.observer["remove_outliers"] == {"neighbors": 15, "std_ratio": 2.5}
    assert known.camera["width"] == 128


def test_an_old_dataset_of_recordings_says_where_it_comes_from() -> None:
    dataset = Dataset(OLD / "dataset-real")
    known = dataset.manifest.provenance
    assert (known.kind, known.tracks, known.tracker) == ("recorded", "estimated", "rigid-bodies")
    assert (known.state, known.action, known.action_limits, known.camera) == (None, None, None, {})
    assert dataset.manifest.settings["track"]["tracker"] == "rigid-bodies"
    assert dataset.rejected(0).seed == 1


@pytest.mark.parametrize("name", GOLDEN)
def test_commands_read_an_old_dataset(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = files_below(OLD / name)
    code, output, errors = call_cli(capsys, "validate", OLD / name)
    assert (code, output.strip()) == (0, f"{OLD / name}: sound"), errors
    code, output, errors = call_cli(capsys, "info", OLD / name, "--json")
    assert code == 0, errors
    assert json.loads(output)["fingerprint"] == GOLDEN[name]["fingerprint"]
    code, _, errors = call_cli(capsys, "viz", OLD / name, "--png", tmp_path / "a.png")
    assert code == 0, errors
    assert (tmp_path / "a.png").stat().st_size > 10_000
    assert files_below(OLD / name) == before


def test_an_old_simulated_dataset_goes_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = shutil.copytree(OLD / "dataset-sim", tmp_path / "d")
    command = ["extract-sim", "reach", "--out", data, "--workers", "1", "--json"]
    before = files_below(data / "shards")
    code, output, errors = call_cli(capsys, *command, "--episodes", "3", *sets(*SAME_SIM))
    assert code == 0, errors
    assert json.loads(output)["fingerprint"] == GOLDEN["dataset-sim"]["fingerprint"]
    code, _, errors = call_cli(capsys, *command, "--episodes", "4", *sets(*SAME_SIM))
    assert code == 0, errors
    assert len(Dataset(data)) == 4
    assert before.items() <= files_below(data / "shards").items()
    assert call_cli(capsys, "validate", data)[0] == 0
    code, _, errors = call_cli(capsys, *command, "--episodes", "4", *sets(*SAME_SIM, "expert.hold=6"))
    assert code == 3
    assert "settings.expert.hold: the dataset has 5, this run has 6" in errors
    assert errors.count("the dataset has") == 1


def test_an_old_dataset_of_recordings_goes_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Its recordings lie elsewhere now, and one is new."""
    data = shutil.copytree(OLD / "dataset-real", tmp_path / "d")
    recordings = shutil.copytree(OLD / "recording", tmp_path / "recording") / "slide"
    shutil.copytree(recordings / "take-1", recordings / "take-3")
    command = ["track-real", recordings, "--out", data, "--workers", "1", "--json"]
    code, output, errors = call_cli(capsys, *command, *sets(*SAME_REAL))
    assert code == 0, errors
    assert json.loads(output)["episodes"] == 2
    assert [(r.task, r.seed) for r in Dataset(data).refs] == [("slide", 0), ("slide", 2)]
    assert call_cli(capsys, "validate", data)[0] == 0
    code, _, errors = call_cli(capsys, *command, *sets(*SAME_REAL, "track.chunks.length=30"))
    assert code == 3
    assert "settings.track.chunks.length: the dataset has 33, this run has 30" in errors


def test_what_an_old_run_could_not_open_is_tried_again(tmp_path: Path) -> None:
    data = shutil.copytree(OLD / "dataset-real", tmp_path / "d")
    receipt = data / "receipts" / "slide-000001.json"
    values = json.loads(receipt.read_text())
    values["rejects"][0]["stage"] = "recording"
    receipt.write_text(json.dumps(values))
    assert [x.retry for r in Dataset(data).receipts for x in r.rejects] == [True]


@pytest.mark.parametrize(
    "damage",
    [
        {"settings": {"expert": {}}},
        {"settings": {"expert": None, "observer": 3}},
        {"settings": {"track": {}}},
        {"settings": {"track": [], "recording": 1}},
        {"settings": 7},
        {"camera": 3},
        {"world_frame": None},
    ],
)
def test_a_damaged_old_manifest_is_one_sentence(
    tmp_path: Path, damage: dict[str, object], capsys: pytest.CaptureFixture[str]
) -> None:
    data = shutil.copytree(OLD / "dataset-sim", tmp_path / "d")
    values = json.loads((data / MANIFEST).read_text())
    (data / MANIFEST).write_text(json.dumps(values | damage))
    code, _, errors = call_cli(capsys, "info", data)
    assert code in (0, 3)
    assert code == 0 or errors.startswith(f"flowlab: {data / MANIFEST}: ")
