"""The folder of a training run: how the run goes, and what resuming needs, beside the policy and its weights."""

import json
import math
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from flowlab.checksums import with_checksum
from flowlab.errors import DataError, UsageError
from flowlab.files import remove_leftovers, write_json
from flowlab.policies.checkpoint import read_run_tensors
from flowlab.policies.run_config import RunConfig, has_begun
from flowlab.policies.tensor_files import write_tensors
from flowlab.policies.trained import (
    FREE,
    POLICY,
    RESUME,
    RUN,
    TrainedPolicy,
    checkpoint_files,
    identity,
    identity_in,
    writing_run,
)

Groups = Mapping[str, Mapping[str, Tensor]]
"""Tensors by group and name."""


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
