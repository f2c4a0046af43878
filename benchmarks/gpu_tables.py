"""What ``gpu.py`` finds, and how it is told: Markdown tables, and JSON."""

import json
import math
import os
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from flowlab.training.precision import has_bf16


@dataclass(frozen=True, slots=True)
class TrainingSpeed:
    """How fast a policy trains in one precision: medians over rounds."""

    profile: str
    policy: str
    precision: str
    rounds: int
    steps_per_s: float
    slowest: float
    """Round [steps/s]."""
    fastest: float
    """Round [steps/s]."""
    gather_ms: float
    """To make one batch, on its own."""
    waits_for_batch: float
    """Share of a step that is saved where the batch lies on the device already."""
    waits_for_noise: float
    """Share of a step that is saved where its noise does, too."""
    peak_mb: float | None
    """Of the device's memory; None without a GPU."""

    @classmethod
    def of(
        cls, profile: str, policy: str, precision: str, rounds: Sequence[Mapping[str, float]], peak_mb: float | None
    ) -> "TrainingSpeed":
        """From the seconds that a step took in each round, in each way."""

        def share(more: str, less: str) -> float:
            return statistics.median((r[more] - r[less]) / r["step"] for r in rounds)

        rates = [1 / r["step"] for r in rounds]
        gather_ms = 1e3 * statistics.median(r["gather"] for r in rounds)
        waits = share("step", "batch kept"), share("batch kept", "batch and noise kept")
        middle = statistics.median(rates)
        return cls(
            profile, policy, precision, len(rates), middle, min(rates), max(rates), gather_ms, *waits, peak_mb
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class Agreement:
    """How far the first losses are from the CPU's in fp32."""

    profile: str
    policy: str
    precision: str
    steps: int
    difference: float
    """Largest, relative; infinite where a loss was no number."""
    tolerance: float

    @property
    def verdict(self) -> str:
        """``exact``, ``agrees`` or ``DIFFERS``."""
        if self.difference == 0:
            return "exact"
        return "agrees" if self.difference <= self.tolerance else "DIFFERS"


@dataclass(frozen=True, slots=True)
class PlanLatency:
    """How long plans for one observation take, in fp32, the copies to and from the device included."""

    profile: str
    policy: str
    plans: int
    denoising_steps: int
    median_ms: float
    p95_ms: float


@dataclass(frozen=True, slots=True)
class NotMeasured:
    """What was left out, and why."""

    what: str
    why: str


Finding = TrainingSpeed | Agreement | PlanLatency | NotMeasured

_Columns = Mapping[str, Callable[[Any], str]]
_CASE: _Columns = {"profile": lambda f: Path(f.profile).stem, "policy": lambda f: f.policy}
_IN: _Columns = {**_CASE, "precision": lambda f: f.precision}
_TABLES: Mapping[type[Finding], _Columns] = {
    TrainingSpeed: {
        **_IN,
        "steps/s": lambda f: f"{f.steps_per_s:.3g}",
        "slowest to fastest round": lambda f: f"{f.slowest:.3g} to {f.fastest:.3g} of {f.rounds}",
        "batch alone, ms": lambda f: f"{f.gather_ms:.1f}",
        "waits for batch": lambda f: f"{f.waits_for_batch:.0%}",
        "waits for noise": lambda f: f"{f.waits_for_noise:.0%}",
        "peak memory, MB": lambda f: "-" if f.peak_mb is None else f"{f.peak_mb:.0f}",
    },
    Agreement: {
        **_IN,
        "steps": lambda f: str(f.steps),
        "largest relative difference": lambda f: f"{f.difference:.1e}",
        "tolerance": lambda f: f"{f.tolerance:.0e}",
        "verdict": lambda f: f.verdict,
    },
    PlanLatency: {
        **_CASE,
        "plans": lambda f: str(f.plans),
        "DDIM steps": lambda f: str(f.denoising_steps),
        "median, ms": lambda f: f"{f.median_ms:.1f}",
        "95th percentile, ms": lambda f: f"{f.p95_ms:.1f}",
    },
    NotMeasured: {"not measured": lambda f: f.what, "why": lambda f: f.why},
}


def describe(device: torch.device, threads: int) -> str:
    """Device, host and libraries, in one line."""
    bf16 = "with" if has_bf16(torch.device("cpu")) else "without"
    load = ", ".join(f"{x:.1f}" for x in os.getloadavg())
    host = f"CPU {_cpu_model()} of {os.cpu_count()} cores, {bf16} units for bf16, load {load}"
    if device.type != "cuda":
        return (
            f"Measured on the CPU, no GPU was used: {threads} thread(s), CPU time. {host}. PyTorch {torch.__version__}."
        )
    gpu = torch.cuda.get_device_properties(device)
    about = f"{gpu.name}, compute capability {gpu.major}.{gpu.minor}, {gpu.total_memory / 1e9:.0f} GB"
    return (
        f"Measured on {device}, {about}, by the clock. {host}. PyTorch {torch.__version__}, CUDA {torch.version.cuda}."
    )


def _cpu_model() -> str:
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), "of no known name")


def markdown(device: torch.device, threads: int, spent: float, found: Sequence[Finding]) -> str:
    """A table for each kind of finding."""
    parts = [f"{describe(device, threads)} {spent:.0f} s in all."]
    for kind, columns in _TABLES.items():
        if rows := [[text(f) for text in columns.values()] for f in found if isinstance(f, kind)]:
            parts.append("\n".join(f"| {' | '.join(row)} |" for row in (columns, ["---"] * len(columns), *rows)))
    return "\n\n".join(parts)


def write_json(path: Path, device: torch.device, threads: int, spent: float, found: Sequence[Finding]) -> None:
    """The same figures, unrounded."""
    names = {TrainingSpeed: "training", Agreement: "agreement", PlanLatency: "plans", NotMeasured: "not_measured"}
    by_kind: dict[str, list[dict[str, Any]]] = {name: [] for name in names.values()}
    for f in found:
        values = asdict(f)
        if isinstance(f, Agreement):
            values |= {"difference": f.difference if math.isfinite(f.difference) else None, "verdict": f.verdict}
        by_kind[names[type(f)]].append(values)
    head = {"device": str(device), "machine": describe(device, threads), "seconds": spent}
    path.write_text(json.dumps(head | by_kind, indent=1) + "\n")
