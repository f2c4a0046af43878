"""What it costs to make the dataset: CPU time per frame of flowlab, and of two other ways to the same clouds.

``benchmarks/README.md`` says what each row means. Times are CPU time of the process, all threads included,
with every library held to one thread; the ways take turns, so that a busy machine slows all of them alike.
"""

import os

os.environ.update(dict.fromkeys(["OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "LP_NUM_THREADS"], "1"))
os.environ.setdefault("MUJOCO_GL", "egl")  # before mujoco is imported

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from statistics import fmean, median
from typing import Any

import careful_user
import dp3_steps
import numpy as np
from scipy.spatial import cKDTree

from flowlab.perception.observer import Observer
from flowlab.pipeline.recipe import load_recipe
from flowlab.pipeline.stage import EpisodeRequest
from flowlab.pipeline.stages.simulation import ExpertStage, ObserverStage
from flowlab.pipeline.units import WorkUnit
from flowlab.pipeline.worker import run_unit

TASKS = ["hammer", "push", "door-open", "shelf-place", "assembly"]
DP3_STEPS, DP3_TASKS = 20, 2
"""DP3's steps take about a hundred times as long, so only this much of them is timed: first steps, first tasks."""
SAME_COUNT, SAME_PLACE, SAME_SHARE = 0.002, 1e-3, 0.999
"""Two clouds count as the same if their sizes differ by less than this share, and this share of their points
has a point of the other cloud within so many meters."""

OURS = "flowlab"

Times = dict[str, dict[str, list[float]]]
"""CPU milliseconds per frame, by way and task: one value per repeat."""


@dataclass(frozen=True)
class Baseline:
    """Another way to the clouds: a script beside this one, set up for one task."""

    name: str
    recipe: str
    """The recipe of ours that makes the same clouds."""
    extractor: careful_user.Extractor | dp3_steps.Extractor
    limit: int | None = None
    """Frames to do of each episode, from its start; None for all."""

    def frames(self, seed: int) -> Iterator[np.ndarray]:
        """All cropped points (P, 3) of every frame; their sample is made and let go."""
        for cloud, _ in islice(self.extractor.frames(seed), self.limit):
            yield cloud[:, :3]


class Bench:
    """The ways to make the clouds of one task, set up and warm: environments built, kernels compiled."""

    def __init__(self, task: str, folder: Path, *, with_dp3: bool) -> None:
        self.task, self.folder = task, folder
        recipe = load_recipe("metaworld", ["accept.success_steps=0"])  # count failed episodes too
        self.pipeline, self.recipe_json = recipe.pipeline(), recipe.model_dump_json()
        self.baselines = [
            Baseline("careful user", "metaworld", careful_user.Extractor(task)),
            Baseline("careful user, segmentation", "metaworld", careful_user.Extractor(task, static_once=False)),
        ]
        if with_dp3:
            unshaded = dp3_steps.Extractor(task, shadows=False)
            self.baselines += [
                Baseline("DP3's steps", "metaworld-dp3", dp3_steps.Extractor(task), DP3_STEPS),
                Baseline("DP3's steps, no shadows", "metaworld-dp3", unshaded, DP3_STEPS),
            ]

    def close(self) -> None:
        """Free the OpenGL contexts."""
        for baseline in self.baselines:
            baseline.extractor.renderer.close()

    def compare(self) -> Iterator[dict[str, Any]]:
        """How far each baseline's clouds of seed 0 are from ours. This also warms everything up."""
        for baseline in self.baselines:
            yield {"task": self.task, "way": baseline.name} | difference(
                our_clouds(baseline.recipe, self.task, 0), baseline.frames(0), whole=baseline.limit is None
            )
        self._ours(0)
        self._writing(0)

    def ways(self) -> dict[str, Callable[[int], int]]:
        """What is timed, by name: each does its work for a seed and says how many frames that gave."""
        theirs = {b.name: lambda seed, b=b: sum(1 for _ in b.frames(seed)) for b in self.baselines}
        return {OURS: self._ours, f"{OURS}, with writing": self._writing} | theirs

    def _ours(self, seed: int) -> int:
        return len(self.pipeline.run(EpisodeRequest(task=self.task, seed=seed)))

    def _writing(self, seed: int) -> int:
        unit = WorkUnit(task=self.task, seeds=(2 * seed, 2 * seed + 1))
        return sum(run_unit(self.recipe_json, "benchmark", self.folder, unit).frames)


def our_clouds(recipe: str, task: str, seed: int) -> Iterator[np.ndarray]:
    """All cropped points (P, 3) of every frame, as flowlab sees them before sampling."""
    stages = load_recipe(recipe).stages
    expert = next(s for s in stages if isinstance(s, ExpertStage))
    rollout = expert.process(EpisodeRequest(task=task, seed=seed))
    observer = Observer(next(s for s in stages if isinstance(s, ObserverStage)), task)
    for t in range(len(rollout)):
        yield observer.cloud(rollout.frame(t)).xyz_world


def difference(ours: Iterator[np.ndarray], theirs: Iterator[np.ndarray], *, whole: bool) -> dict[str, Any]:
    """How far clouds are from ours, frame by frame; ``whole`` demands that there be as many of them."""
    gaps, sizes = [], []
    for a, b in zip(ours, theirs, strict=whole):
        gaps += [cKDTree(a).query(b)[0], cKDTree(b).query(a)[0]]
        sizes.append((len(a), len(b)))
    n_ours, n_theirs = np.array(sizes).T
    count, share = float((abs(n_theirs - n_ours) / n_ours).max()), float((np.concatenate(gaps) < SAME_PLACE).mean())
    return {
        "frames": len(sizes),
        "points_per_frame": float(n_ours.mean()),
        "largest_count_difference": count,
        "share_within_1mm": share,
        "within_limits": count < SAME_COUNT and share >= SAME_SHARE,
    }


def measure(tasks: list[str], repeats: int) -> tuple[list[dict[str, Any]], Times]:
    """The comparisons, and the CPU times: one value per repeat, whose number is the seed."""
    rows: list[dict[str, Any]] = []
    times: Times = {}
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "receipts").mkdir()
        for k, task in enumerate(tasks):
            bench = Bench(task, Path(folder), with_dp3=k < DP3_TASKS)
            rows += bench.compare()
            for seed in range(repeats):
                for name, way in bench.ways().items():
                    start = time.process_time()
                    frames = way(seed)
                    spent = time.process_time() - start
                    times.setdefault(name, {}).setdefault(task, []).append(1e3 * spent / frames)
            bench.close()
    return rows, times


def summary(times: Times) -> list[dict[str, Any]]:
    """A row per way: medians over the repeats of its mean over tasks, and of the ratio to ours on those tasks."""
    rows = []
    for name, by_task in times.items():
        mine = [fmean(values) for values in zip(*by_task.values(), strict=True)]
        ours = [fmean(values) for values in zip(*(times[OURS][t] for t in by_task), strict=True)]
        rows.append(
            {
                "way": name,
                "tasks": len(by_task),
                "cpu_ms_per_frame": median(mine),
                "frames_per_s_per_core": 1e3 / median(mine),
                "times_ours": median(m / o for m, o in zip(mine, ours, strict=True)),
            }
        )
    return rows


def run_cli(tasks: list[str], episodes: int, workers: int) -> dict[str, Any]:
    """One ``flowlab extract-sim`` into a temporary folder: wall time, start included, and CPU time of the stages."""
    start = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        options = ["--episodes", str(episodes), "--workers", str(workers), "--out", f"{folder}/data", "--json"]
        command = [sys.executable, "-m", "flowlab", "extract-sim", *tasks, *options]
        report = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)
    wall = time.perf_counter() - start
    return {
        "episodes": report["episodes"],
        "frames": report["frames"],
        "workers": workers,
        "wall_s": wall,
        "cpu_s": sum(stage["cpu_s"] for stage in report["stages"]),
        "frames_per_wall_s": report["frames"] / wall,
        "peak_worker_memory_mb": report["peak_worker_memory_mb"],
    }


def scaling(tasks: list[str], repeats: int) -> dict[str, Any]:
    """The command line with one and two workers in turn, and with 1, 10 and 100 episodes of one task."""
    pairs = [(run_cli(tasks, 40, 1), run_cli(tasks, 40, 2)) for _ in range(repeats)]
    return {
        "workers": [run for pair in pairs for run in pair],
        "two_workers_over_one": median(one["wall_s"] / two["wall_s"] for one, two in pairs),
        "cpu_of_two_over_one": median(two["cpu_s"] / one["cpu_s"] for one, two in pairs),
        "growth": [run_cli(tasks[:1], n, 1) for n in (1, 10, 100)],
    }


def machine() -> dict[str, Any]:
    """Where and on what the numbers were taken."""
    info = Path("/proc/cpuinfo")
    models = [x.partition(":")[2].strip() for x in info.read_text().split("\n") if x.startswith("model name")]
    git = ["git", "-C", str(Path(__file__).parent)]
    commit = subprocess.run([*git, "describe", "--always", "--dirty"], capture_output=True, text=True).stdout.strip()
    return {"cpu": models[0], "cores": os.cpu_count(), "commit": commit or "none"}


def print_rows(rows: list[dict[str, Any]]) -> None:
    """Rows as a Markdown table."""
    print("| " + " | ".join(rows[0]) + " |\n|" + "---|" * len(rows[0]))
    for row in rows:
        print("| " + " | ".join(f"{v:.4g}" if isinstance(v, float) else str(v) for v in row.values()) + " |")
    print(flush=True)


def main() -> None:
    """Measure what is asked for, print it as tables, and keep it as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tasks", nargs="+", default=TASKS)
    parser.add_argument("--repeats", type=int, default=3, help="seeds 0, 1, ... of every task")
    parser.add_argument("--scaling", action="store_true", help="also time the command line: workers, episodes, memory")
    parser.add_argument("--json", type=Path, help="write all numbers to this file")
    args = parser.parse_args()

    result: dict[str, Any] = {"machine": machine(), "tasks": args.tasks, "seeds": list(range(args.repeats))}
    print(json.dumps(result) + "\n", flush=True)
    result["same_clouds"], result["cpu_ms_per_frame"] = measure(args.tasks, args.repeats)
    print_rows(result["same_clouds"])
    by_task = result["cpu_ms_per_frame"]
    print_rows([{"way": w} | {t: median(by_task[w].get(t, [np.nan])) for t in args.tasks} for w in by_task])
    result["summary"] = summary(by_task)
    print_rows(result["summary"])
    if args.scaling:
        result["scaling"] = scaling(args.tasks, args.repeats)
        print_rows(result["scaling"]["workers"])
        ratios = {k: v for k, v in result["scaling"].items() if isinstance(v, float)}
        print_rows([ratios])
        print_rows(result["scaling"]["growth"])
    if args.json:
        args.json.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
