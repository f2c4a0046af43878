"""What the books of a large dataset cost: receipts made up after one that was really made, 16 episodes to a unit.

``docs/scale.md`` says what each column means. Times are CPU time of the process.
"""

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import flowlab
from flowlab.pipeline.scheduling import SeedScheduler
from flowlab.pipeline.units import JobShard, WorkUnit
from flowlab.storage.dataset import open_dataset, summarize
from flowlab.storage.receipts import Receipt, keep_receipt

PER_UNIT = 16
"""As many episodes as a unit of a large request has."""


def main() -> None:
    """Print a row for every size."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--episodes", type=int, nargs="+", default=[1_000, 10_000, 100_000])
    sizes = parser.parse_args().episodes
    print("| episodes | units | receipts | open | summarize | plan | progress |")
    print("|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as tmp:
        one = flowlab.extract("reach", Path(tmp) / "one", episodes=1, workers=1)
        for episodes in sizes:
            print(row(one, Path(tmp) / str(episodes), episodes), flush=True)


def row(one: flowlab.Dataset, folder: Path, episodes: int) -> str:
    """Sizes and times of a dataset with made-up receipts."""
    (real,) = one.receipts
    folder.mkdir()
    for name in "flowlab.json", "recipe.json":
        if (one.path / name).exists():
            (folder / name).write_bytes((one.path / name).read_bytes())
    receipts = [made_up(real, start) for start in range(0, episodes, PER_UNIT)]
    (folder / "receipts").mkdir()
    for receipt in receipts:
        keep_receipt(folder, receipt)
    size = sum(p.stat().st_size for p in (folder / "receipts").iterdir())
    plan = SeedScheduler({"reach": episodes}, 0)
    half = receipts[: len(receipts) // 2]
    times = [
        cpu_seconds(lambda: open_dataset(folder)),
        cpu_seconds(lambda: summarize(folder)),
        cpu_seconds(lambda: list(plan.next_units(half, [], JobShard()))),
        cpu_seconds(lambda: plan.progress(half)),
    ]
    return (
        f"| {episodes:,} | {len(receipts):,} | {size / 1e6:.1f} MB | " + " | ".join(f"{t:.3f} s" for t in times) + " |"
    )


def made_up(real: Receipt, start: int) -> Receipt:
    """A receipt of other seeds."""
    seeds = tuple(range(start, start + PER_UNIT))
    times = {"frames": real.frames * PER_UNIT, "digests": real.digests * PER_UNIT}
    unit = WorkUnit(task=real.task, seeds=seeds).name
    return real.model_copy(update={"unit": unit, "seeds": seeds, "accepted": seeds, **times})


def cpu_seconds(work: Callable[[], object]) -> float:
    """CPU time of a call."""
    start = time.process_time()
    work()
    return time.process_time() - start


if __name__ == "__main__":
    main()
