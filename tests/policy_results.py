"""Results of policies counted by hand, for the tests of summaries and reports."""

import math
from collections.abc import Sequence
from fractions import Fraction
from typing import Any

from flowlab.evaluation.results import (
    CheckpointEvaluation,
    EpisodeResult,
    PolicyResult,
    RolloutFlowError,
    TrainingRecord,
)
from flowlab.evaluation.trials import Trial

SETTINGS: dict[str, Any] = {
    "n_action_steps": 8,
    "motion": {"flow_representation": "per-query", "condition": "one-step"},
    "action": {"kind": "mlp"},
    "batch": {"shift_m": 0.1, "turn_deg": 20.0},
}


def flow(ade: float, *, pairs: int = 100, ends: int = 10, still: int = 50, **changes: float) -> RolloutFlowError:
    values = {
        "ade_mm": ade, "zero_ade_mm": 3 * ade, "fde_mm": 2 * ade, "zero_fde_mm": 5 * ade, "apd": 0.6, "zero_apd": 0.3,
        "average_jaccard": 0.5, "zero_average_jaccard": 0.2, "still_mm": 1.0,
    }  # fmt: skip
    return RolloutFlowError(pairs=pairs, ends=ends, still_pairs=still, **(values | changes))


def outcomes(
    task: str, solved: str, *, seed: int = 0, first: int = 0, error: RolloutFlowError | None = None
) -> list[EpisodeResult]:
    """One for each letter: ``s`` solved, ``l`` solved but lost when DP3's runner looks, ``f`` failed, ``b`` broke down.
    The k-th solved episode takes 10 * k steps."""
    made: list[EpisodeResult] = []
    for k, letter in enumerate(solved):
        won = letter in "sl"
        trial = Trial(task, seed, first + k)
        made.append(
            EpisodeResult(
                task=task,
                seed=seed,
                episode=first + k,
                scene_seed=trial.scene_seed,
                success=won,
                success_dp3=letter == "s",
                steps=10 * (1 + sum(o.success for o in made)) if won else 200,
                note="the physics broke down: <script>alert(1)</script>" if letter == "b" else "",
                flow=error,
            )
        )
    return made


def training(policy: str, **changes: Any) -> TrainingRecord:
    values = {
        "policy": policy, "settings": SETTINGS, "steps": 1000, "cpu_s": 240.0, "weights": 5_000_000, "device": "cpu",
        "precision": "bf16", "demonstrations": 10, "held_out": {"action_l1": 0.02, "action_l1_zero": 0.4},
        "versions": {"flowlab": "0.1.0", "torch": "2.13.0"}, "processor": "Some CPU",
    }  # fmt: skip
    return TrainingRecord.model_validate(values | changes)


def result(
    label: str,
    *tried: list[EpisodeResult],
    name: str = "",
    evaluations: Sequence[CheckpointEvaluation] = (),
    **changes: Any,
) -> PolicyResult:
    of = [o for part in tried for o in part]
    last = [CheckpointEvaluation(step=1000, n_action_steps=8, outcomes=tuple(of))] if of else []
    tasks = tuple(dict.fromkeys(o.task for e in (*evaluations, *last) for o in e.outcomes))
    return PolicyResult(
        name=name or "-".join((*tasks, label)),
        label=label,
        tasks=tasks,
        training=training(label.partition("-")[0], **changes),
        evaluations=(*evaluations, *last),
    )


def wilson(k: int, n: int) -> tuple[float, float]:
    """By the textbook's formula, with the normal's 97.5 % quantile."""
    z = 1.959963984540054
    middle = (k + z * z / 2) / (n + z * z)
    half = z / (n + z * z) * math.sqrt(k * (n - k) / n + z * z / 4)
    return middle - half, middle + half


def mcnemar(b: int, c: int) -> float:
    """Exact and two-sided: the chance of splits no likelier than this one, counted in whole numbers."""
    n = b + c
    ways = [math.comb(n, k) for k in range(n + 1)]
    return float(Fraction(sum(w for w in ways if w <= ways[b]), 2**n))


EXAMPLE = [
    result("dp3", outcomes("push", "ssslffffbf"), cpu_s=120.0),
    result("fdp", outcomes("push", "sssssslfff", error=flow(4.0))),
    result("fdp", outcomes("assembly", "ssff", error=flow(10.0, pairs=300, ends=20))),
    result("dp3", outcomes("assembly", "sfff")),
    result("dp3", outcomes("hammer", "ss")),
]
"""dp3 4 of 10, 1 of 4, 2 of 2; fdp 7 of 10, 2 of 4, and no hammer."""


def evaluation(step: int, solved: str, n_action_steps: int = 8, task: str = "push") -> CheckpointEvaluation:
    return CheckpointEvaluation(step=step, n_action_steps=n_action_steps, outcomes=tuple(outcomes(task, solved)))
