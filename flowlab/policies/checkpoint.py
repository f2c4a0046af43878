"""A training run on disk: what a policy is (JSON), its weights (safetensors), and what resuming needs."""

import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy
import safetensors
import torch
from pydantic import ValidationError
from safetensors.torch import load_file, save_file
from torch import Tensor

from flowlab.config import Settings, explain
from flowlab.data.replay_buffer import ReplayBuffer
from flowlab.data.source import TrainingSource
from flowlab.errors import DataError, UsageError
from flowlab.files import remove_leftovers, temporary_path, write_json
from flowlab.policies.base import PolicyNetwork, PolicySpec, make_policy
from flowlab.policies.migrations import FORMAT, is_old, migrate_policy, migrate_tensor
from flowlab.storage.manifest import differences
from flowlab.untrusted import read_json
from flowlab.version import __version__

POLICY = "policy.json"
RUN = "run.json"
RESUME = "resume.safetensors"
CHECKPOINTS = "checkpoints"
_ADVICE = "delete it to use the checkpoint before it"
Model = TypeVar("Model", bound=Settings)


class TrainedPolicy(Settings):
    """``policy.json``: what a policy is, and what it was trained on."""

    format: int = FORMAT
    policy: PolicySpec
    dataset: str
    """Path of the dataset as it was given."""
    fingerprint: str
    """Of the dataset's content."""
    scene_seeds: Mapping[str, tuple[int, ...]] = {}
    """Seeds of all simulated layouts in the dataset, by task, so that nobody evaluates on them."""
    scene: Mapping[str, Any] | None = None
    """Settings of the simulated scene; None where the dataset was recorded."""
    versions: Mapping[str, str]
    """Of what it was trained with."""

    @classmethod
    def now(cls, policy: PolicySpec, source: TrainingSource, buffer: ReplayBuffer) -> "TrainedPolicy":
        """A policy trained on a source by this flowlab."""
        about = source.provenance
        seeds = {t: tuple(e.seed for e in buffer.episodes if e.task == t) for t in buffer.tasks}
        return cls(
            policy=policy,
            dataset=str(source.path),
            fingerprint=source.fingerprint,
            scene_seeds=seeds if about.is_simulated else {},
            scene=about.scene,
            versions={"flowlab": __version__, "torch": torch.__version__, "numpy": numpy.__version__},
        )


class RunConfig(Settings):
    """``run.json``: how a run goes; written when it begins, it stays the same until it ends."""

    dataset: Path
    steps: int
    train: tuple[int, ...]
    """Episodes trained on, by their position in the :class:`~flowlab.data.replay_buffer.ReplayBuffer`."""
    held_out: tuple[int, ...]
    """Episodes to validate on."""
    threads: int
    device: str
    precision: str
    logs: tuple[str, ...]
    began_from: str | None
    """Checkpoint that the first weights are from."""


@dataclass(frozen=True, slots=True)
class LoadedPolicy:
    """A policy from disk, ready for use."""

    policy: PolicyNetwork
    trained: TrainedPolicy
    step: int
    """Training steps its weights have seen."""
    path: Path
    """Of the weights."""


def load_policy(path: Path, device: str = "cpu") -> LoadedPolicy:
    """The policy of a run, with its newest weights, or of one checkpoint of it.

    Args:
        path: Folder of a run, or one of its checkpoints.
        device: Where it computes.

    Raises:
        DataError: There is none, it is damaged, or its policy is not installed here.
    """
    weights = path if path.suffix == ".safetensors" else newest_checkpoint(path)
    folder = weights.absolute().parents[1]
    trained = read_trained(folder)
    tensors, step = _read(weights, folder, _ADVICE)
    policy = make_policy(trained.policy).requires_grad_(False).eval()
    try:
        policy.load_state_dict(tensors)
    except RuntimeError as error:
        raise DataError(f"{weights}: does not fit {folder / POLICY}; restore both from one run") from error
    return LoadedPolicy(policy.to(device), trained, step, weights)


def newest_checkpoint(run: Path) -> Path:
    """The weights of a run that have seen most steps. Raises :class:`DataError` where there are none."""
    read_trained(run)
    checkpoints = sorted((run / CHECKPOINTS).glob("step-*.safetensors"))
    if not checkpoints:
        raise DataError(f"{run}: has no checkpoint yet; resume it with 'flowlab train {run} --resume'")
    return checkpoints[-1]


def step_of(weights: Path) -> int:
    """Training steps that a checkpoint has seen. Raises :class:`DataError` where it is damaged."""
    with _understood(weights, _ADVICE), safetensors.safe_open(weights, "pt") as file:
        return int((file.metadata() or {})["step"])


def read_trained(folder: Path) -> TrainedPolicy:
    """``policy.json`` of a run."""
    path = folder / POLICY
    if not path.exists():
        raise DataError(f"{folder}: not a training run (it has no {POLICY})")
    return _validated(TrainedPolicy, path)


def read_run_config(folder: Path) -> RunConfig:
    """``run.json`` of a run."""
    path = folder / RUN
    if not path.exists():
        raise DataError(f"{folder}: no run to resume (it has no {RUN}); start one with 'flowlab train DATASET --out'")
    return _validated(RunConfig, path)


