"""What demonstrations without actions are worth: few labeled ones, and films whose actions are inferred.

    python benchmarks/action_free.py --out OUT                             # errors of inferred numbers: no training
    python benchmarks/action_free.py --out OUT --policies dp3 fdp --ways labeled clouds state exact lucas-kanade all
    python benchmarks/action_free.py --out OUT --print                     # tables of what is there

For every task, K demonstrations with actions and films without state and actions are extracted. The films are labeled
by what the K teach, from tracks of one source after the other, and compared with what was withheld; then policies learn
from both together, and are tried on 60 layouts. Each row of a table is a unit, kept as OUT/units/NAME.json as it ends:
ended early, the same command does the rest, and more tasks, ways or seeds add to what is there.
"""

import argparse
import json
import platform
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from label_actions import compare
from scipy.stats import binomtest

import flowlab
from flowlab.files import write_json

TASKS = (
    "push", "basketball", "pick-place", "box-close", "peg-insert-side", "shelf-place", "sweep-into", "hammer",
)  # fmt: skip
SOURCES = {
    "clouds": ("films", ("tracks=false",)),
    "state": ("states", ()),
    "exact": ("films", ()),
    "lucas-kanade": ("pictures", ()),
}
"""Of the gripper's path: the dataset of films, and settings of ``label-actions``. Films of ``state`` have theirs."""
WITHHELD = {"truth": (), "states": ("actions",), "films": ("actions", "state"), "pictures": ("actions", "state")}
"""What each dataset of films is without."""
WAYS = ("labeled", *SOURCES, "all")
"""What a policy learns from: K demonstrations alone; these and films that were labeled from a source; these and the
same films with the actions that were withheld."""
LEAST_LABELED = 2
"""``label-actions`` refuses to learn from one, since how far off it is could not be measured."""
FIRST_FILM = 100
"""Seed of the first film: no demonstration has it."""
RECIPE = Path(__file__).parent / "estimated_tracks.yaml"
TRAINING = ("batch.windows=32", "batch.segment=4", "data.held_out=0", "run.validations=0")


