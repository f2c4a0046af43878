"""How the policy of a run came about, from what the run has written."""

import json
import platform
from collections.abc import Sequence
from pathlib import Path

from flowlab.evaluation.results import CheckpointEvaluation, PolicyResult, TrainingRecord
from flowlab.policies.run_config import read_run_config
from flowlab.policies.trained import count_weights, newest_checkpoint, read_trained
from flowlab.training.metrics import cpu_seconds_spent, last_metrics
from flowlab.viz.training_metrics import METRICS


def describe_training(run: Path) -> TrainingRecord:
    """How the policy of a run was trained. Raises :class:`DataError` where the folder is no run with a checkpoint."""
    planned, trained = read_run_config(run), read_trained(run)
    settings = trained.policy.settings
    return TrainingRecord(
        policy=settings.policy,
        settings=json.loads(settings.model_dump_json()),
        steps=planned.steps,
        cpu_s=round(cpu_seconds_spent(run / METRICS), 1),
        weights=count_weights(newest_checkpoint(run)),
        device=planned.device,
        precision=planned.precision,
        demonstrations=len(planned.train),
        held_out={name: round(value, 5) for name, value in last_metrics(run / METRICS, "validation").items()},
        versions=trained.versions,
        processor=_processor(),
    )


def describe_run(run: Path, evaluations: Sequence[CheckpointEvaluation]) -> PolicyResult:
    """A run with its evaluations, named after its folder and labeled by the kind of its policy."""
    training = describe_training(run)
    return PolicyResult(
        name=run.name,
        label=training.policy,
        tasks=read_trained(run).policy.tasks,
        training=training,
        evaluations=tuple(sorted(evaluations, key=lambda e: e.step)),
    )


def _processor() -> str:
    """Name of the processor, where the system tells it."""
    about = Path("/proc/cpuinfo")
    names = [x for x in (about.read_text() if about.exists() else "").split("\n") if x.startswith("model name")]
    return names[0].partition(":")[2].strip() if names else platform.processor() or platform.machine()
