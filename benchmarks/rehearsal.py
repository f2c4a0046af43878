"""The paper's real-robot protocol without a robot: filmed, labeled, trained, tried and reported, task by task.

    python benchmarks/rehearsal.py --out OUT                                 # eight tasks; see docs/rehearsal.md
    python benchmarks/rehearsal.py --out OUT --tasks button-press            # one of them; the others can follow
    python benchmarks/rehearsal.py --out CHECK --tasks button-press --demonstrations 4 --trials 2 --steps 20
    python benchmarks/rehearsal.py --out OUT --print                         # tables of what is there

MetaWorld's expert demonstrates each task before a depth camera that errs, and acts as a real arm is told to: where to
be, how to be turned, gripper open or closed. `flowlab track-real` labels the films; beside its labels stand exact ones
of the same points. `flowlab train` makes 3D FDP of both, and DP3 of the same clouds; `Policy.act` drives each through
the same camera; trials.csv has who solved what, and `flowlab report` counts. Every step that is done is kept as a file
in OUT/units: ended early, the same command does the rest.
"""

import argparse
import csv
import json
import os
import platform
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

from pydantic import ValidationError
from rehearsal_films import SETUPS, FilmSettings
from rehearsal_labels import compare_labels
from rehearsal_trials import try_expert, try_policy, try_repetition

import flowlab
from flowlab.config import explain, override
from flowlab.errors import FlowlabError, UsageError
from flowlab.files import new_file, write_json
from flowlab.storage.dataset import Dataset
from flowlab.untrusted import read_json

POLICIES = {"dp3": ("dp3", "estimated"), "fdp-exact": ("fdp", "exact"), "fdp-estimated": ("fdp", "estimated")}
"""Of the table: what is trained, and on which labels. DP3 sees none: its clouds are the same in both datasets."""
BASELINES = {"expert": try_expert, "repetition": try_repetition}
"""Beside them: who is told where everything is, and who never looks."""
RECIPES = {"estimated": ["real"], "exact": [str(Path(__file__).with_name("rehearsal_exact.yaml"))]}
LABELING = [
    "observer.crop={low: [-0.5, 0.25, 0.015], high: [0.5, 0.97, 0.8]}",  # the table's top is at 0, and depth errs
    "write.depth=false",
    "write.rgb=false",
]
TRAINING = [
    "batch.shift_m=0",
    "batch.turn_deg=0",
    "batch.windows=32",
    "batch.segment=4",
    "run.validations=2",
    "run.checkpoints=1",
]
"""No augmentation, as the paper has it for real robots; small batches, with which short trainings get farther."""
MOST_ATTEMPTS = 3
"""So many films are tried for each that is wanted, before a task is given up."""


