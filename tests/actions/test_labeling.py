"""State and actions of films against what is known of them: a gripper made by hand, and MuJoCo's own."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthetic import call_cli, make_dataset, make_provenance
from turning_robot import turning_demo, without_rows

import flowlab
from flowlab.records import Episode
from flowlab.storage.dataset import Dataset

_SETTINGS = {"observer": {"points": 400}, "queries": {"points": 60}}


def _dataset(folder: Path, episodes: list[Episode]) -> Path:
    about = make_provenance(_SETTINGS, state=None, action=None)
    make_dataset(folder, [[e] for e in episodes], settings=_SETTINGS, provenance=about)
    return folder


def _films(folder: Path, episodes: list[Episode], *names: str) -> Path:
    return _dataset(folder, [replace(e, **without_rows(e, *names), extras={}) for e in episodes])


@pytest.fixture(scope="module")
def truth() -> list[Episode]:
    return [turning_demo(seed) for seed in range(3, 6)]


@pytest.fixture(scope="module")
def labeled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return _dataset(tmp_path_factory.mktemp("labeled") / "data", [turning_demo(seed) for seed in range(3)])


@pytest.fixture(scope="module")
def inferred(tmp_path_factory: pytest.TempPathFactory, labeled: Path, truth: list[Episode]) -> Dataset:
    folder = tmp_path_factory.mktemp("inferred")
    films = _films(folder / "films", truth, "state", "action")
    return flowlab.label_actions(films, labeled, folder / "out", workers=1)


def _turns(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Angles between quaternions in degrees."""
    a, b = (Rotation.from_quat(x[:, 3:7]) for x in (found, true))
    return np.degrees((a.inv() * b).magnitude())


def test_position_rotation_and_opening_are_found_without_any_log(inferred: Dataset, truth: list[Episode]) -> None:
    assert len(inferred) == 3
    for film, true in zip(inferred, truth, strict=True):
        for found, known in ((film.state, true.state), (film.action, true.action)):
            assert np.median(np.linalg.norm(found[:, :3] - known[:, :3], axis=1)) < 0.003
            assert np.median(_turns(found, known)) < 2
            assert np.median(np.abs(found[:, 7] - known[:, 7])) < 0.003
        assert film.extras["label_actions"]["gripper"] == "tracks"
        assert film.extras["state_names"] == true.extras["state_names"]
