"""Repositories of strangers: nothing of theirs runs, nothing is written beside the folder, and what is unsound goes."""

import json
import pickle
import zipfile
from collections.abc import Callable, Iterator
from hashlib import sha256
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hub_server import Files, HubServer, standing_in, uploaded
from safetensors.numpy import load, save
from synthetic import call_cli, make_dataset, make_episode
from trained_runs import SMALL, make_rolls, make_run

from flowlab.checksums import with_checksum

SHARD = "shards/roll-000000-000001.zarr.zip"
RECEIPT = "receipts/roll-000000-000001.json"


@pytest.fixture
def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[HubServer]:
    with standing_in(monkeypatch, tmp_path) as server:
        yield server


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Files:
    folder = tmp_path_factory.mktemp("dataset")
    make_dataset(folder / "rolls", [[make_episode(0), make_episode(1)]])
    with pytest.MonkeyPatch.context() as patch:
        return uploaded(patch, folder / "rolls", folder)


@pytest.fixture(scope="module")
def policy(tmp_path_factory: pytest.TempPathFactory) -> Files:
    folder = tmp_path_factory.mktemp("policy")
    run = make_run(make_rolls(folder / "rolls"), "--policy", "dp3", "--out", folder / "run", *SMALL)
    with pytest.MonkeyPatch.context() as patch:
        return uploaded(patch, run, folder)


class Malicious:
    """Writes a file where it is unpickled."""

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[str, str]]:
        return (open, ("/tmp/flowlab-was-here", "w"))


def edited(content: bytes, change: Callable[[dict[str, Any]], object]) -> bytes:
    """JSON with a change in it, and the checksum that it should have then."""
    values = json.loads(content)
    values.pop("sha256")
    change(values)
    return json.dumps(with_checksum(values)).encode()


def zipped(shard: bytes, method: int = zipfile.ZIP_STORED, **more: bytes) -> bytes:
    """A shard packed anew, with further members."""
    buffer = BytesIO()
    with zipfile.ZipFile(BytesIO(shard)) as old, zipfile.ZipFile(buffer, "w", method) as new:
        for member in old.infolist():
            new.writestr(zipfile.ZipInfo(member.filename), old.read(member), method)
        for name, content in more.items():
            new.writestr(name, content)
    return buffer.getvalue()


def with_shard(files: Files, shard: bytes) -> Files:
    """A dataset with another shard, whose receipt knows it."""
    receipt = edited(files[RECEIPT], lambda r: r.update(shard_sha256=sha256(shard).hexdigest()))
    return {**files, SHARD: shard, RECEIPT: receipt}


def of_task(values: dict[str, Any], task: str) -> None:
    values["requested"] = {task: 2}


