"""What it costs to open a dataset of many recordings: one unit, and so one shard, for each.

    python benchmarks/load.py                    # 2,000 units, three minutes
    python benchmarks/load.py --units 500 --json FILE

A few episodes are simulated, and repeated under other seeds until there are enough units. Then are timed: `validate`,
the first start of a training (its decoded arrays and its normalizer), and reading everything with zarr alone from the
folders that shards were before schema version 2. Times are CPU time of this process, memory is its peak.
"""

import os

os.environ.update(dict.fromkeys(["OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "LP_NUM_THREADS"], "1"))

import argparse
import json
import resource
import tempfile
import time
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import zarr

import flowlab
from flowlab.checksums import sha256_of
from flowlab.data.channels import infer_channels
from flowlab.data.normalizer import fit_normalizer
from flowlab.data.replay_buffer import load_buffer
from flowlab.data.source import open_training_source
from flowlab.policies.profiles import load_settings
from flowlab.storage.dataset import Dataset, begin, summarize
from flowlab.storage.receipts import Receipt, keep_receipt, shard_path
from flowlab.storage.shard import episode_digest, write_shard
from flowlab.storage.stats import summarize as statistics
from flowlab.storage.validation import validate


def many_units(folder: Path, made: Dataset, units: int) -> Dataset:
    """A dataset of so many units of one episode."""
    episodes = list(made)
    manifest = begin(folder, made.manifest.model_copy(update={"requested": {episodes[0].task: units}}))
    for seed in range(units):
        episode = replace(episodes[seed % len(episodes)], seed=seed)
        unit = f"{episode.task}-{seed:06d}"
        path = folder / shard_path("shards", unit)
        write_shard(path, [episode], manifest.settings_digest)
        keep_receipt(
            folder,
            Receipt(
                unit=unit, task=episode.task, seeds=(seed,), accepted=(seed,), frames=(len(episode),),
                digests=(episode_digest(episode),), shard_sha256=sha256_of(path), stats=statistics([episode]),
            ),
        )  # fmt: skip
    return summarize(folder)


def seconds(work: Callable[[], object]) -> float:
    """CPU time."""
    start = time.process_time()
    work()
    return time.process_time() - start


def start_training(data: Path, out: Path) -> None:
    """All that happens before the first step of a first training."""
    settings = load_settings("fast", "fdp")
    source = open_training_source(data)
    buffer = load_buffer(source, out)
    fit_normalizer(buffer, infer_channels(source, buffer), settings)


def read_with_zarr(folders: list[Path]) -> None:
    """All arrays of shards that are folders."""
    for folder in folders:
        for _, array in zarr.open_group(folder, mode="r").arrays():
            array[...]
        for name in ("data", "meta"):
            for _, array in zarr.open_group(folder / name, mode="r").arrays():
                array[...]


def main() -> None:
    """Measure, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--units", type=int, default=2000)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        place = Path(scratch)
        os.environ["FLOWLAB_CACHE"] = str(place / "cache")
        made = flowlab.extract("drawer-open", place / "made", episodes=8, workers=1)
        data = many_units(place / "data", made, options.units)
        files = sum(p.is_file() for p in (place / "data").rglob("*"))
        frames = sum(ref.frames for ref in data.refs)
        sample = min(100, options.units)
        folders = []
        for ref in data.refs[:sample]:
            folders.append(place / "folders" / Path(ref.shard).stem)
            with zipfile.ZipFile(data.path / ref.shard) as archive:
                archive.extractall(folders[-1])
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        found = {
            "units": options.units,
            "frames": frames,
            "files_per_unit": round(files / options.units, 2),
            "zarr_ms_per_unit": 1e3 * seconds(lambda: read_with_zarr(folders)) / sample,
            "read_ms_per_unit": 1e3 * seconds(lambda: [None for _ in data.episodes()]) / options.units,
            "validate_ms_per_unit": 1e3 * seconds(lambda: list(validate(data.path))) / options.units,
            "first_start_ms_per_unit": 1e3 * seconds(lambda: start_training(data.path, place / "run")) / options.units,
            "second_start_ms_per_unit": 1e3 * seconds(lambda: start_training(data.path, place / "run")) / options.units,
            "memory_mb_before": before / 1024,
            "memory_mb_peak": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        }
    for name, value in found.items():
        print(f"{name:<26} {value:,.2f}" if isinstance(value, float) else f"{name:<26} {value:,}")
    if options.json:
        options.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
