"""Datasets without actions or state, as of films: what each command does with them."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from synthetic import call_cli, make_dataset, make_episode, make_provenance

import flowlab
from flowlab.storage.dataset import Dataset

_SMALL = ("observer.points=64", "queries.points=16")


@pytest.fixture(scope="module")
def films(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One simulated demonstration, and one made by hand as track-real makes them, without state and actions."""
    folder = tmp_path_factory.mktemp("films")
    flowlab.extract("push", folder / "simulated", episodes=1, settings=_SMALL, without=("actions", "state"), workers=1)
    episode = make_episode()
    none = np.zeros((len(episode), 0), np.float32)
    make_dataset(
        folder / "recorded",
        [[replace(episode, state=none, action=none)]],
        provenance=make_provenance(state=None, action=None),
    )
    return folder


def test_extract_sim_leaves_out_what_it_is_asked_to(films: Path) -> None:
    dataset = Dataset(films / "simulated")
    assert dataset[0].state.shape == dataset[0].action.shape == (len(dataset[0]), 0)
    assert dataset.manifest.provenance.state == dataset.manifest.provenance.action == ()
    assert dataset.manifest.provenance.action_limits is None


@pytest.mark.parametrize("kind", ["simulated", "recorded"])
def test_every_command_works_or_says_why_not(
    kind: str, films: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = films / kind
    code, out, error = call_cli(capsys, "validate", data)
    assert (code, out) == (0, f"{data}: sound\n")
    assert f"warning: {data}: the episodes have no actions" in error
    about = json.loads(call_cli(capsys, "info", data, "--json")[1])
    assert about["provenance"]["state"] == about["provenance"]["action"] == []
    assert call_cli(capsys, "viz", data, "--episode", "0", "--png", tmp_path / "look.png")[0] == 0
    for arguments in (["train", data, "--policy", "dp3"], ["export", data, "--to", "dp3"]):
        code, _, error = call_cli(capsys, *arguments, "--out", tmp_path / "out")
        assert code == 3
        assert error.count("\n") == 1
        assert f"{data}: the episodes have no actions" in error
        assert f"flowlab label-actions {data} --from" in error
        assert not (tmp_path / "out").exists()


def test_what_cannot_be_left_out_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, _, error = call_cli(capsys, "extract-sim", "push", "--without", "action", "--out", tmp_path / "out")
    assert code == 2
    assert "did you mean actions?" in error
