"""What is wrong with an experiment is found, in its results and in what is beside them."""

import gzip
from pathlib import Path

import pytest
from policy_results import EXAMPLE
from synthetic import call_cli, make_dataset, make_episode

from flowlab.benchmark.episode_columns import columns_path
from flowlab.benchmark.results import unit_path, write_result
from flowlab.storage.dataset import summarize

Capture = pytest.CaptureFixture[str]


@pytest.fixture
def experiment(tmp_path: Path) -> Path:
    for k, result in enumerate(EXAMPLE[:2]):
        write_result(unit_path(tmp_path / "e", f"unit-{k}"), result)
    make_dataset(tmp_path / "e/data/push", [[make_episode(0, task="push")]])
    summarize(tmp_path / "e/data/push")
    return tmp_path / "e"


def test_a_sound_experiment_is_sound(experiment: Path, capsys: Capture) -> None:
    assert call_cli(capsys, "validate", experiment)[:2] == (0, f"{experiment}: sound\n")


def test_every_damage_is_a_finding_of_its_own(experiment: Path, capsys: Capture) -> None:
    unit = unit_path(experiment, "unit-1")
    unit.write_text(unit.read_text().replace("1000", "1001", 1))
    columns = columns_path(unit_path(experiment, "unit-0"))
    rows = gzip.decompress(columns.read_bytes())
    columns.write_bytes(gzip.compress(rows.replace(b",1,1,", b",0,0,", 1)))
    [shard] = (experiment / "data/push/shards").iterdir()
    shard.unlink()
    code, out, err = call_cli(capsys, "validate", experiment)
    assert code == 3
    assert [line.partition(": ")[0] for line in out.splitlines()] == [str(columns), str(unit), str(shard)]
    assert "3 findings" in err
