"""Does predicted flow pay when plans are made? Ways to use it with the same weights, and without it.

    python benchmarks/flow_plans.py --out OUT                  # what is not there yet, task by task
    python benchmarks/flow_plans.py --out OUT --print          # tables of what is there

Policies are trained on K demonstrations, one for each task, training seed and kind; then each way of deciding is tried
on the same layouts with the same weights. A result is kept as OUT/units/NAME.json as it ends: ended early, the same
command does the rest.
"""

import argparse
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from action_free import TRAINING, machine
from flow_readout import FlowReadout
from scipy.stats import binomtest
from torch import Tensor

import flowlab
from flowlab.data.batches import ObservationBatch
from flowlab.evaluation.checkpoints import find_checkpoint
from flowlab.evaluation.rollout import SimulatorPool, roll_out
from flowlab.evaluation.trials import list_trials
from flowlab.files import write_json
from flowlab.policies.base import ActionPlan, PolicyNetwork
from flowlab.policies.checkpoint import load_policy

SAMPLES = 8
"""Plans that a way chooses among."""
KINDS = {"dp3": ("dp3", ()), "fdp": ("fdp", ()), "auxiliary": ("fdp", ("motion.condition=auxiliary",))}
"""What is trained; ``auxiliary`` learns flow beside the action, which is not conditioned on it."""
Way = Callable[["Deciding", ObservationBatch, list[torch.Generator]], ActionPlan]


@dataclass(frozen=True, slots=True)
class Deciding:
    """A trained policy, and what reads actions off its flow."""

    policy: PolicyNetwork
    readout: FlowReadout | None

    @property
    def now(self) -> int:
        """Index of the action that is executed first."""
        return self.policy.spec.settings.n_obs_steps - 1

    def executed(self, plan: ActionPlan) -> Tensor:
        """The actions of a plan that may be executed."""
        return plan.action[:, self.now : self.now + self.policy.spec.settings.n_action_steps]

    def read(self, plan: ActionPlan, queries: Tensor) -> Tensor:
        """The displacements (W, K, 3) that a plan's flow tells of."""
        assert self.readout is not None
        assert plan.flow is not None
        count = self.policy.spec.settings.n_action_steps
        found = self.readout.read(plan.flow.double().numpy(), queries.double().numpy(), self.now, count)
        return torch.from_numpy(found).to(plan.action)

    def several(self, context: ObservationBatch, noise: list[torch.Generator]) -> tuple[ActionPlan, Tensor]:
        """:data:`SAMPLES` plans for each window, one window's after the other, and the query points of each."""
        again = torch.arange(len(context.observed)).repeat_interleave(SAMPLES)
        rows = {n: getattr(context, n)[again] for n in ("observed", "queries", "task")}
        plan = self.policy.plan(replace(context, **rows), [g for g in noise for _ in range(SAMPLES)])
        return plan, rows["queries"]


def as_trained(deciding: Deciding, context: ObservationBatch, noise: list[torch.Generator]) -> ActionPlan:
    """One plan, as the policy makes it."""
    return deciding.policy.plan(context, noise)


def nearest_to_all(deciding: Deciding, context: ObservationBatch, noise: list[torch.Generator]) -> ActionPlan:
    """Of several plans the one whose actions are nearest to those of the others: no flow is looked at."""
    plan, _ = deciding.several(context, noise)
    action = deciding.executed(plan).unflatten(0, (-1, SAMPLES)).flatten(2)
    return _chosen(plan, torch.cdist(action, action).sum(2))


def agreeing(deciding: Deciding, context: ObservationBatch, noise: list[torch.Generator]) -> ActionPlan:
    """Of several plans the one whose action and flow agree best."""
    plan, queries = deciding.several(context, noise)
    off = (deciding.executed(plan)[..., :3] - deciding.read(plan, queries)).abs().mean((1, 2))
    return _chosen(plan, off.unflatten(0, (-1, SAMPLES)))


def read_off(share: float) -> Way:
    """A plan whose displacements are the flow's, to a share; the gripper's effort stays the action's."""

    def way(deciding: Deciding, context: ObservationBatch, noise: list[torch.Generator]) -> ActionPlan:
        plan = deciding.policy.plan(context, noise)
        found = deciding.read(plan, context.queries)
        action = plan.action.clone()
        part = action[:, deciding.now : deciding.now + found.shape[1], :3]
        part += share * torch.where(found.isnan(), 0, found - part)
        return replace(plan, action=action)

    return way


def _chosen(plan: ActionPlan, cost: Tensor) -> ActionPlan:
    """Of the plans of each window the cheapest."""
    best = cost.argmin(1) + torch.arange(len(cost)) * SAMPLES
    return ActionPlan(plan.action[best], None if plan.flow is None else plan.flow[best])


WAYS: dict[str, tuple[Way, int]] = {
    "as trained": (as_trained, 8),
    "anew every 4": (as_trained, 4),
    "anew every 2": (as_trained, 2),
    "nearest of 8": (nearest_to_all, 8),
    "agreeing of 8": (agreeing, 8),
    "half flow": (read_off(0.5), 8),
    "flow": (read_off(1.0), 8),
}
"""How it is decided, and how many steps of a plan are executed."""
NEED_FLOW = ("agreeing of 8", "half flow", "flow")
OTHERS = {"dp3": ("as trained", "anew every 4", "anew every 2", "nearest of 8"), "auxiliary": ("as trained",)}
"""Ways of those whose action is not conditioned on flow."""


