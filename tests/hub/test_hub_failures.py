"""Whatever fails on the way is one sentence that says what to type; what was begun goes on or leaves nothing."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from hub_server import Files, HubServer, standing_in, uploaded
from synthetic import call_cli, make_dataset, make_episode
from trained_runs import make_rolls

from flowlab.storage.dataset import Dataset

DATA = "datasets/anna/it"


@pytest.fixture
def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[HubServer]:
    with standing_in(monkeypatch, tmp_path) as server:
        yield server


@pytest.fixture(scope="module")
def rolls(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_rolls(tmp_path_factory.mktemp("data") / "rolls", 2)


@pytest.fixture(scope="module")
def files(rolls: Path, tmp_path_factory: pytest.TempPathFactory) -> Files:
    with pytest.MonkeyPatch.context() as patch:
        return uploaded(patch, rolls, tmp_path_factory.mktemp("home"))


def pull(capsys: pytest.CaptureFixture[str], out: Path, name: str = "anna/it", *options: str) -> tuple[int, str]:
    """Exit code and last sentence."""
    code, _, err = call_cli(capsys, "hub", "pull", name, "--out", out, *options)
    assert "Traceback" not in err
    return code, (err.splitlines() or [""])[-1]


def push(capsys: pytest.CaptureFixture[str], path: Path, name: str = "anna/it", *options: str) -> tuple[int, str]:
    code, _, err = call_cli(capsys, "hub", "push", path, name, "--yes", *options)
    assert err.count("\n") == bool(code), err
    return code, err.strip()


@pytest.mark.parametrize("name", ["it", "anna/it/more", "../it", "anna/..", "anna/it@", "anna/it@../x", "an na/it", ""])
def test_what_is_no_name_is_told_so(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, said = pull(capsys, tmp_path / "it", name)
    assert (code, "is no name on the Hub, expected user/name" in said) == (2, True)


def test_what_may_not_be_seen_is_told(
    files: Files, hub: HubServer, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    code, said = pull(capsys, tmp_path / "it")
    assert (code, "dataset or policy 'anna/it': there is none on the Hub, or it is private" in said) == (2, True)
    commit = hub.put(DATA, files, private=True)
    assert pull(capsys, tmp_path / "mine")[0] == 0, "with a token it is seen"
    assert pull(capsys, tmp_path / "first", f"anna/it@{commit}")[0] == 0
    code, said = pull(capsys, tmp_path / "it", "anna/it@v9")
    assert (code, "has no revision 'v9'; leave out '@...'" in said) == (2, True)
    monkeypatch.delenv("HF_TOKEN")
    code, said = pull(capsys, tmp_path / "it")
    assert (code, "hf auth login" in said) == (2, True)
    hub.put(DATA, files, private=False, gated=True)
    code, said = pull(capsys, tmp_path / "it")
    assert (code, "its owner must let you in" in said) == (1, True)
    assert not (tmp_path / "it").exists()


def test_a_push_that_may_not_be_is_told(
    rolls: Path, hub: HubServer, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    code, said = push(capsys, rolls, "others/it")
    assert (code, "your token may not do this" in said) == (1, True)
    monkeypatch.setenv("HF_TOKEN", "hf_wrong")
    code, said = push(capsys, rolls)
    assert (code, "the Hub does not know this token; log in with 'hf auth login'" in said) == (1, True)
    monkeypatch.delenv("HF_TOKEN")
    code, said = push(capsys, rolls)
    assert (code, "log in with 'hf auth login'" in said) == (1, True)
    assert hub.repos == {}


@pytest.mark.parametrize(("status", "sentence"), [(429, "asked too often; wait"), (503, "fails at the moment (503)")])
def test_a_hub_that_fails_is_told(
    status: int, sentence: str, rolls: Path, files: Files, hub: HubServer, tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    hub.put(DATA, files)
    for part in ("/api/datasets", "/resolve/"):
        hub.fails = lambda method, path, part=part: status if part in path else None  # type: ignore[misc]
        code, said = pull(capsys, tmp_path / "it")
        assert (code, sentence in said) == (1, True), said
    hub.fails = lambda method, path: status if "/commit/" in path else None
    code, said = push(capsys, rolls, "anna/it", "--license", "mit")
    assert (code, sentence in said) == (1, True), said
    assert not (tmp_path / "it").exists()


def test_without_a_network_it_is_told(
    tmp_path: Path, hub: HubServer, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HF_ENDPOINT", "http://127.0.0.1:9")
    code, said = pull(capsys, tmp_path / "it")
    assert (code, "the Hub cannot be reached" in said) == (1, True)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    code, said = pull(capsys, tmp_path / "it")
    assert code == 1


def test_a_pull_that_ended_goes_on(hub: HubServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = make_dataset(tmp_path / "four", [[make_episode(k)] for k in range(4)])
    push(capsys, data.path)
    last = "shards/roll-000003-000003.zarr.zip"
    hub.cuts = lambda name: name == last
    code, said = pull(capsys, tmp_path / "it")
    assert code == 1, said
    assert "the same command goes on" in said or "give the same command again" in said
    assert not (tmp_path / "it").exists()
    hub.cuts = lambda name: False
    hub.calls.clear()
    assert pull(capsys, tmp_path / "it")[0] == 0
    assert [c.rpartition("/")[2] for c in hub.calls if c.startswith("GET /datasets")] == [last.rpartition("/")[2]]
    assert Dataset(tmp_path / "it").fingerprint == data.fingerprint
    assert not [p for p in tmp_path.iterdir() if p.name.startswith(".")]


def test_what_is_in_the_way_stays(
    files: Files, hub: HubServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    hub.put(DATA, files)
    (tmp_path / "it").mkdir()
    (tmp_path / "it" / "mine").touch()
    code, said = pull(capsys, tmp_path / "it")
    assert (code, "is there already, and nothing is written over" in said) == (3, True)
    assert [p.name for p in (tmp_path / "it").iterdir()] == ["mine"]
    hub.put("models/anna/it", {"config.json": b"{}", "model.safetensors": b""})
    code, said = pull(capsys, tmp_path / "new")
    assert (code, "say --kind dataset or --kind policy" in said) == (2, True)
    assert pull(capsys, tmp_path / "new", "anna/it", "--kind", "dataset")[0] == 0


def test_what_cannot_be_shared_is_told(
    rolls: Path, hub: HubServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    damaged = make_dataset(tmp_path / "damaged", [[make_episode(0)]]).path
    shard = next((damaged / "shards").iterdir())
    shard.write_bytes(shard.read_bytes()[:-1] + b"x")
    for path, options, sentence in (
        (tmp_path, (), "holds nothing to push, expected a dataset"),
        (tmp_path / "none", (), "holds nothing to push"),
        (damaged, (), "damaged"),
        (rolls, ("--license", "Mine, all mine"), "is no license as the Hub names them"),
    ):
        code, said = push(capsys, path, "anna/it", *options)
        assert code in (2, 3)
        assert sentence in said
        assert "/tmp/flowlab-push" not in said
    assert push(capsys, rolls, "anna/it@main")[0] == 2
    assert hub.repos == {}