@dataclass(frozen=True, slots=True)
class Rehearsal:
    """Where it all is, and how much of it."""

    out: Path
    film: FilmSettings
    demonstrations: int
    trials: int
    steps: int
    seed: int

    def settle(self) -> None:
        """Keep what was asked for beside what comes of it. Ends the program where something else was asked before."""
        file, asked = self.out / "rehearsal.json", json.loads(json.dumps(self._settings()))
        if not file.is_file():
            file.parent.mkdir(parents=True, exist_ok=True)
            write_json(file, asked)
        known = read_json(file)
        if other := [k for k in asked if known.get(k) != asked[k]]:
            raise SystemExit(
                f"{file}: was begun with {other[0]} {known.get(other[0])}, and {asked[other[0]]} is asked for; choose "
                "another --out"
            )

    def _settings(self) -> dict[str, Any]:
        film = self.film.model_dump(mode="json")
        numbers = {"demonstrations": self.demonstrations, "trials": self.trials, "steps": self.steps, "seed": self.seed}
        return {"film": film, **numbers, "labeling": LABELING, "training": TRAINING}

    def unit(self, name: str, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """What is known of a step, done where it is not: its file is there once it is done, and all of it."""
        path = self.out / "units" / f"{name}.json"
        if path.is_file():
            return dict(json.loads(path.read_text()))
        began = _cpu_s()
        made = make()
        spent = _cpu_s() - began + made.pop("workers_cpu_s", 0.0)
        found = made | {"cpu_s": round(spent, 1), **_machine()}
        path.parent.mkdir(parents=True, exist_ok=True)
        write_json(path, found)
        print(f"{name}: {found['cpu_s']:.0f} CPU s", flush=True)
        return found

    def films(self, task: str) -> dict[str, Any]:
        """Demonstrations of a task as recordings, and whether their actions alone solve it again."""
        folder = self.out / "films" / task

        def make() -> dict[str, Any]:
            studio, repeated, frames = self.film.studio(task, color=True), 0, list[int]()
            for attempts, number in enumerate(islice(studio.layouts(0), MOST_ATTEMPTS * self.demonstrations), 1):
                rollout = studio.demonstrate(number)
                if rollout is None:
                    continue
                repeated += any(studio.repeat(number, rollout.action).success)
                frames.append(len(rollout))
                if not (folder / f"{number:03d}").exists():
                    studio.film(folder / f"{number:03d}", rollout, number)
                if len(frames) == self.demonstrations:
                    return {"films": len(frames), "attempts": attempts, "repeated": repeated, "frames": sum(frames)}
            raise SystemExit(f"{task}: MetaWorld's expert solves {len(frames)} of {attempts} layouts; lower moved_m")

        return self.unit(f"films-{task}", make)

    def labels(self, task: str, kind: str) -> Dataset:
        """The dataset with labels of a kind: of exact ones only the films whose estimated ones were good enough."""
        out = self.out / "data" / f"{task}-{kind}"

        def make() -> dict[str, Any]:
            films, changes = [self.out / "films" / task], [*LABELING]
            if kind == "exact":
                films = _films_of(self.labels(task, "estimated"))
                changes.append(f"rehearsal_films:ExactTracks.film={self.film.model_dump_json()}")
            _flowlab("track-real", *films, "--out", out, "--recipe", *RECIPES[kind], "--workers", 1, *_set(changes))
            data = flowlab.open_dataset(out)
            spent = sum(stage.cpu_s for r in data.receipts for stage in r.stages.values())
            return {"episodes": len(data), "rejects": [x.reason for x in data.rejects], "workers_cpu_s": spent}

        self.unit(f"labels-{task}-{kind}", make)
        return flowlab.open_dataset(out)

    def errors(self, task: str) -> dict[str, Any]:
        """How far the estimated labels are from the exact ones."""
        return self.unit(
            f"errors-{task}", lambda: compare_labels(self.labels(task, "estimated"), self.labels(task, "exact"))
        )

    def train(self, task: str, name: str) -> Path:
        """A policy of the table."""
        policy, kind = POLICIES[name]
        run = self.out / "runs" / f"{task}-{name}"

        def make() -> dict[str, Any]:
            data = self.labels(task, kind).path
            about = ("--policy", policy, "--out", run, "--seed", self.seed, "--device", "cpu")
            _flowlab("train", data, *about, *_set([*TRAINING, f"run.steps={self.steps}"]))
            return {"channels": read_json(run / "policy.json")["policy"]["channels"]}

        self.unit(f"train-{task}-{name}", make)
        return run

    def tried(self, task: str, name: str) -> dict[str, Any]:
        """How a policy of the table does, or what stands beside them."""
        if name in BASELINES:
            attempt = partial(BASELINES[name], task)
        else:
            attempt = partial(try_policy, self.train(task, name), task)
        about = {"task": task, "policy": name}
        return self.unit(f"trials-{task}-{name}", lambda: about | {"tried": attempt(self.film, self.trials)})

    def do(self, task: str) -> None:
        """All of a task."""
        self.films(task)
        for kind in RECIPES:
            self.labels(task, kind)
        self.errors(task)
        for name in (*BASELINES, *POLICIES):
            self.tried(task, name)

    def report(self) -> None:
        """The scored trials as a person would have written them down, and flowlab's report of them."""
        units = _trials(self.out)
        with new_file(self.out / "trials.csv") as place, place.open("w", newline="") as file:
            lines = csv.writer(file)
            lines.writerow(("policy", "task", "trial", "success", "note"))
            for u in units:
                lines.writerows((u["policy"], u["task"], t["trial"], int(t["success"]), t["note"]) for t in u["tried"])
        _flowlab("report", self.out / "trials.csv", "--out", self.out / "report")


def _films_of(data: Dataset) -> list[Path]:
    """The films that a dataset's episodes were made of."""
    kept = {ref.seed for ref in data.refs}
    return [Path(r.source) for r in data.manifest.recordings if r.seed in kept]


def _set(changes: list[str]) -> list[str]:
    return [word for change in changes for word in ("--set", change)]


def _flowlab(*words: Any) -> None:
    """Run a command of flowlab as a user does."""
    command = [sys.executable, "-m", "flowlab", *map(str, words)]
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False)
    if done.returncode:
        raise SystemExit(
            f"{' '.join(command[2:])}\n{done.stdout}\nended with {done.returncode}; the same command goes on"
        )


def _cpu_s() -> float:
    """CPU time of this process and of all that it waited for [s]."""
    return sum(os.times()[:4])


def _machine() -> dict[str, str]:
    flags = Path("/proc/cpuinfo").read_text() if Path("/proc/cpuinfo").is_file() else ""
    names = [line.split(": ")[1] for line in flags.splitlines() if line.startswith("model name")]
    git = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty"]
    commit = subprocess.run(git, capture_output=True, text=True, check=False).stdout.strip()
    return {"commit": commit, "machine": names[0] if names else platform.processor()}


