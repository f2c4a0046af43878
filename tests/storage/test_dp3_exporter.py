"""The exported store is what DP3's own loader, with its old zarr, reads."""

import json
import subprocess
import sys
from pathlib import Path

import numcodecs
import numpy as np
import pytest
from conftest import Cli
from synthetic import make_dataset, make_episode

from flowlab.records import Episode
from flowlab.storage.dataset import Dataset
from flowlab.storage.exporters.dp3 import DP3Exporter

TYPES = {"data/state": "<f4", "data/action": "<f4", "data/point_cloud": "<f4", "meta/episode_ends": "<i8"}


def read_v2(array: Path) -> np.ndarray:
    """An array of a zarr v2 store, put together from its chunk files as the format's specification says."""
    meta = json.loads((array / ".zarray").read_text())
    assert (meta["zarr_format"], meta["order"], meta["filters"]) == (2, "C", None)
    codec, separator = numcodecs.get_codec(meta["compressor"]), meta.get("dimension_separator", ".")
    shape, chunks = meta["shape"], meta["chunks"]
    values = np.full(shape, np.iinfo(np.int32).min, meta["dtype"])
    for index in np.ndindex(*(-(-n // c) for n, c in zip(shape, chunks, strict=True))):
        content = codec.decode((array / separator.join(map(str, index))).read_bytes())
        chunk = np.frombuffer(content, meta["dtype"]).reshape(chunks)
        window = tuple(slice(i * c, min((i + 1) * c, n)) for i, c, n in zip(index, chunks, shape, strict=True))
        values[window] = chunk[tuple(slice(w.stop - w.start) for w in window)]
    return values


def check_store(store: Path, episodes: list[Episode]) -> None:
    for group in (store, store / "data", store / "meta"):
        assert json.loads((group / ".zgroup").read_text()) == {"zarr_format": 2}
    found = {str(p.parent.relative_to(store)) for p in store.rglob(".zarray")}
    assert found == TYPES.keys()
    for name, dtype in TYPES.items():
        meta = json.loads((store / name / ".zarray").read_text())
        assert meta["dtype"] == dtype
        assert meta["chunks"] == [min(100, meta["shape"][0]), *meta["shape"][1:]]
        assert meta["compressor"] == {"id": "blosc", "cname": "zstd", "clevel": 3, "shuffle": 1, "blocksize": 0}
    ends = np.cumsum([len(e) for e in episodes])
    assert np.array_equal(read_v2(store / "meta/episode_ends"), ends)
    for name in ("state", "action", "point_cloud"):
        assert np.array_equal(read_v2(store / "data" / name), np.concatenate([getattr(e, name) for e in episodes]))


def test_a_whole_dataset_is_exported_in_order_of_task_and_seed(
    small_dataset: Path, tmp_path: Path, flowlab: Cli
) -> None:
    store = tmp_path / "dp3.zarr"
    result = flowlab("export", small_dataset, "--to", "dp3", "--out", store)
    assert result.returncode == 0, result.stderr
    assert result.stdout == f"6 episodes written to {store} for dp3\n"
    dataset = Dataset(small_dataset)
    check_store(store, [dataset.episode(k) for k in range(6)])
    assert sorted(p.name for p in tmp_path.iterdir()) == ["dp3.zarr"]


def test_one_task_is_exported(small_dataset: Path, tmp_path: Path, flowlab: Cli) -> None:
    result = flowlab("export", small_dataset, "--to", "dp3", "--task", "push-back", "--out", tmp_path / "s")
    assert result.returncode == 0, result.stderr
    dataset = Dataset(small_dataset)
    check_store(tmp_path / "s", [dataset.episode(k) for k, r in enumerate(dataset.refs) if r.task == "push-back"])


def test_episodes_find_their_place_however_they_lie_in_shards(tmp_path: Path) -> None:
    made = [make_episode(k, task=task, steps=40 + 33 * k) for task in ("push", "roll") for k in range(4)]
    units = [[made[6], made[4]], [made[0], made[1]], [made[7]], [made[5]], [made[2], made[3]]]
    assert DP3Exporter().export(make_dataset(tmp_path / "d", units), tmp_path / "s") == 8
    check_store(tmp_path / "s", made)


def test_what_exists_is_not_overwritten(small_dataset: Path, tmp_path: Path, flowlab: Cli) -> None:
    (tmp_path / "s").mkdir()
    (tmp_path / "s" / "precious").write_text("mine")
    result = flowlab("export", small_dataset, "--to", "dp3", "--out", tmp_path / "s")
    assert result.returncode == 3
    assert result.stderr == f"flowlab: {tmp_path / 's'}: exists already; remove it or choose another --out\n"
    assert [p.name for p in (tmp_path / "s").iterdir()] == ["precious"]


def test_a_damaged_dataset_leaves_no_store(tmp_path: Path, flowlab: Cli) -> None:
    dataset = make_dataset(tmp_path / "d", [[make_episode(0)], [make_episode(1)]])
    shard = tmp_path / "d" / dataset.receipts[1].shard
    shard.write_bytes(shard.read_bytes()[:-99])
    result = flowlab("export", tmp_path / "d", "--to", "dp3", "--out", tmp_path / "s")
    assert result.returncode == 3
    assert f"{shard}: not a readable shard" in result.stderr
    assert [p.name for p in tmp_path.iterdir()] == ["d"]


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--out", "s", "--task", "hamer"], "no episodes of 'hamer'; it has roll"),
        (["--out", "file/s"], "file/s: "),
    ],
)
def test_what_cannot_be_exported_is_said_in_one_sentence(
    tmp_path: Path, flowlab: Cli, arguments: list[str], sentence: str
) -> None:
    make_dataset(tmp_path / "d", [[make_episode(0)]])
    (tmp_path / "file").touch()
    result = flowlab("export", "d", "--to", "dp3", *arguments, cwd=tmp_path)
    assert result.returncode in (1, 3)
    assert sentence in result.stderr
    assert "Traceback" not in result.stderr
    assert sorted(p.name for p in tmp_path.iterdir()) == ["d", "file"]


AS_DP3_READS = """
import sys
import numpy, zarr
assert zarr.__version__ == "2.18.3", zarr.__version__
group = zarr.open(sys.argv[1], "r")
meta = {key: value[:] for key, value in group["meta"].items()}
data = {key: group["data"][key][:] for key in ["state", "action", "point_cloud"]}
numpy.savez(sys.argv[2], **meta, **data)
"""
"""What ReplayBuffer.copy_from_path of DP3 does with the keys of its MetaworldDataset."""


@pytest.mark.slow
def test_the_zarr_of_dp3_reads_the_store(tmp_path: Path) -> None:
    made = [make_episode(k, steps=60 + k) for k in range(4)]
    DP3Exporter().export(make_dataset(tmp_path / "d", [made]), tmp_path / "store.zarr")
    subprocess.run([sys.executable, "-m", "venv", tmp_path / "venv"], check=True)
    python = tmp_path / "venv/bin/python"
    install = [python, "-m", "pip", "install", "--quiet", "zarr==2.18.3", "numcodecs<0.14", "numpy<2"]
    subprocess.run(install, check=True)
    subprocess.run([python, "-c", AS_DP3_READS, tmp_path / "store.zarr", tmp_path / "read.npz"], check=True)
    read = np.load(tmp_path / "read.npz")
    assert np.array_equal(read["episode_ends"], np.cumsum([len(e) for e in made]))
    for name in ("state", "action", "point_cloud"):
        assert np.array_equal(read[name], np.concatenate([getattr(e, name) for e in made]))
