"""What a window with pictures costs: read from whole episodes, from the shards, or from decoded files.

    flowlab extract-sim push --episodes 10 --out data/push-rgb --set expert.scene.rgb=true \\
        --set expert.scene.renderer=gl --set write.depth=true
    python benchmarks/windows.py data/push-rgb

Windows of two color pictures, two depth pictures, two states and sixteen actions are read in random order. Times are
CPU time of this process; `start` is all that happens before the first window, with an empty cache.
"""

import os

os.environ.update(dict.fromkeys(["OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"], "1"))

import argparse
import json
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import flowlab
from flowlab.data import Windows

OFFSETS: dict[str, Sequence[int]] = {"rgb": [-1, 0], "depth": [-1, 0], "state": [-1, 0], "action": range(16)}


class WholeEpisodes:
    """The naive way: the window of an episode that is read whole."""

    def __init__(self, path: Path) -> None:
        self._dataset = flowlab.open_dataset(path)
        self._frames = [(k, t) for k, ref in enumerate(self._dataset.refs) for t in range(ref.frames)]

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, index: int) -> dict[str, np.ndarray]:
        k, t = self._frames[index]
        episode = self._dataset[k]
        rows = {key: np.clip(t + np.array(r), 0, len(episode) - 1) for key, r in OFFSETS.items()}
        return {key: getattr(episode, key)[r] for key, r in rows.items()}


def measure(make: Callable[[], Any], most_s: float) -> dict[str, float]:
    """CPU time until the first window [s], windows per second, and megabytes in the cache."""
    with tempfile.TemporaryDirectory() as cache:
        os.environ["FLOWLAB_CACHE"] = cache
        begin = time.process_time()
        windows = make()
        start = time.process_time() - begin
        order = np.random.default_rng(0).permutation(len(windows)).tolist()
        windows[order[0]]
        begin, count = time.process_time(), 0
        while (spent := time.process_time() - begin) < most_s:
            windows[order[count % len(order)]]
            count += 1
        megabytes = sum(p.stat().st_size for p in Path(cache).rglob("*") if p.is_file()) / 1e6
    return {"start_s": start, "windows_per_s": count / spent, "cache_mb": megabytes}


def main() -> None:
    """Measure, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--seconds", type=float, default=5.0, help="For each way.")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    data = options.dataset
    ways: dict[str, Callable[[], Any]] = {
        "whole episodes": lambda: WholeEpisodes(data),
        "from the shards": lambda: Windows(data, OFFSETS, pictures="stored"),
        "decoded": lambda: Windows(data, OFFSETS, pictures="decoded"),
    }
    found = {name: measure(make, options.seconds) for name, make in ways.items()}
    shards = sum(p.stat().st_size for p in (data / "shards").iterdir()) / 1e6
    print(f"{data}: shards of {shards:.1f} MB")
    for name, values in found.items():
        print(f"{name:<16} " + "  ".join(f"{key} {value:10,.2f}" for key, value in values.items()))
    if options.json:
        options.json.write_text(json.dumps({"shards_mb": shards, **found}, indent=1) + "\n")


if __name__ == "__main__":
    main()