def check_observer(trained: TrainedPolicy, where: Path, source: TrainingSource) -> None:
    """Refuse data whose clouds were made with other settings than those a policy knows, showing the difference."""
    mine, theirs = trained.policy.observer, source.provenance.observer
    if mine is None and theirs is None:
        return
    lines = list(
        differences(
            json.loads(json.dumps(theirs)),
            json.loads(json.dumps(mine)),
            "observer",
            owners=("the dataset", "the policy"),
        )
    )
    if lines:
        raise DataError(
            f"{source.path}: its point clouds were made with other settings than those that {where} was trained with; "
            "make the dataset again with the policy's, or train a new policy:\n  " + "\n  ".join(lines)
        )


def save_weights(folder: Path, policy: PolicyNetwork, step: int) -> Path:
    """Keep the weights of a policy as a checkpoint of a run."""
    path = folder / CHECKPOINTS / f"step-{step:08d}.safetensors"
    path.parent.mkdir(exist_ok=True)
    remove_leftovers(path.parent)
    _write(path, policy.state_dict(), step)
    return path


def save_resume(folder: Path, step: int, groups: Mapping[str, Mapping[str, Tensor]]) -> None:
    """Keep everything that goes on changing: named groups of tensors, as they are after ``step`` steps."""
    tensors = {f"{group}:{name}": value for group, values in groups.items() for name, value in values.items()}
    _write(folder / RESUME, tensors, step)


def read_resume(folder: Path) -> tuple[int, dict[str, dict[str, Tensor]]]:
    """The step, and the groups of :func:`save_resume`."""
    path = folder / RESUME
    if not path.exists():
        raise DataError(f"{folder}: nothing to resume (it has no {RESUME}); delete it and start anew")
    tensors, step = _read(path, folder, f"start anew; --from {folder} begins with its newest weights")
    groups: dict[str, dict[str, Tensor]] = {}
    for name, value in tensors.items():
        group, _, rest = name.partition(":")
        groups.setdefault(group, {})[rest] = value
    return step, groups


@contextmanager
def writing_run(folder: Path) -> Iterator[None]:
    """Turns a failure to write into a sentence; what was there before is whole."""
    try:
        yield
    except (OSError, safetensors.SafetensorError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise DataError(
            f"{folder}: cannot be written ({reason}); what was saved before is whole. Make room, then go on with "
            f"'flowlab train {folder} --resume'"
        ) from error


def start_folder(folder: Path, trained: TrainedPolicy, run: RunConfig) -> None:
    """Make the folder of a new run. Raises :class:`UsageError` where there is one already."""
    if (folder / RUN).exists() or (folder / POLICY).exists():
        raise UsageError(
            f"{folder}: holds a run already; go on with 'flowlab train {folder} --resume', or choose another --out"
        )
    with writing_run(folder):
        folder.mkdir(parents=True, exist_ok=True)
        write_json(folder / POLICY, json.loads(trained.model_dump_json()))
        write_json(folder / RUN, json.loads(run.model_dump_json()))


def _write(path: Path, tensors: Mapping[str, Tensor], step: int) -> None:
    temporary = temporary_path(path)
    try:
        with writing_run(path.parent if path.name == RESUME else path.parents[1]):
            save_file({k: v.detach().cpu().contiguous() for k, v in tensors.items()}, temporary, {"step": str(step)})
            os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def _read(path: Path, run: Path, advice: str) -> tuple[dict[str, Tensor], int]:
    """Tensors of a run, and the step they are of."""
    old = is_old(read_json(run / POLICY))
    with _understood(path, advice):
        with safetensors.safe_open(path, "pt") as file:
            about = file.metadata() or {}
        tensors, step = load_file(path), int(about["step"])
    return {migrate_tensor(name) if old else name: value for name, value in tensors.items()}, step


@contextmanager
def _understood(path: Path, advice: str) -> Iterator[None]:
    """Turns a failure to read weights into a sentence."""
    if not path.exists():
        raise DataError(f"{path}: there is no such checkpoint")
    try:
        yield
    except KeyError as error:
        raise DataError(f"{path}: not written by flowlab (it does not tell its step); {advice}") from error
    except (OSError, safetensors.SafetensorError) as error:
        raise DataError(f"{path}: damaged ({error}); {advice}") from error


def _validated(model: type[Model], path: Path) -> Model:
    values: Any = migrate_policy(read_json(path)) if model is TrainedPolicy else read_json(path)
    found = values.get("format", FORMAT) if isinstance(values, dict) else None
    if found != FORMAT:
        raise DataError(f"{path}: format is {found}, this flowlab reads {FORMAT}; use the flowlab that wrote it")
    try:
        return model.model_validate(values)
    except ValidationError as error:
        raise DataError(f"{path}: {explain(error, model)}") from error
    except UsageError as error:
        told = isinstance(error.__cause__, ModuleNotFoundError)  # where such a module may lie
        advice = "" if told else "; install what has this policy, or put its module's folder on PYTHONPATH"
        raise DataError(f"{path}: {error}{advice}") from error
