"""What training and planning cost on a GPU, and whether it computes what the CPU does.

    python benchmarks/gpu.py                              # under eight minutes on one GPU
    python benchmarks/gpu.py --device cpu --profiles fast              # the same without one: two minutes

For every policy, with the default profile and with the paper's large networks, in fp32, TF32 and bf16: training steps a
second; the share of a step that passes only because the batch, or the noise, has to be made first; the losses of the
first steps beside those of the CPU in fp32, from the same weights, windows and noise; peak memory; and how long one
plan takes. What the budget has no time for, or the device no units, is listed as not measured.

Times are by the clock on a GPU, which is waited for at both ends, and on a CPU CPU time over threads, so that what else
the machine does counts for little. Exit status 1: losses differ by more than the stated tolerance.
"""

import argparse
import math
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from gpu_tables import Agreement, Finding, NotMeasured, PlanLatency, TrainingSpeed, markdown, write_json
from torch import Tensor

from flowlab.data.batches import ObservationBatch
from flowlab.errors import FlowlabError
from flowlab.nets.diffusion import NoiseSampler
from flowlab.pipeline.extraction import extract
from flowlab.pipeline.recipe import load_recipe
from flowlab.policies.profiles import load_settings
from flowlab.policies.settings import DiffusionPolicySettings
from flowlab.text import counted
from flowlab.training.distributed import ProcessGroup
from flowlab.training.optimizer import Optimizers
from flowlab.training.precision import has_bf16
from flowlab.training.run import ComputeSettings, make_trainer
from flowlab.training.trainer import DivergedError, Trainer

TOLERANCES = {"fp32": 1e-4, "tf32": 2e-3, "bf16": 1e-2}
"""Largest relative difference of a loss from the CPU's in fp32 within the first ten steps. Weights moved by 1e-6 of
themselves changed these by up to 4e-7, and within twenty steps by up to 3e-5; bf16 on a CPU by up to 3e-4, and with the
paper's network by 7e-4 within three. That of TF32, whose rounding is between the two, could not be tried."""
MOST_STEPS = 50
"""In one round."""


class Deadline:
    """Until when something may be begun."""

    def __init__(self, seconds: float) -> None:
        self._at = time.monotonic() + seconds

    @property
    def left(self) -> float:
        """Seconds that are left; none is 0."""
        return max(0.0, self._at - time.monotonic())

    def allows(self, seconds: float = 0.0) -> bool:
        """Whether what takes so long would still end in time."""
        return self.left > seconds

    def part(self, share: float) -> "Deadline":
        """An earlier one, for something that shall have a share of what is left."""
        return Deadline(share * self.left)


@dataclass(frozen=True, slots=True)
class Machine:
    """The device, and how time passes on it."""

    device: torch.device
    threads: int

    @property
    def is_gpu(self) -> bool:
        """Whether it has memory and a clock of its own."""
        return self.device.type == "cuda"

    def seconds(self, work: Callable[[], object], times: int = 1) -> float:
        """How long one of so many goes takes, until the device has finished."""
        begin = self._now()
        for _ in range(times):
            work()
        return (self._now() - begin) / times

    def _now(self) -> float:
        if not self.is_gpu:
            return time.process_time() / self.threads
        torch.cuda.synchronize(self.device)
        return time.perf_counter()

    def lacks(self, precision: str) -> str | None:
        """Why it cannot compute so; None where it can."""
        if precision == "tf32" and not (self.is_gpu and torch.cuda.get_device_properties(self.device).major >= 8):
            return "TF32 is a format of NVIDIA GPUs since Ampere"
        return "the device has no units for bf16" if precision == "bf16" and not has_bf16(self.device) else None


class KeptNoise(NoiseSampler):
    """Noise that is drawn once, and then given again from where it lies on the device."""

    def __init__(self, noise: NoiseSampler) -> None:
        self._noise = noise
        self._drawn: list[Tensor] = []
        self._next = 0

    def again(self) -> "KeptNoise":
        """The same, from the beginning of a step."""
        self._next = 0
        return self

    def normal(self, windows: int, *shape: int) -> Tensor:
        """See :class:`NoiseSampler`."""
        return self._give(lambda: self._noise.normal(windows, *shape))

    def steps(self, below: int, windows: int, *shape: int) -> Tensor:
        """See :class:`NoiseSampler`."""
        return self._give(lambda: self._noise.steps(below, windows, *shape))

    def _give(self, draw: Callable[[], Tensor]) -> Tensor:
        if self._next == len(self._drawn):
            self._drawn.append(draw())
        self._next += 1
        return self._drawn[self._next - 1]