def _trials(out: Path) -> list[dict[str, Any]]:
    """The trials that are there, in the order of the paper's tasks and of the table's policies."""
    files = [out / "units" / f"trials-{task}-{name}.json" for task in SETUPS for name in (*BASELINES, *POLICIES)]
    return [dict(json.loads(file.read_text())) for file in files if file.is_file()]


def print_tables(out: Path) -> None:
    """The paper's table of real robots, with what is there; below it the labels, the demonstrations, the cost."""
    trials = {(u["task"], u["policy"]): [t["success"] for t in u["tried"]] for u in _trials(out)}
    tasks = [task for task in SETUPS if any(t == task for t, _ in trials)]
    _row("success [%]", *(f"{SETUPS[t].stands_for} ({t})" for t in tasks), "mean")
    _row(*["---"] * (len(tasks) + 2))
    for name in (*BASELINES, *POLICIES):
        rates = [100 * _mean(trials[t, name]) if (t, name) in trials else None for t in tasks]
        whole = _mean([r for r in rates if r is not None]) if None not in rates else None
        _row(name, *("" if r is None else f"{r:.0f}" for r in rates), "" if whole is None else f"{whole:.1f}")
    print()
    _row("task", "films, of attempts", "frames", "actions alone solve", "kept", "moving: median mm, <20 mm", "objects",
         "confidently wrong", "CPU s")  # fmt: skip
    _row(*["---"] * 9)
    for task in SETUPS:
        _row_of_task(out, task)


def _row_of_task(out: Path, task: str) -> None:
    """What is known of a task's films and labels, and what all of it cost."""

    def unit(name: str) -> dict[str, Any]:
        file = out / "units" / f"{name}.json"
        return dict(json.loads(file.read_text())) if file.is_file() else {}

    films, labels, errors = unit(f"films-{task}"), unit(f"labels-{task}-estimated"), unit(f"errors-{task}")
    if not films:
        return

    def near(group: str) -> str:
        found = errors.get(group)
        return f"{found['median_mm']:.1f}, {found['within_20mm']:.2f}" if found else ""

    wrong = f"{errors['confidently_wrong']:.2%}" if errors else ""
    spent = [json.loads(f.read_text())["cpu_s"] for f in (out / "units").glob("*.json") if f"-{task}" in f.stem]
    solved, attempts = f"{films['repeated']} of {films['films']}", f"{films['films']} of {films['attempts']}"
    _row(task, attempts, films["frames"], solved, labels.get("episodes", ""), near("moving"), near("object"), wrong,
         f"{sum(spent):.0f}")  # fmt: skip


def _mean(values: list[Any]) -> float:
    return sum(values) / len(values)


def _row(*cells: Any) -> None:
    print("|", " | ".join(map(str, cells)), "|")


def _count(text: str) -> int:
    """A number from 1 on."""
    if not (text.isascii() and text.isdecimal() and int(text)):
        raise argparse.ArgumentTypeError(f"{text} is no whole number from 1 on")
    return int(text)


def _film(changes: list[str]) -> FilmSettings:
    """The settings of the films. Ends the program where one does not fit."""
    values: dict[str, Any] = {}
    try:
        for change in changes:
            override(values, change, FilmSettings.model_fields, "sensor=tof")
        return FilmSettings.model_validate(values)
    except ValidationError as error:
        raise SystemExit(f"--set {explain(error, FilmSettings)}") from error
    except UsageError as error:
        raise SystemExit(str(error)) from error


def main() -> None:
    """Do what is not done yet, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--tasks", nargs="+", choices=SETUPS, default=[*SETUPS], metavar="TASK")
    parser.add_argument("--demonstrations", type=_count, default=50, help="of each task [50]")
    parser.add_argument("--trials", type=_count, default=20, help="of each policy [20]")
    parser.add_argument("--steps", type=_count, default=2000, help="of training, for every policy [2000]")
    parser.add_argument("--seed", type=int, default=0, help="of training [0]")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="change a setting of the films: sensor=tof"
    )
    parser.add_argument("--print", action="store_true", help="only tables of what is there")
    asked = parser.parse_args()
    if not asked.print:
        film = _film(asked.set)
        rehearsal = Rehearsal(asked.out, film, asked.demonstrations, asked.trials, asked.steps, asked.seed)
        try:
            rehearsal.settle()
            for task in asked.tasks:
                rehearsal.do(task)
                rehearsal.report()
        except FlowlabError as error:
            raise SystemExit(str(error)) from error
    print_tables(asked.out)


if __name__ == "__main__":
    main()
