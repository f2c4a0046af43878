"""From run folders to results."""

import json
import math
import platform
from collections.abc import Sequence
from pathlib import Path

from safetensors import safe_open

from flowlab.benchmark.results import UNITS, Evaluation, PolicyResult, TrainingRecord, read_result
from flowlab.errors import DataError
from flowlab.evaluation.evaluate import EPISODES, FOLDER, CheckpointRef
from flowlab.evaluation.trials import read
from flowlab.policies.checkpoint import newest_checkpoint, read_run_config, read_trained
from flowlab.training.metrics import METRICS, cpu_seconds_spent, last_metrics


def gather(folders: Sequence[Path]) -> list[PolicyResult]:
    """All results of experiments and of evaluated runs. Raises :class:`DataError` where a folder is neither."""
    results = []
    for folder in folders:
        results += find_results(folder) if (folder / UNITS).is_dir() else [_of_run(folder)]
    return results


def find_results(out: Path) -> list[PolicyResult]:
    """All results of an experiment. Raises :class:`DataError` where there is none yet."""
    found = sorted((out / UNITS).glob("*.json"))
    if not found:
        raise DataError(f"{out}: no unit of the experiment is done yet; 'flowlab bench --out {out}' goes on with it")
    return [read_result(path) for path in found]


def _of_run(run: Path) -> PolicyResult:
    """What has been evaluated of a run so far."""
    if not run.exists():
        raise DataError(f"{run}: there is no such folder")
    known = {place: list(read(place / EPISODES).values()) for place in sorted((run / FOLDER).glob("step-*-execute-*"))}
    trained = read_trained(run)
    if not any(known.values()):
        raise DataError(f"{run}: has not been evaluated yet; do so with 'flowlab eval {run}'")
    evaluations = []
    for place, outcomes in known.items():
        _, step, _, n_action_steps = place.name.split("-")
        of_place = tuple(sorted(outcomes, key=lambda o: o.trial))
        evaluations.append(Evaluation(step=int(step), n_action_steps=int(n_action_steps), outcomes=of_place))
    training = describe_training(run)
    return PolicyResult(
        name=run.name,
        label=training.policy,
        tasks=trained.policy.tasks,
        training=training,
        evaluations=tuple(e for e in evaluations if e.outcomes),
    )


def collect(subjects: Sequence[CheckpointRef], evaluations: Sequence[Evaluation]) -> list[PolicyResult]:
    """A result for every run among the subjects, with its evaluations in order of steps."""
    results = []
    for run in dict.fromkeys(s.run for s in subjects):
        mine = [e for s, e in zip(subjects, evaluations, strict=True) if s.run == run]
        training = describe_training(run)
        results.append(
            PolicyResult(
                name=run.name,
                label=training.policy,
                tasks=read_trained(run).policy.tasks,
                training=training,
                evaluations=tuple(sorted(mine, key=lambda e: e.step)),
            )
        )
    return results


def describe_training(run: Path) -> TrainingRecord:
    """How the policy of a run was trained."""
    planned, trained = read_run_config(run), read_trained(run)
    with safe_open(newest_checkpoint(run), "pt") as file:
        weights = sum(math.prod(file.get_slice(name).get_shape()) for name in file.keys())  # noqa: SIM118 - no mapping
    settings = trained.policy.settings
    return TrainingRecord(
        policy=settings.policy,
        settings=json.loads(settings.model_dump_json()),
        steps=planned.steps,
        cpu_s=round(cpu_seconds_spent(run / METRICS), 1),
        weights=weights,
        device=planned.device,
        precision=planned.precision,
        demonstrations=len(planned.train),
        held_out={name: round(value, 5) for name, value in last_metrics(run / METRICS, "validation").items()},
        versions=trained.versions,
        processor=_processor(),
    )


def _processor() -> str:
    """Name of the processor, where the system tells it."""
    about = Path("/proc/cpuinfo")
    names = [x for x in (about.read_text() if about.exists() else "").split("\n") if x.startswith("model name")]
    return names[0].partition(":")[2].strip() if names else platform.processor() or platform.machine()