@dataclass(frozen=True, slots=True)
class Case:
    """One policy with one profile, and how much of it is measured."""

    profile: str
    policy: str
    data: Path
    machine: Machine
    options: argparse.Namespace

    def make_trainer(self, device: torch.device, threads: int) -> Trainer:
        """A trainer in fp32, with the weights that the seed gives on every device; its folder is never made."""
        settings = load_settings(
            self.profile, self.policy, ["run.minutes=null", "run.steps=100000", "data.held_out=0", "run.seed=0"]
        )
        compute = ComputeSettings(device=str(device), precision="fp32", threads=threads)
        return make_trainer(self.data, self.data.parent / "no-run", settings, compute)[0]

    def measure(self, until: Deadline) -> Iterator[Finding]:
        """All that is found of it in time."""
        if not until.allows():
            yield self._out_of_time("everything")
            return
        # The other device's own threads are few, as in a training; the reference may have all cores.
        threads = (os.cpu_count() or 1) if self.machine.is_gpu else self.machine.threads
        reference = first_losses(self.make_trainer(torch.device("cpu"), threads), self.options.steps, until.part(1 / 3))
        trainer = self.make_trainer(self.machine.device, self.machine.threads)
        weights = {name: value.detach().cpu().clone() for name, value in trainer.policy.state_dict().items()}
        yield self._plans(trainer, until.part(1 / 4))
        able = [p for p in TOLERANCES if self.machine.lacks(p) is None]
        for k, precision in enumerate(able):
            restart(trainer, weights)
            try:
                with computing_in(trainer, precision):
                    yield from self._training(trainer, precision, reference, until.part(1 / (len(able) - k)))
            except DivergedError:
                steps, tolerance = trainer.step + 1, TOLERANCES[precision]
                yield Agreement(self.profile, self.policy, precision, steps, math.inf, tolerance)

    def _training(
        self, trainer: Trainer, precision: str, reference: Sequence[float], until: Deadline
    ) -> Iterator[Finding]:
        if self.machine.is_gpu:
            torch.cuda.reset_peak_memory_stats(self.machine.device)
        losses = first_losses(trainer, self.options.steps, until.part(1 / 2))
        compared = min(len(losses), len(reference))
        if compared:
            difference = largest_difference(losses[:compared], reference[:compared])
            yield Agreement(self.profile, self.policy, precision, compared, difference, TOLERANCES[precision])
        if compared < self.options.steps:
            yield self._out_of_time(f"{precision}: losses beyond the first {compared} of {self.options.steps} steps")
        rounds = list(self._rounds(trainer, until)) if losses else []
        if rounds:
            peak = torch.cuda.max_memory_allocated(self.machine.device) / 1e6 if self.machine.is_gpu else None
            yield TrainingSpeed.of(self.profile, self.policy, precision, rounds, peak)
        if missing := self.options.rounds - len(rounds):
            yield self._out_of_time(f"{precision}: {counted(missing, 'round')} of training steps")

    def _rounds(self, trainer: Trainer, until: Deadline) -> Iterator[dict[str, float]]:
        """Seconds of a step in each way, round by round: all ways take turns, so that a busy machine slows all."""
        batch, noise = trainer.gather()
        kept = KeptNoise(noise)
        ways: dict[str, Callable[[], object]] = {
            "step": trainer.train_step,
            "batch kept": lambda: trainer.learn(batch, noise),
            "batch and noise kept": lambda: trainer.learn(batch, kept.again()),
            "gather": trainer.gather,
        }
        ways["batch and noise kept"]()  # the first one draws
        begin = time.monotonic()
        once = self.machine.seconds(ways["step"])
        longest = len(ways) * (time.monotonic() - begin)
        times = max(1, min(MOST_STEPS, round(self.options.round_seconds / max(once, 1e-6))))
        for _ in range(self.options.rounds):
            if not until.allows(longest):
                return
            begin = time.monotonic()
            yield {name: self.machine.seconds(work, times) for name, work in ways.items()}
            longest = max(longest, time.monotonic() - begin)

    def _plans(self, trainer: Trainer, until: Deadline) -> Finding:
        """One plan after the other, each from an observation on the host to actions on the host."""
        policy, context = trainer.average.policy, observation(trainer)
        taken: list[float] = []
        while len(taken) < self.options.plans + 3 and until.allows():
            taken.append(self.machine.seconds(lambda: policy.plan(context.to(self.machine.device)).action.cpu()))
        if len(taken) <= 3:
            return self._out_of_time("plans")
        ms = [1e3 * t for t in taken[3:]]  # the first ones warm up
        middle, late = statistics.median(ms), float(np.percentile(ms, 95))
        assert isinstance(trainer.settings, DiffusionPolicySettings)
        steps = trainer.settings.diffusion.inference_steps
        return PlanLatency(self.profile, self.policy, len(ms), steps, middle, late)

    def _out_of_time(self, what: str) -> NotMeasured:
        return NotMeasured(f"{self.profile}, {self.policy}: {what}", "the budget was used up")