DATASETS: dict[str, tuple[Callable[[Files], Files], str]] = {
    "not a dataset": (lambda f: {"data.csv": b"1,2"}, "holds no flowlab"),
    "leads out": (lambda f: {**f, "shards/../../evil.zarr.zip": b"x"}, "has a file called"),
    "leads down": (lambda f: {**f, "shards/a/b.zarr.zip": b"x"}, "has a file called 'shards/a/b.zarr.zip'"),
    "hidden": (lambda f: {**f, "receipts/.x.json": b"{}"}, "has a file called 'receipts/.x.json'"),
    "escapes the terminal": (lambda f: {**f, "receipts/\x1b[2Jx.json": b"{}"}, "has a file called"),
    "no shard": (lambda f: {n: c for n, c in f.items() if n != SHARD}, f"lacks {SHARD}"),
    "one shard too many": (lambda f: {**f, "shards/x.zarr.zip": b"x"}, "shards/x.zarr.zip, which no receipt counts"),
    "manifest is a link": (lambda f: {**f, "flowlab.json": b"/etc/passwd"}, "not valid JSON"),
    "manifest is nested": (lambda f: {**f, "flowlab.json": b"[" * 100_000}, "nested too deep"),
    "task leads out": (
        lambda f: {**f, "flowlab.json": edited(f["flowlab.json"], lambda m: of_task(m, "../x"))}, "no plain name",
    ),
    "unit leads out": (
        lambda f: {**f, RECEIPT: edited(f[RECEIPT], lambda r: r.update(unit="../../x"))}, "no plain name",
    ),
    "shard was changed": (lambda f: {**f, SHARD: f[SHARD][:-30] + b"x" * 30}, "does not match the checksum"),
    "shard is a pickle": (lambda f: with_shard(f, pickle.dumps(Malicious())), "not a readable shard"),
    "shard is compressed": (lambda f: with_shard(f, zipped(f[SHARD], zipfile.ZIP_DEFLATED)), "is compressed"),
    "shard leads out": (lambda f: with_shard(f, zipped(f[SHARD], **{"../../evil": b"x"})), "is called '../../evil'"),
    "shard is empty": (lambda f: with_shard(f, b""), "not a readable shard"),
    "numbers are none": (
        lambda f: {**f, RECEIPT: edited(f[RECEIPT], lambda r: r.update(frames=[1 << 70, 12]))}, "its receipt says",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", DATASETS)
def test_a_hostile_dataset_is_one_sentence_and_leaves_nothing(
    case: str, dataset: Files, hub: HubServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    change, sentence = DATASETS[case]
    hub.put("datasets/eve/it", change(dataset))
    code, out, err = call_cli(capsys, "hub", "pull", "eve/it", "--out", tmp_path / "in" / "it")
    assert code == 3, (out, err)
    assert sentence in err
    assert not any(made in err for made in (".pull-", ".tmp-")), "it names a folder that is gone"
    assert "\x1b" not in err
    assert [line for line in err.splitlines() if not line.startswith(("flowlab: ", "pulling "))] == []
    assert not (tmp_path / "in").exists() or [*(tmp_path / "in").iterdir()] == [], "something was left"
    assert {p.name for p in tmp_path.iterdir()} <= {"in", "cache"}
    assert not Path("/tmp/flowlab-was-here").exists()


def test_sizes_are_held_against_what_is_said(
    dataset: Files, hub: HubServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for sizes, sentence in (
        ({SHARD: 65 << 30}, f"{SHARD} has 69,793,218,560 bytes, expected at most"),
        ({"flowlab.json": 65 << 20}, "flowlab.json has 68,157,440 bytes"),
        ({SHARD: len(dataset[SHARD]) + 1}, "Consistency check"),
        ({SHARD: -1}, "has -1 bytes"),
        ({f"shards/{k}.zarr.zip": 60 << 30 for k in range(100)}, "GB are to be pulled; make room"),
        ({f"shards/{k}.zarr.zip": 0 for k in range(10_001)}, "10,002 files in shards, and a folder on the Hub takes"),
    ):
        hub.put("datasets/eve/it", {**dict.fromkeys(sizes, b""), **dataset}, listed=sizes)
        hub.calls.clear()
        code, _, err = call_cli(capsys, "hub", "pull", "eve/it", "--out", tmp_path / "it")
        assert code in (1, 3)
        assert sentence in err or (sentence == "Consistency check" and "bytes instead of" in err), err
        assert not (tmp_path / "it").exists()
        if sentence != "Consistency check":
            assert not any("/resolve/" in call for call in hub.calls), "nothing is fetched before it is known"


def test_only_the_files_of_a_dataset_are_fetched(
    dataset: Files, hub: HubServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    more = {
        "setup.py": b"print()",
        "shards/evil.pkl": pickle.dumps(Malicious()),
        "flowlab.json.py": b"",
        "x/y.json": b"",
    }
    hub.put("datasets/eve/it", {**dataset, **more})
    assert call_cli(capsys, "hub", "pull", "eve/it", "--out", tmp_path / "it")[0] == 0
    fetched = {call.rpartition("/resolve/")[2].partition("/")[2] for call in hub.calls if "/resolve/" in call}
    assert fetched == {"flowlab.json", SHARD, RECEIPT}
    made = {str(p.relative_to(tmp_path / "it")) for p in (tmp_path / "it").rglob("*") if p.is_file()}
    assert made == {"flowlab.json", SHARD, RECEIPT, "stats.json", "rejects.jsonl", "README.md"}


def test_a_link_where_it_is_staged_is_refused(
    dataset: Files, hub: HubServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    commit = hub.put("datasets/eve/it", dataset)
    (tmp_path / "other").mkdir()
    (tmp_path / f".pull-{commit[:12]}+it").symlink_to(tmp_path / "other")
    code, _, err = call_cli(capsys, "hub", "pull", "eve/it", "--out", tmp_path / "it")
    assert (code, "is a link" in err) == (3, True)
    assert [*(tmp_path / "other").iterdir()] == []


def settings(values: dict[str, Any]) -> dict[str, Any]:
    found: dict[str, Any] = values["policy"]["settings"]
    return found


def reweighed(files: Files, change: Callable[[dict[str, np.ndarray]], object]) -> bytes:
    """Weights with a change, and the metadata that they had."""
    content = files["model.safetensors"]
    tensors = load(content)
    header = json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])
    change(tensors)
    return save(tensors, header["__metadata__"])


POLICIES: dict[str, tuple[Callable[[Files], Files], str]] = {
    "somebody else's": (lambda f: {**f, "config.json": b'{"type": "act"}'}, "config.json"),
    "no weights": (lambda f: {"config.json": f["config.json"]}, "it has no model.safetensors"),
    "names code": (
        lambda f: {**f, "config.json": edited(f["config.json"], lambda v: settings(v).update(policy="antigravity:X"))},
        "is not imported",
    ),
    "weights are a pickle": (lambda f: {**f, "model.safetensors": pickle.dumps(Malicious())}, "damaged"),
    "settings were edited": (
        lambda f: {**f, "config.json": edited(f["config.json"], lambda v: v["policy"].update(tasks=["x"]))},
        "saved beside another",
    ),
    "weights were edited": (
        lambda f: {**f, "model.safetensors": reweighed(f, lambda w: next(iter(w.values())).fill(0))},
        "does not match its checksum",
    ),
    "config is a link": (lambda f: {**f, "config.json": b"../../../etc/passwd"}, "not valid JSON"),
    "weights are empty": (lambda f: {**f, "model.safetensors": b""}, "damaged"),
}


@pytest.mark.parametrize("case", POLICIES)
def test_a_hostile_policy_is_one_sentence_and_leaves_nothing(
    case: str, policy: Files, hub: HubServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    change, sentence = POLICIES[case]
    hub.put("models/eve/it", change(policy))
    code, out, err = call_cli(capsys, "hub", "pull", "eve/it", "--out", tmp_path / "in" / "it")
    assert code == 3, (out, err)
    assert sentence in err
    assert not any(made in err for made in (".pull-", ".tmp-")), "it names a folder that is gone"
    assert [line for line in err.splitlines() if not line.startswith(("flowlab: ", "pulling "))] == []
    assert not (tmp_path / "in").exists() or [*(tmp_path / "in").iterdir()] == [], "something was left"
    assert not Path("/tmp/flowlab-was-here").exists()
