"""What is known of a trained policy: how it was trained, and how it did. Reports are made of these."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from flowlab.config import Settings, explain
from flowlab.errors import DataError
from flowlab.evaluation.trials import EpisodeResult
from flowlab.files import read_json, write_atomically

UNITS = "units"
"""Folder of an experiment that holds its results."""


class Evaluation(Settings):
    """Rollouts of one checkpoint."""

    step: int
    """Training steps its weights have seen."""
    n_action_steps: int
    """Steps of every plan that were executed."""
    outcomes: tuple[EpisodeResult, ...]


class TrainingRecord(Settings):
    """How a policy came about."""

    policy: str
    """fdp, dp3 or mba."""
    settings: Mapping[str, Any]
    """All settings of the run."""
    steps: int
    cpu_s: float
    """CPU time of training, validation included [s]."""
    weights: int
    """Numbers that were learned."""
    device: str
    """cpu or cuda."""
    precision: str
    demonstrations: int
    held_out: Mapping[str, float]
    """Errors on held-out demonstrations at the end, as in ``metrics.jsonl``."""
    versions: Mapping[str, str]
    processor: str


class PolicyResult(Settings):
    """A policy, its training and its evaluations."""

    name: str
    """Unique within a report, such as ``push-fdp-m50``."""
    label: str
    """What the policy is called in tables, the same for every task: ``fdp``, ``dp3``, ``fdp-m50``."""
    tasks: tuple[str, ...]
    training: TrainingRecord
    evaluations: tuple[Evaluation, ...]
    """In order of steps; the last is of the newest weights and is the one that counts."""

    @property
    def final(self) -> Sequence[EpisodeResult]:
        """Outcomes of the newest weights, executing what the policy was trained to execute."""
        newest = [e for e in self.evaluations if e.step == self.evaluations[-1].step]
        usual = [e for e in newest if e.n_action_steps == self.training.settings["n_action_steps"]]
        return (usual or newest)[-1].outcomes


def write_result(path: Path, result: PolicyResult) -> None:
    """Write a result as JSON, in one step. Every outcome is a line of its own."""
    text = json.dumps(result.model_dump(mode="json", exclude_defaults=True))
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, text.replace(' {"task":', '\n{"task":').replace('[{"task":', '[\n{"task":') + "\n")


def read_result(path: Path) -> PolicyResult:
    """The inverse of :func:`write_result`. Raises :class:`DataError` where the file is damaged."""
    try:
        return PolicyResult.model_validate(read_json(path))
    except ValidationError as error:
        raise DataError(
            f"{path}: {explain(error, PolicyResult)}; restore it, or delete it and the experiment does it again"
        ) from error
