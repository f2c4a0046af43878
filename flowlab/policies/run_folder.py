"""The folder of a training run: how the run goes, and what resuming needs, beside the policy and its weights."""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import torch
from pydantic import model_validator
from torch import Tensor

from flowlab.checksums import with_checksum
from flowlab.config import Settings, later
from flowlab.data.mixture import Count, Weight
from flowlab.errors import DataError, UsageError
from flowlab.files import remove_leftovers, write_json
from flowlab.policies.checkpoint import (
    FREE,
    POLICY,
    RESUME,
    RUN,
    TrainedPolicy,
    checkpoint_files,
    identity,
    identity_in,
    read_run_tensors,
    validated,
    writing_run,
)
from flowlab.policies.tensor_files import write_tensors

Groups = Mapping[str, Mapping[str, Tensor]]
"""Tensors by group and name."""


class RunConfig(Settings):
    """``run.json``: how a run goes; written when it begins, it stays the same until it ends."""

    dataset: Path
    more_datasets: tuple[Path, ...] = ()
    """Where there are several, the others."""
    steps: Count
    train: tuple[Count, ...]
    """Episodes trained on, by their position in the :class:`~flowlab.data.replay_buffer.ReplayBuffer`."""
    held_out: tuple[Count, ...]
    """Episodes to validate on."""
    inferred: tuple[Count, ...] = ()
    """Those of all whose actions were inferred."""
    threads: int
    device: str
    precision: str
    logs: tuple[str, ...]
    began_from: str | None
    """Checkpoint that the first weights are from."""
    overfit: int | None = None
    """How many demonstrations are trained on and validated on, where they are the same."""
    weights: Annotated[tuple[Weight, ...], later(())] = ()
    """Of the datasets, in their order; empty where all windows are drawn alike."""

    @model_validator(mode="after")
    def _one_for_each(self) -> "RunConfig":
        if self.weights and len(self.weights) != len(self.datasets):
            raise ValueError(f"weights: there are {len(self.weights)} for {len(self.datasets)} datasets")
        return self

    @property
    def datasets(self) -> tuple[Path, ...]:
        """All that it is trained on."""
        return self.dataset, *self.more_datasets


def read_run_config(folder: Path) -> RunConfig:
    """``run.json`` of a run."""
    path = folder / RUN
    if not path.exists():
        raise DataError(f"{folder}: no run to resume (it has no {RUN}); start one with 'flowlab train DATASET --out'")
    return validated(RunConfig, path, FREE)


def check_positions(folder: Path, run: RunConfig, episodes: int) -> None:
    """Refuse a run that tells of more demonstrations than there are. Raises :class:`DataError`."""
    if (last := max((*run.train, *run.held_out), default=-1)) >= episodes:
        raise DataError(
            f"{folder / RUN}: tells of demonstration {last}, counted from 0, and there are {episodes}; restore it"
        )


def save_resume(folder: Path, step: int, groups: Groups) -> None:
    """Keep everything that goes on changing: named groups of tensors, as they are after ``step`` steps."""
    with writing_run(folder):
        _write_resume(folder, step, groups, identity_in(folder / POLICY), identity_in(folder / RUN))


def read_resume(folder: Path) -> tuple[int, Groups]:
    """The step, and the groups of :func:`save_resume`."""
    path = folder / RESUME
    if not path.exists():
        raise DataError(f"{folder}: nothing to resume (it has no {RESUME}); start anew, into another --out")
    tensors, step = read_run_tensors(path, folder, f"start anew; --from {folder} begins with its newest weights")
    groups: dict[str, dict[str, Tensor]] = {}
    for name, value in tensors.items():
        group, _, rest = name.partition(":")
        groups.setdefault(group, {})[rest] = value
    return step, groups


def lines_behind(groups: Groups) -> int:
    """How many lines of metrics there were when a resume file was written; 0 where it does not tell."""
    lines = float(groups.get("metrics", {}).get("lines", torch.tensor(0)))
    return int(lines) if math.isfinite(lines) else 0


def has_begun(folder: Path) -> bool:
    """Whether a folder holds a run that can go on, or has come to its end; not what a kill left of a beginning."""
    kept = (folder / RESUME).exists() or any(checkpoint_files(folder))
    return kept and (folder / POLICY).exists()


def start_folder(folder: Path, trained: TrainedPolicy, run: RunConfig, groups: Groups) -> None:
    """Make a new run of a folder: one that can be resumed, as soon as the last of its files is there.

    Args:
        folder: Where; what a kill left of an earlier beginning is replaced.
        trained: What the policy is.
        run: How the run goes.
        groups: What goes on changing, as it is before the first step.

    Raises:
        UsageError: There is a run already.
    """
    if has_begun(folder):
        raise UsageError(
            f"{folder}: holds a run already; go on with 'flowlab train {folder} --resume', or choose another --out"
        )
    if checkpoint_files(folder):
        raise UsageError(f"{folder}: holds checkpoints, but no {POLICY} that says of what; choose another --out")
    about = with_checksum(json.loads(trained.model_dump_json()))
    plan = with_checksum(json.loads(run.model_dump_json()), FREE)
    with writing_run(folder, "nothing was begun. Make room, then give the same command again, or choose another --out"):
        folder.mkdir(parents=True, exist_ok=True)
        remove_leftovers(folder)
        (folder / POLICY).unlink(missing_ok=True)
        _write_resume(folder, 0, groups, identity(about), identity(plan))
        write_json(folder / RUN, plan)
        write_json(folder / POLICY, about)


def _write_resume(folder: Path, step: int, groups: Groups, policy: str, run: str) -> None:
    tensors = {f"{group}:{name}": value for group, values in groups.items() for name, value in values.items()}
    checkpoints = [path.name for path in checkpoint_files(folder)]
    about = {"step": step, "policy": policy, "run": run, "checkpoints": checkpoints}
    write_tensors(folder / RESUME, tensors, about)
