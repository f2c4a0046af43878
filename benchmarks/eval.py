"""What it costs to try a policy: flowlab's ``roll_out``, and a runner written the way DP3's MetaWorld runner is.

    python benchmarks/eval.py [RUN] [--episodes 8] [--repeats 3] [--rgb-episodes 1] [--json FILE]

Both run the same trained network in the same scenes: that of RUN, if one is given, and always one that knows nothing
and so fails after 200 steps, the dearest case. CPU time of the process, with every library held to one thread; the ways
take turns. ``benchmarks/README.md`` says what each row means.
"""

import os

os.environ.update(dict.fromkeys(["OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "LP_NUM_THREADS"], "1"))
os.environ.setdefault("MUJOCO_GL", "egl")  # before mujoco is imported

import argparse
import json
import tempfile
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import fmean, median
from typing import Any
from unittest.mock import patch

import dp3_steps
import mujoco
import numpy as np
import torch
from careful_user import reset
from extract import machine, print_rows

from flowlab.data.batches import ObservationBatch
from flowlab.deployment.policy_runner import PolicyRunner
from flowlab.evaluation import rollout
from flowlab.evaluation.rollout import MAX_STEPS, SimulatorPool, roll_out
from flowlab.evaluation.trials import Trial, list_trials
from flowlab.geometry.sampling import farthest_points
from flowlab.perception.observer import ObserverSettings
from flowlab.pipeline.extraction import extract
from flowlab.pipeline.recipe import load_recipe
from flowlab.policies.base import PolicyNetwork
from flowlab.policies.checkpoint import LoadedPolicy, load_policy
from flowlab.policies.profiles import load_settings
from flowlab.sim.recorder import EpisodeRecorder, TaskSimulator
from flowlab.sim.scene_settings import SceneSettings
from flowlab.sim.simulation import Simulation
from flowlab.training.run import ComputeSettings, prepare_run, run

OURS, SHADED, DEPTH = "flowlab", "DP3's runner", "DP3's runner, depth only"
LAST_LOOKED_AT = 2
"""Of the steps of a plan, DP3's runner sees the success of so many."""
ABOVE_TABLE_M = 1e-3
"""The table's top is at 0; flowlab's clouds leave it out by what owns the pixel, here its height must do."""
PARTS: dict[str, tuple[Any, str]] = {
    "pictures": (EpisodeRecorder, "frame"),
    "clouds": (PolicyRunner, "observe"),
    "physics": (Simulation, "step"),
    "resets": (TaskSimulator, "begin"),
    "flow errors": (rollout, "flow_error"),
}
"""What of ours is clocked apart; none of these calls another."""


@dataclass(frozen=True)
class Tried:
    """How some episodes went."""

    cpu_s: float
    """Of all of them."""
    steps: tuple[int, ...]
    """Done, of each."""
    needed: tuple[int, ...]
    """Of each, the steps after which flowlab would have ended it: those of whole plans, up to the success."""
    solved: int


class Dp3Runner(dp3_steps.Extractor):
    """One environment; every step is pictured and made a cloud, every eighth is planned at, and none is the last
    before the 200th.

    The cloud is cropped and sampled as DP3 does it. Where the network was trained on flowlab's clouds, points are moved
    to the world frame before they are sampled, and those outside of its workspace go: a few per cent of the time.
    """

    def __init__(self, policy: PolicyNetwork, task: str, scene: SceneSettings, *, depth_only: bool) -> None:
        super().__init__(task, shadows=not depth_only)
        self.network, self.task, self.depth_only = policy, task, depth_only
        self.in_world = scene.convention == "flowlab"
        crop = ObserverSettings.model_validate(policy.spec.observer).crop_for(task)
        self.low, self.high = np.maximum(crop.low, [-np.inf, -np.inf, ABOVE_TABLE_M]), np.array(crop.high)
        if depth_only:  # then multisampling costs time and does nothing
            self.renderer.close()
            self.env.model.vis.quality.offsamples = 0
            self.renderer = mujoco.Renderer(self.env.model, dp3_steps.SIZE, dp3_steps.SIZE)
            self.renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False

    def try_all(self, scene_seeds: Sequence[int], max_steps: int = MAX_STEPS) -> Tried:
        """Try these scenes, one after the other."""
        begin = time.process_time()
        needed = [self._try(scene_seed, max_steps) for scene_seed in scene_seeds]
        spent = time.process_time() - begin
        steps = (max_steps,) * len(scene_seeds)
        return Tried(spent, steps, tuple(n or max_steps for n in needed), sum(n is not None for n in needed))

    def _try(self, scene_seed: int, max_steps: int) -> int | None:
        """Try a scene; the steps at the end of the first plan that was seen to succeed."""
        s = self.network.spec.settings
        reset(self.env, scene_seed)
        noise = torch.Generator().manual_seed(scene_seed)
        first = self._look()
        seen = deque([first] * s.n_obs_steps, maxlen=s.n_obs_steps)
        queries = np.zeros((0, 3), np.float32)
        if s.needs.flow is not None:
            queries = first[0][farthest_points(first[0], self.network.spec.queries["points"])]
        done, needed = 0, None
        while done < max_steps:
            plan = self.network.plan(self._context(seen, queries), [noise])
            actions = plan.action[0, s.n_obs_steps - 1 :][: s.n_action_steps].numpy()
            success = []
            for action in actions[: max_steps - done]:
                _, _, _, _, info = self.env.step(np.clip(action, -1, 1))
                success.append(bool(info["success"]))
                seen.append(self._look())
            done += len(success)
            if needed is None and any(success[-LAST_LOOKED_AT:]):
                needed = done
        return needed

    def _look(self) -> tuple[np.ndarray, np.ndarray]:
        """Cloud (N, 3) and state (9,) of this moment."""
        if not self.depth_only:
            super()._color()  # the image observation
        cloud = self._cloud()
        points = dp3_steps.sample(self._known_to_network(cloud[:, :3]) if self.in_world else cloud)
        cloud_needs = self.network.needs.point_cloud
        assert cloud_needs is not None
        wanted = cloud_needs.points
        if wanted < len(points):
            points = points[farthest_points(points, wanted)]
        d = self.env.data
        state = [d.body("hand").xpos, d.site("rightEndEffector").xpos, d.site("leftEndEffector").xpos]
        return points.astype(np.float32), np.concatenate(state).astype(np.float32)

    def _color(self) -> np.ndarray:
        if not self.depth_only:
            return super()._color()
        self.renderer.update_scene(self.env.data, "corner2")
        return np.zeros((dp3_steps.SIZE, dp3_steps.SIZE, 3), np.uint8)

    def _known_to_network(self, points: np.ndarray) -> np.ndarray:
        """What is in the workspace, moved from DP3's frame to the world, without DP3's shift by half a pixel."""
        camera, half = self.env.data.cam("corner2"), 0.5 / self.intrinsics.get_focal_length()[0]
        unshifted = np.array([[1, 0, -half], [0, 1, half], [0, 0, 1]])
        xyz = points @ (self.turn @ unshifted.T @ camera.xmat.reshape(3, 3).T) + camera.xpos
        return xyz[np.all((xyz > self.low) & (xyz < self.high), axis=1)]

    def _context(self, seen: Sequence[tuple[np.ndarray, np.ndarray]], queries: np.ndarray) -> ObservationBatch:
        return ObservationBatch(
            points=torch.from_numpy(np.stack([points for points, _ in seen])),
            state=torch.from_numpy(np.stack([state for _, state in seen])),
            observed=torch.arange(len(seen))[None],
            queries=torch.from_numpy(queries)[None],
            task=torch.zeros(1, dtype=torch.long),
        )


class Bench:
    """The ways to try one policy, set up and warm."""

    def __init__(self, loaded: LoadedPolicy, episodes: int, shaded_episodes: int) -> None:
        self.policy, self.task = loaded.policy, loaded.trained.policy.tasks[0]
        self.trials = list_trials([self.task], [0], episodes)
        scene = SceneSettings.model_validate(loaded.trained.scene).model_copy(update={"rgb": False})
        self.simulators = SimulatorPool(self.task, scene)
        self.shaded = Dp3Runner(self.policy, self.task, scene, depth_only=False)
        self.depth = Dp3Runner(self.policy, self.task, scene, depth_only=True)
        scene_seeds = [t.scene_seed for t in self.trials]
        self.ways: dict[str, Callable[..., Tried]] = {
            OURS: partial(self._ours, self.trials),
            DEPTH: partial(self.depth.try_all, scene_seeds),
            SHADED: partial(self.shaded.try_all, scene_seeds[:shaded_episodes]),
        }
        self._ours(
            self.trials[:4], max_steps=self.policy.spec.settings.n_action_steps
        )  # compiles, and builds environments
        for runner in (self.depth, self.shaded):
            runner.try_all(scene_seeds[:1], max_steps=2)

    def close(self) -> None:
        """Free the OpenGL contexts."""
        for runner in (self.depth, self.shaded):
            runner.renderer.close()

    def measure(self, repeats: int) -> dict[str, list[Tried]]:
        """Every way in turn, so many times."""
        found: dict[str, list[Tried]] = {name: [] for name in self.ways}
        for _ in range(repeats):
            for name, way in self.ways.items():
                found[name].append(way())
        return found

    def where_time_goes(self) -> dict[str, float]:
        """CPU seconds per episode of each part of ours; apart from the measurement, since clocks cost time too."""
        spent: dict[str, float] = {}
        with ExitStack() as clocks:
            for part, (owner, name) in {"plans": (type(self.policy), "plan"), **PARTS}.items():
                clocks.enter_context(clocked(owner, name, part, spent))
            whole = self._ours(self.trials).cpu_s
        spent["the rest"] = whole - sum(spent.values())
        return {part: seconds / len(self.trials) for part, seconds in spent.items()}

    def _ours(self, wanted: Sequence[Trial], max_steps: int = MAX_STEPS) -> Tried:
        begin = time.process_time()
        episodes = list(roll_out(self.policy, self.simulators, wanted, max_steps=max_steps))
        spent = time.process_time() - begin
        steps = tuple(len(a.rollout) for a in episodes)
        return Tried(spent, steps, steps, sum(a.result.success_dp3 for a in episodes))


@contextmanager
def clocked(owner: Any, name: str, part: str, spent: dict[str, float]) -> Iterator[None]:
    """Adds the CPU time of every call of a function to that of its part."""
    work = getattr(owner, name)

    def timed(*args: Any, **kwargs: Any) -> Any:
        begin = time.process_time()
        try:
            return work(*args, **kwargs)
        finally:
            spent[part] = spent.get(part, 0.0) + time.process_time() - begin

    with patch.object(owner, name, timed):
        yield


def summary(found: dict[str, list[Tried]]) -> list[dict[str, Any]]:
    """A row per way: medians over the repeats, of times and of ratios to ours in the same repeat.

    Ended as ours, an episode costs its share of the steps. The two runners act alike, so how many those are is taken
    from the one that tried all episodes.
    """
    needed = fmean(found[DEPTH][0].needed)
    ours = [t.cpu_s / len(t.steps) for t in found[OURS]]
    rows = []
    for name, repeats in found.items():
        whole = [t.cpu_s / len(t.steps) for t in repeats]
        steps = fmean(repeats[0].steps)
        ended = whole if name == OURS else [s / steps * needed for s in whole]
        rows.append(
            {
                "way": name,
                "solved": f"{repeats[0].solved} of {len(repeats[0].steps)}",
                "steps": steps,
                "CPU s per episode": median(whole),
                "episodes/s per core": 1 / median(whole),
                "times ours": median(t / o for t, o in zip(whole, ours, strict=True)),
                "steps, ended as ours": steps if name == OURS else needed,
                "times ours, ended as ours": median(t / o for t, o in zip(ended, ours, strict=True)),
            }
        )
    return rows


def untrained(folder: Path) -> LoadedPolicy:
    """A policy for push after a single step; after fifty, it would solve some scene_seeds."""
    recipe = load_recipe("metaworld", ["episodes=3"])
    extract(["push"], folder / "data", recipe=recipe, workers=1)
    settings = load_settings("fast", "fdp", ["run.minutes=null", "run.steps=1", "data.held_out=0"])
    run(prepare_run(folder / "data", folder / "run", settings, ComputeSettings(device="cpu")), lambda _: None)
    return load_policy(folder / "run")


def examine(name: str, loaded: LoadedPolicy, args: argparse.Namespace) -> dict[str, Any]:
    """Measure with one policy, and print what came out."""
    bench = Bench(loaded, args.episodes, min(args.rgb_episodes, args.episodes))
    found = bench.measure(args.repeats)
    rows, parts = summary(found), bench.where_time_goes()
    bench.close()
    kind = loaded.policy.spec.settings.policy
    print(f"{name}: {kind}, {bench.task}, {loaded.step} training steps\n")
    print_rows(rows)
    print_rows([{"CPU ms per episode": part, "flowlab": 1e3 * seconds} for part, seconds in parts.items()])
    seconds = {way: [t.cpu_s / len(t.steps) for t in tried] for way, tried in found.items()}
    return {
        "name": name, "policy": kind, "task": bench.task, "training_steps": loaded.step,
        "rows": rows, "cpu_s_per_episode": seconds, "parts_cpu_s_per_episode": parts,
    }  # fmt: skip


def main() -> None:
    """Measure with what is given, and with a policy that fails."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", nargs="?", type=Path, help="folder of a training run; its first task is tried")
    parser.add_argument("--episodes", type=int, default=8)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--rgb-episodes", type=int, default=1, help="how many of them with color, which takes long")
    parser.add_argument("--json", type=Path, help="also write the figures here")
    args = parser.parse_args()
    torch.set_num_threads(1)
    result: dict[str, Any] = {"machine": machine(), "episodes": args.episodes, "repeats": args.repeats}
    print(json.dumps(result) + "\n", flush=True)
    policies = [("trained", load_policy(args.run))] if args.run else []
    with tempfile.TemporaryDirectory() as folder:
        policies.append(("untrained", untrained(Path(folder))))
        result["policies"] = [examine(name, loaded, args) for name, loaded in policies]
    if args.json:
        args.json.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
