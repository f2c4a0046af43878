"""What is pushed comes back as it was: datasets to the byte, policies to the action."""

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
import yaml
from hub_server import HubServer, standing_in
from synthetic import call_cli, files_below, make_dataset, make_episode
from trained_runs import SMALL, make_rolls, make_run

from flowlab.data.batch_builder import BatchBuilder
from flowlab.data.replay_buffer import load_buffer
from flowlab.data.source import open_training_source
from flowlab.data.window_sampler import index_windows
from flowlab.policies.base import PolicyNetwork
from flowlab.policies.checkpoint import load_policy
from flowlab.storage.dataset import Dataset


@pytest.fixture
def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[HubServer]:
    with standing_in(monkeypatch, tmp_path) as server:
        yield server


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs")
    return make_run(make_rolls(folder / "rolls"), "--policy", "fdp", "--out", folder / "rolls-fdp", *SMALL)


def shards_of(folder: Path) -> dict[str, bytes]:
    return {name: content for name, (content, _) in files_below(folder).items() if name.endswith(".zip")}


@pytest.mark.parametrize("lfs", [False, True])
def test_a_dataset_comes_back_to_the_byte(
    lfs: bool, hub: HubServer, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    hub.uses_lfs = lfs
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_DISABLE_XET", lfs)
    data = make_dataset(tmp_path / "rolls", [[make_episode(k, steps=20)] for k in range(3)])
    code, out, err = call_cli(capsys, "hub", "push", data.path, "anna/rolls", "--yes", "--license", "cc-by-4.0")
    assert code == 0, err
    files = hub.files("datasets/anna/rolls")
    listed = {line.split("  ")[0] for line in out.splitlines() if "  " in line}
    assert listed == {*files} - {".gitattributes"}, "what is uploaded is what was listed"
    assert bool(hub.stored) == lfs
    code, out, err = call_cli(capsys, "hub", "pull", "anna/rolls", "--out", tmp_path / "back")
    assert code == 0, err
    assert shards_of(tmp_path / "back") == shards_of(data.path)
    assert call_cli(capsys, "validate", tmp_path / "back")[0] == 0
    back = Dataset(tmp_path / "back")
    assert back.fingerprint == data.fingerprint
    assert back.provenance.license == "cc-by-4.0"
    assert back.provenance.hub == f"anna/rolls@{hub.repos['datasets/anna/rolls'].newest}"
    assert {p.name for p in tmp_path.iterdir()} <= {"rolls", "back", "cache"}, "nothing is left beside it"


def test_the_card_says_what_the_hub_indexes(hub: HubServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    call_cli(capsys, "hub", "push", make_rolls(tmp_path / "rolls"), "anna/rolls", "--yes")
    files = hub.files("datasets/anna/rolls")
    head = yaml.safe_load(files["README.md"].decode().split("---\n")[1])
    assert head["license"] == "unknown"
    assert head["size_categories"] == ["n<1K"]
    assert {"robotics", "flowlab", "roll"} <= {*head["tags"]}
    assert "License: not stated" in files["README.md"].decode()
    assert files["picture.png"].startswith(b"\x89PNG")


def test_a_run_learns_from_a_dataset_on_the_hub(
    hub: HubServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    call_cli(capsys, "hub", "push", make_rolls(tmp_path / "rolls"), "anna/rolls", "--yes")
    command = ("train", "hub:anna/rolls", "--policy", "dp3", *SMALL, "--set", "run.steps=1")
    code, _, err = call_cli(capsys, *command, "--out", tmp_path / "run")
    assert code == 0, err
    commit = hub.repos["datasets/anna/rolls"].newest
    hub.fails = lambda method, path: 500
    pinned = (command[0], f"hub:anna/rolls@{commit}", *command[2:])
    assert call_cli(capsys, *pinned, "--out", tmp_path / "again")[0] == 0, "a commit that is here needs no Hub"
    code, _, err = call_cli(capsys, *command, "--out", tmp_path / "third")
    assert code == 1
    assert f"without the Hub there is hub:anna/rolls@{commit}" in err
    hub.fails = lambda method, path: None
    assert call_cli(capsys, "hub", "push", tmp_path / "run", "anna/rolls-dp3", "--yes")[0] == 0
    card = hub.files("models/anna/rolls-dp3")["README.md"].decode()
    assert yaml.safe_load(card.split("---\n")[1])["datasets"] == ["anna/rolls"]


def test_a_policy_comes_back_to_the_action(
    hub: HubServer, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, _, err = call_cli(capsys, "hub", "push", run, "anna/rolls-fdp", "--yes", "--license", "mit")
    assert code == 0, err
    files = hub.files("models/anna/rolls-fdp")
    assert {*files} == {".gitattributes", "README.md", "config.json", "model.safetensors", "picture.png"}
    assert str(run.parent).encode() not in b"".join(files.values())
    code, _, err = call_cli(capsys, "hub", "pull", "anna/rolls-fdp", "--out", tmp_path / "back")
    assert code == 0, err
    ours, theirs = load_policy(run), load_policy(tmp_path / "back")
    assert theirs.trained.license == "mit"
    assert theirs.trained.hub.startswith("anna/rolls-fdp@")
    assert theirs.trained.dataset == "rolls"
    assert plans(run.parent / "rolls", theirs.policy) == plans(run.parent / "rolls", ours.policy)
    assert call_cli(capsys, "validate", tmp_path / "back") == (0, f"{tmp_path / 'back'}: sound\n", "")


def plans(data: Path, policy: PolicyNetwork) -> list[float]:
    """What a policy would do in every window of a dataset."""
    buffer, settings = load_buffer(open_training_source(data), data), policy.spec.settings
    every = index_windows(buffer, list(range(len(buffer.episodes))), settings.n_action_steps)
    batch = BatchBuilder(buffer, policy.spec.channels, settings, policy.spec.tasks).build(every)
    return policy.plan(batch, torch.Generator().manual_seed(3)).action.flatten().tolist()  # type: ignore[no-any-return]


def test_another_push_replaces_what_the_first_left(
    hub: HubServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make_dataset(tmp_path / "two", [[make_episode(0)], [make_episode(1)]])
    call_cli(capsys, "hub", "push", tmp_path / "two", "anna/rolls", "--yes")
    hub.put("datasets/anna/rolls", {**hub.files("datasets/anna/rolls"), "notes.txt": b"mine"})
    make_dataset(tmp_path / "other", [[make_episode(7)]])
    code, out, err = call_cli(capsys, "hub", "push", tmp_path / "other", "anna/rolls", "--yes")
    assert code == 0, err
    assert "deleted there: shards/roll-000000-000000.zarr.zip" in out
    files = hub.files("datasets/anna/rolls")
    assert [name for name in files if name.startswith("shards/")] == ["shards/roll-000007-000007.zarr.zip"]
    assert files["notes.txt"] == b"mine"
    assert call_cli(capsys, "hub", "pull", "anna/rolls", "--out", tmp_path / "back")[0] == 0
    assert Dataset(tmp_path / "back").fingerprint == Dataset(tmp_path / "other").fingerprint


def test_a_dry_run_lists_all_and_asks_nobody(
    hub: HubServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = make_dataset(tmp_path / "many", [[make_episode(k)] for k in range(22)])
    code, out, _ = call_cli(capsys, "hub", "push", data.path, "anna/rolls", "--dry-run")
    assert code == 0
    assert all(f"receipts/roll-{k:06d}-{k:06d}.json  " in out for k in range(22))
    assert hub.calls == []
    code, out, _ = call_cli(capsys, "hub", "push", data.path, "anna/rolls", "--dry-run", "--json")
    assert len(json.loads(out)["files"]) == 44 + 5


def test_nothing_is_uploaded_that_nobody_agreed_to(
    hub: HubServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, _, err = call_cli(capsys, "hub", "push", make_rolls(tmp_path / "rolls"), "anna/rolls")
    assert code == 2
    assert "give --yes" in err
    assert hub.repos == {}


def test_a_pull_again_is_done_already(hub: HubServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    call_cli(capsys, "hub", "push", make_rolls(tmp_path / "rolls"), "anna/rolls", "--yes", "--private")
    assert hub.repos["datasets/anna/rolls"].private
    for said in ("is dataset", "was already dataset"):
        code, out, _ = call_cli(capsys, "hub", "pull", "anna/rolls", "--out", tmp_path / "back")
        assert (code, said in out) == (0, True)