class Decider(torch.nn.Module):
    """Stands where a policy does, and decides in another way."""

    def __init__(self, deciding: Deciding, way: Way) -> None:
        super().__init__()
        self.inner, self.deciding, self.way, self.spec = deciding.policy, deciding, way, deciding.policy.spec

    @torch.no_grad()
    def plan(self, context: ObservationBatch, generators: Sequence[torch.Generator]) -> ActionPlan:
        """A plan for every window."""
        return self.way(self.deciding, context, list(generators))


@dataclass(frozen=True, slots=True)
class Bench:
    """Where it all is, and how much of it."""

    out: Path
    steps: int
    episodes: int

    def data(self, task: str, count: int) -> flowlab.Dataset:
        """So many demonstrations and one more that is held out; more begin with the same ones."""
        return flowlab.extract(task, self.out / "data" / f"{task}-{count}", episodes=count, workers=1)

    def trained(self, task: str, count: int, kind: str, seed: int) -> Path:
        """The run of a policy, made where it is not there."""
        run, (policy, more) = self.out / "runs" / f"{task}-{count}-{kind}-{seed}", KINDS[kind]
        began = time.process_time()
        settings = [*TRAINING, f"run.steps={self.steps}", "run.checkpoints=1", "n_action_steps=8", *more]
        flowlab.train(self.data(task, count), run, policy=policy, settings=settings, seed=seed, device="cpu")
        if (spent := time.process_time() - began) > 5:
            write_json(run / "cpu.json", {"train_cpu_s": round(spent)})
        return run

    def unit(self, task: str, count: int, kind: str, seed: int, name: str) -> dict[str, Any]:
        """How many layouts a policy solves when it decides in a way."""
        about = {"task": task, "K": count, "kind": kind, "seed": seed, "way": name, "steps": self.steps}
        path = self.out / "units" / f"{task}-{count}-{kind}-{seed}-{name.replace(' ', '-')}.json"
        if path.is_file():
            return dict(json.loads(path.read_text()))
        run = self.trained(task, count, kind, seed)
        ref, loaded = find_checkpoint(run), load_policy(run)
        readout = (
            FlowReadout.fit(iter(self.data(task, count)), np.random.default_rng(seed)) if name in NEED_FLOW else None
        )
        way, execute = WAYS[name]
        decider: Any = Decider(Deciding(loaded.policy, readout), way)
        began = time.process_time()
        trials = list_trials([task], (0, 1, 2), self.episodes // 3)
        results = [r.result for r in roll_out(decider, SimulatorPool(task, ref.scene), trials, n_action_steps=execute)]
        solved = [int(r.success) for r in sorted(results, key=lambda r: r.scene_seed)]
        spent = json.loads((run / "cpu.json").read_text()) if (run / "cpu.json").is_file() else {}
        found = about | {"solved": solved, "sum": sum(solved), "of": len(solved)} | spent
        found |= {"try_cpu_s": round(time.process_time() - began), **machine()}
        path.parent.mkdir(parents=True, exist_ok=True)
        write_json(path, found)
        print(path.stem, f"{sum(solved)} of {len(solved)}, {found['try_cpu_s']} s", flush=True)
        return found


def main() -> None:
    """Do what is not done yet, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--tasks", nargs="+", default=["basketball", "pick-out-of-hole", "stick-pull"])
    parser.add_argument("--labeled", nargs="+", type=int, default=[10, 3], metavar="K")
    parser.add_argument("--kinds", nargs="+", default=[*KINDS], choices=KINDS)
    parser.add_argument("--ways", nargs="+", default=[*WAYS], choices=WAYS)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2], help="of training")
    parser.add_argument("--steps", type=int, default=1500, help="of training")
    parser.add_argument("--episodes", type=int, default=60, help="that a policy is tried on, of three seeds")
    parser.add_argument("--print", action="store_true", help="print the tables of what is there, and do nothing")
    args = parser.parse_args()
    bench = Bench(args.out, args.steps, args.episodes)
    if not args.print:
        for seed, count, task, kind in product(args.seeds, args.labeled, args.tasks, args.kinds):
            for name in args.ways:
                if kind == "fdp" or name in OTHERS[kind]:
                    bench.unit(task, count, kind, seed, name)
    _print([json.loads(path.read_text()) for path in sorted((args.out / "units").glob("*.json"))])


def _print(units: list[dict[str, Any]]) -> None:
    """Layouts solved by kind and way over tasks and seeds, and McNemar's test against DP3 deciding in the same way."""
    for count in sorted({u["K"] for u in units}):
        tasks = sorted({u["task"] for u in units})
        mine = {(u["kind"], u["way"], u["task"], u["seed"]): u for u in units if u["K"] == count}
        print(f"\n{count} demonstrations\n\n| policy | decides | {' | '.join(tasks)} | together | p |")
        print("|---" * (len(tasks) + 4) + "|")
        base = {k[2:]: u for k, u in mine.items() if k[:2] == ("dp3", "as trained")}
        for kind, way in product(KINDS, WAYS):
            units_of = {k[2:]: u for k, u in mine.items() if k[:2] == (kind, way)}
            if units_of:
                of_task = [[u for (t, _), u in units_of.items() if t == task] for task in tasks]
                cells = [
                    f"{sum(u['sum'] for u in us)} of {sum(u['of'] for u in us)}"
                    for us in [*of_task, [*units_of.values()]]
                ]
                print("|", " | ".join([kind, way, *cells, _p(units_of, base)]), "|")


def _p(units: dict[Any, dict[str, Any]], base: dict[Any, dict[str, Any]]) -> str:
    pairs = [p for k, u in units.items() if k in base for p in zip(u["solved"], base[k]["solved"], strict=True)]
    won, lost = pairs.count((1, 0)), pairs.count((0, 1))
    return f"{binomtest(won, won + lost).pvalue:.2g} ({won} : {lost})" if won + lost else ""


if __name__ == "__main__":
    main()