def first_losses(trainer: Trainer, steps: int, until: Deadline) -> list[float]:
    """The losses of so many steps, or of as many as there is time for."""
    losses: list[float] = []
    longest = 0.0
    while len(losses) < steps and until.allows(longest):
        begin = time.monotonic()
        losses.append(trainer.train_step()["loss"])
        longest = max(longest, time.monotonic() - begin)
    return losses


def largest_difference(losses: Sequence[float], reference: Sequence[float]) -> float:
    """Largest difference of a loss from the reference's, as a share of this."""
    return max(abs(mine - true) / abs(true) for mine, true in zip(losses, reference, strict=True))


def restart(trainer: Trainer, weights: dict[str, Tensor]) -> None:
    """Begin anew with the first weights."""
    trainer.load_state(0, {"policy": weights, "average": weights})
    trainer.optimizers = Optimizers(trainer.policy, trainer.settings.optimizer, trainer.run.steps)


@contextmanager
def computing_in(trainer: Trainer, precision: str) -> Iterator[None]:
    """Have a trainer compute in a precision; TF32 is fp32 whose matrix products are rounded."""
    before = torch.get_float32_matmul_precision()
    trainer.processes.precision = "bf16" if precision == "bf16" else "fp32"
    torch.set_float32_matmul_precision("high" if precision == "tf32" else "highest")
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)


def observation(trainer: Trainer) -> ObservationBatch:
    """One observation of random points, with all of them, as a robot gives it."""
    policy, s = trainer.policy, trainer.settings
    cloud, flow, steps = s.needs.point_cloud, s.needs.flow, s.n_obs_steps
    return ObservationBatch(
        points=torch.rand(steps, cloud.points if cloud else 0, 3),
        state=torch.rand(steps, policy.spec.state_width),
        observed=torch.arange(steps)[None],
        queries=torch.rand(1, flow.points if flow else 0, 3),
        task=torch.zeros(1, dtype=torch.long),
    )


def parse_arguments() -> argparse.Namespace:
    """What is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="auto", help="cpu, cuda or cuda:1 [a GPU if there is one]")
    parser.add_argument("--budget", type=float, default=420.0, help="seconds for all of it; what is begun is ended")
    parser.add_argument("--profiles", nargs="+", default=["fast", "paper"], help="names or YAML files")
    parser.add_argument("--policies", nargs="+", default=["dp3", "fdp", "mba"])
    parser.add_argument("--steps", type=int, default=10, help="whose losses are compared")
    parser.add_argument("--rounds", type=int, default=5, help="of training steps; medians over them are given")
    parser.add_argument("--round-seconds", type=float, default=0.4, help="of each way to make a step, roughly")
    parser.add_argument("--plans", type=int, default=50)
    parser.add_argument("--threads", type=int, default=1, help="CPU threads; the reference of a GPU has all cores")
    parser.add_argument("--data", type=Path, help="dataset with tracks and object poses; of push, made if left out")
    parser.add_argument("--json", type=Path, help="also write the figures here")
    return parser.parse_args()


def findings(options: argparse.Namespace, machine: Machine, scratch: Path) -> Iterator[Finding]:
    """All that is found within the budget, case by case, each with an equal share of what is left."""
    whole = Deadline(options.budget)
    data = options.data or scratch / "push"
    if options.data is None:
        extract(["push"], data, recipe=load_recipe("metaworld", ["episodes=10"]), workers=1)
    cases = [(profile, policy) for profile in options.profiles for policy in options.policies]
    for precision in TOLERANCES:
        if (reason := machine.lacks(precision)) is not None:
            yield NotMeasured(f"{precision}, all policies", reason)
    if not machine.is_gpu:
        yield NotMeasured("peak memory, overlap of host and device", "there is no GPU in this run")
    for k, (profile, policy) in enumerate(cases):
        print(f"{profile}, {policy}: {whole.left:.0f} s of the budget are left", file=sys.stderr, flush=True)
        try:
            yield from Case(profile, policy, data, machine, options).measure(whole.part(1 / (len(cases) - k)))
        except torch.OutOfMemoryError:
            yield NotMeasured(f"{profile}, {policy}: the rest", "the device has too little memory for it")


def main() -> int:
    """Measure, print tables; 1 where losses differ."""
    options = parse_arguments()
    begin = time.monotonic()
    try:
        machine = Machine(ProcessGroup(options.device, options.threads, "fp32").device, options.threads)
        found: list[Finding] = []
        with tempfile.TemporaryDirectory() as folder:
            for finding in findings(options, machine, Path(folder)):
                found.append(finding)
                if options.json:  # again and again, so that a run that is cut off leaves what it found
                    write_json(options.json, machine.device, options.threads, time.monotonic() - begin, found)
    except FlowlabError as error:
        print(error, file=sys.stderr)
        return 2
    spent = time.monotonic() - begin
    print(markdown(machine.device, options.threads, spent, found))
    return int(any(isinstance(f, Agreement) and f.verdict == "DIFFERS" for f in found))


if __name__ == "__main__":
    sys.exit(main())
