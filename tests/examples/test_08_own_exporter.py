"""Example 8 keeps what is asked of an exporter, and its command writes what the dataset holds."""

from pathlib import Path

import numpy as np
import pytest
from run_example import EXAMPLES, run_example
from synthetic import call_cli, make_dataset, make_episode


def test_it_keeps_its_promises_and_writes_every_episode(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    episodes = [make_episode(seed, task=task) for task in ("push", "reach") for seed in (3, 4)]
    make_dataset(tmp_path / "data", [episodes[:2], episodes[2:]])
    assert "keeps all" in run_example("08_own_exporter.py", tmp_path / "data")
    monkeypatch.syspath_prepend(str(EXAMPLES))
    code, _, err = call_cli(
        capsys,
        "export",
        tmp_path / "data",
        "--to",
        "08_own_exporter:NpzExporter",
        "--out",
        tmp_path / "npz",
    )
    assert code == 0, err
    for episode in episodes:
        with np.load(tmp_path / "npz" / f"{episode.task}-{episode.seed:06d}.npz") as arrays:
            np.testing.assert_array_equal(arrays["tracks"], episode.tracks.xyz_world)
            np.testing.assert_array_equal(arrays["action"], episode.action)