@dataclass(frozen=True, slots=True)
class Bench:
    """Where it all is, and how much of it."""

    out: Path
    films: int
    steps: int
    episodes: int

    def data(self, task: str, name: str, **about: Any) -> flowlab.Dataset:
        """A dataset of a task, made where it is not there yet."""
        return flowlab.extract(task, self.out / "data" / task / name, workers=1, **about)

    def labeled(self, task: str, count: int) -> flowlab.Dataset:
        """Demonstrations with state and actions."""
        return self.data(task, f"labeled-{count}", episodes=count)

    def some_films(self, task: str, name: str) -> flowlab.Dataset:
        """Films of a task, some of it withheld; tracks of ``pictures`` were estimated from a depth camera's."""
        about: dict[str, Any] = {"episodes": self.films, "settings": [f"first_seed={FIRST_FILM}"]}
        if WITHHELD[name]:
            about["without"] = WITHHELD[name]
        return self.data(
            task, f"{name}-{self.films}", recipe=str(RECIPE) if name == "pictures" else "metaworld", **about
        )

    def inferred(self, task: str, count: int, source: str) -> flowlab.Dataset:
        """The films with what was inferred of them."""
        films, settings = SOURCES[source]
        out = self.out / "data" / task / f"inferred-{count}-{source}-{self.films}"
        return flowlab.label_actions(
            self.some_films(task, films), self.labeled(task, count), out, settings=settings, workers=1
        )

    def unit(self, name: str, make: Callable[[], dict[str, Any]], about: dict[str, Any]) -> dict[str, Any]:
        """What is known of a unit, found out where it is not."""
        path = self.out / "units" / f"{name}.json"
        if path.is_file():
            known = dict(json.loads(path.read_text()))
            if other := [k for k, v in about.items() if known.get(k) != v]:
                raise SystemExit(
                    f"{path}: was made with another {other[0]} ({known.get(other[0])}); choose another --out"
                )
            return known
        start = time.process_time()
        found = about | make() | {"cpu_s": round(time.process_time() - start), **machine()}
        path.parent.mkdir(parents=True, exist_ok=True)
        write_json(path, found)
        print(name, json.dumps({k: v for k, v in found.items() if k != "solved"}), flush=True)
        return found

    def labels(self, task: str, count: int, source: str) -> dict[str, Any]:
        """How far off labels are, against what was withheld."""

        def make() -> dict[str, Any]:
            state = "state" in WITHHELD[SOURCES[source][0]]
            return compare(self.inferred(task, count, source), self.some_films(task, "truth"), state=state)

        about = {"task": task, "labeled": count, "source": source, "films": self.films}
        return self.unit(f"labels-{task}-{count}-{source}-{self.films}", make, about)

    def policy(self, task: str, count: int, way: str, policy: str, seed: int) -> dict[str, Any]:
        """How many layouts a policy solves."""

        def make() -> dict[str, Any]:
            data = [self.labeled(task, count)]
            if way != "labeled":
                data.append(self.some_films(task, "truth") if way == "all" else self.inferred(task, count, way))
            run = self.out / "runs" / f"{task}-{count}-{way}-{policy}-{seed}"
            settings = [*TRAINING, f"run.steps={self.steps}"]
            flowlab.train([d for d in data if len(d)], run, policy=policy, settings=settings, seed=seed, device="cpu")
            result = flowlab.evaluate(run, episodes=self.episodes // 3, workers=1)[0]
            solved = [int(o.success) for o in result.final]
            return {"trained_on": sum(map(len, data)), "solved": solved, "of": len(solved), "sum": sum(solved)}

        about = {"task": task, "labeled": count, "way": way, "policy": policy, "seed": seed, "films": self.films}
        about |= {"steps": self.steps, "episodes": self.episodes}
        return self.unit(f"policy-{task}-{count}-{way}-{policy}-{seed}", make, about)


def machine() -> dict[str, str]:
    """Of the commit and the processor, for a result."""
    flags = Path("/proc/cpuinfo").read_text() if Path("/proc/cpuinfo").is_file() else ""
    names = [line.split(": ")[1] for line in flags.splitlines() if line.startswith("model name")]
    kind = next((k for k in ("avx512_bf16", "avx512f", "avx2") if k in flags), platform.machine())
    git = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty"]
    commit = subprocess.run(git, capture_output=True, text=True, check=False).stdout.strip()
    return {"commit": commit, "machine": f"{names[0] if names else platform.processor()}, {kind}"}


def main() -> None:
    """Do what is not done yet, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--tasks", nargs="+", default=TASKS)
    parser.add_argument("--labeled", nargs="+", type=int, default=[1, 3, 5, 10], metavar="K")
    parser.add_argument("--sources", nargs="*", default=[*SOURCES], choices=SOURCES, help="of labels that are compared")
    parser.add_argument("--films", type=int, default=47)
    parser.add_argument("--policies", nargs="*", default=[])
    parser.add_argument("--ways", nargs="+", default=WAYS, choices=WAYS, help="what policies learn from")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0], help="of training")
    parser.add_argument("--steps", type=int, default=1500, help="of training")
    parser.add_argument("--episodes", type=int, default=60, help="that a policy is tried on, of three seeds")
    parser.add_argument("--print", action="store_true", help="print the tables of what is there, and do nothing")
    args = parser.parse_args()
    bench = Bench(args.out, args.films, args.steps, args.episodes)
    if not args.print:
        for task, count, policy, seed, way in product(args.tasks, args.labeled, args.policies, args.seeds, args.ways):
            if count >= LEAST_LABELED or way not in SOURCES:
                bench.policy(task, count, way, policy, seed)
        for task, count, source in product(args.tasks, args.labeled, args.sources):
            if count >= LEAST_LABELED:
                bench.labels(task, count, source)
    units = [json.loads(path.read_text()) for path in sorted((args.out / "units").glob("*.json"))]
    _print_labels([u for u in units if "source" in u])
    _print_policies([u for u in units if "way" in u])
    _print_gaps([u for u in units if "way" in u])


def _print_labels(units: list[dict[str, Any]]) -> None:
    print("| task | K | tracks | kept | action error | within 1 σ | hand [mm] | its motion [mm] | within 1 σ |")
    print("|---|---|---|---|---|---|---|---|---|")
    for u in units:
        cells = [u["task"], u["labeled"], u["source"], f"{u['kept']} of {u['of']}"]
        if u["kept"]:
            cells += [f"{u['action_l1']:.3f}", _mean(u["action_within_sigma"])]
            if "state_median_mm" in u:
                cells += [_mean(u["state_median_mm"][:3]), u["motion_median_mm"], _mean(u["state_within_sigma"])]
        print("|", " | ".join(map(str, cells)), "|")


def _mean(values: list[float]) -> str:
    return f"{np.mean(values):.2f}"


def _print_policies(units: list[dict[str, Any]]) -> None:
    """Layouts solved, and McNemar's test of each way against the labeled demonstrations alone."""
    alone = {_key(u): u for u in units if u["way"] == "labeled"}
    print("| task | K | policy | seed | learned from | demonstrations | solved | p, against labeled alone |")
    print("|---|---|---|---|---|---|---|---|")
    for u in sorted(units, key=lambda u: (*map(str, _key(u)), WAYS.index(u["way"]))):
        p = ""
        if u["way"] != "labeled" and _key(u) in alone:
            pairs = list(zip(u["solved"], alone[_key(u)]["solved"], strict=True))
            won, lost = pairs.count((1, 0)), pairs.count((0, 1))
            p = f"{binomtest(won, won + lost).pvalue:.3g}" if won + lost else "1"
        row = (*_key(u), u["way"], u["trained_on"], f"{u['sum']} of {u['of']}", p)
        print("|", " | ".join(map(str, row)), "|")


def _print_gaps(units: list[dict[str, Any]]) -> None:
    """How much of what actions of the films would add their labels do, in the mean over tasks and training seeds, and
    McNemar's test over all layouts against the labeled demonstrations alone."""
    known = {(*_key(u), u["way"]): u for u in units}
    print("| K | policy | learned from | runs | alone | so | with their actions | gap closed | p, against alone |")
    print("|---|---|---|---|---|---|---|---|---|")
    for count, policy, way in sorted({(u["labeled"], u["policy"], u["way"]) for u in units if u["way"] in SOURCES}):
        keys = [k[:4] for k in known if k[1:3] == (count, policy) and k[4] == way]
        three = [[known.get((*k, w)) for w in ("labeled", way, "all")] for k in keys]
        whole = [[np.array(u["solved"]) for u in row if u] for row in three if all(row)]
        if whole:
            alone, so, most = (np.concatenate(column) for column in zip(*whole, strict=True))
            won, lost = int((so > alone).sum()), int((so < alone).sum())
            between = most.mean() - alone.mean()
            gap = f"{(so.mean() - alone.mean()) / between:.0%}" if between else ""
            p = f"{binomtest(won, won + lost).pvalue:.3g}" if won + lost else "1"
            means = [f"{x.mean():.1%}" for x in (alone, so, most)]
            print("|", " | ".join([str(count), policy, way, str(len(whole)), *means, gap, p]), "|")


def _key(unit: dict[str, Any]) -> tuple[Any, ...]:
    return unit["task"], unit["labeled"], unit["policy"], unit["seed"]


if __name__ == "__main__":
    main()
