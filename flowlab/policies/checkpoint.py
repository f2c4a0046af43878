"""A training run on disk: what a policy is (JSON), its weights (safetensors), and what resuming needs."""

import hashlib
import json
import math
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy
import safetensors
import torch
from pydantic import ValidationError
from safetensors.torch import load_file, save_file
from torch import Tensor

from flowlab.checksums import json_checksum, with_checksum, without_checksum
from flowlab.config import Settings, explain
from flowlab.data.replay_buffer import ReplayBuffer
from flowlab.data.source import TrainingSource
from flowlab.errors import DataError, FlowlabError, UsageError, first_line
from flowlab.files import check_inside, new_file, remove_leftovers, write_json
from flowlab.policies.base import PolicyNetwork, PolicySpec, make_policy
from flowlab.policies.migrations import FORMAT, is_old, migrate_policy, migrate_tensor
from flowlab.registry import names_from_file
from flowlab.storage.manifest import differences
from flowlab.text import shown
from flowlab.untrusted import parse_json, read_json
from flowlab.version import __version__

POLICY = "policy.json"
RUN = "run.json"
RESUME = "resume.safetensors"
CHECKPOINTS = "checkpoints"
_ADVICE = "delete it to use the checkpoint before it"
_RESTORE = "restore it from a copy, or train anew into another --out"
_ABOUT = "flowlab"
"""Key under which a file of tensors says what it is."""
_FREE = ("dataset",)
"""What people may change in ``run.json``: where the dataset is, whose content is checked."""
Model = TypeVar("Model", bound=Settings)
Groups = Mapping[str, Mapping[str, Tensor]]
"""Tensors by group and name."""


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
    overfit: int | None = None
    """How many demonstrations are trained on and validated on, where they are the same."""


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
    if re.fullmatch(r"step-\d{8}\.safetensors", weights.name) and weights.name != _checkpoint_name(step):
        raise DataError(f"{weights}: holds the weights after {step} steps; restore it, or call it after them")
    policy = build_policy(trained.policy, tensors, f"{weights}: does not fit {folder / POLICY}")
    return LoadedPolicy(policy.requires_grad_(False).eval().to(device), trained, step, weights)


def _checkpoint_name(step: int) -> str:
    return f"step-{step:08d}.safetensors"


def build_policy(spec: PolicySpec, tensors: Mapping[str, Tensor], misfit: str) -> PolicyNetwork:
    """The policy of a spec with these weights. Raises :class:`DataError`, with ``misfit``, where they do not fit it.

    That is told by their shapes before memory is taken for a network that may be of any size.
    """
    try:
        with suppress(NotImplementedError, TypeError), torch.device("meta"):  # some networks need real numbers
            if {n: v.shape for n, v in make_policy(spec).state_dict().items()} != {
                n: v.shape for n, v in tensors.items()
            }:
                raise DataError(f"{misfit}; restore both from one run")
        policy = make_policy(spec)
        policy.load_state_dict(tensors)
    except RuntimeError as error:
        raise DataError(f"{misfit}; restore both from one run") from error
    return policy


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
        return int(_metadata(file, str(weights), _ADVICE)["step"])


def count_weights(weights: Path) -> int:
    """How many numbers a checkpoint holds. Raises :class:`DataError` where it is damaged."""
    with _understood(weights, _ADVICE), safetensors.safe_open(weights, "pt") as file:
        return sum(math.prod(file.get_slice(name).get_shape()) for name in file.keys())  # noqa: SIM118 - no mapping


def read_trained(folder: Path) -> TrainedPolicy:
    """``policy.json`` of a run."""
    path = folder / POLICY
    if not path.exists():
        raise DataError(
            f"{folder}: not a training run (it has no {POLICY}); what a kill left of one begins again with the command "
            "that began it"
        )
    return _validated(TrainedPolicy, path)


def read_run_config(folder: Path) -> RunConfig:
    """``run.json`` of a run."""
    path = folder / RUN
    if not path.exists():
        raise DataError(f"{folder}: no run to resume (it has no {RUN}); start one with 'flowlab train DATASET --out'")
    return _validated(RunConfig, path, _FREE)


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
    path = folder / CHECKPOINTS / _checkpoint_name(step)
    with writing_run(folder):
        check_inside(folder, path.parent)
        path.parent.mkdir(exist_ok=True)
        remove_leftovers(path.parent)
        _write(path, policy.state_dict(), {"step": step, "policy": _identity_in(folder / POLICY)})
    return path


def save_resume(folder: Path, step: int, groups: Groups) -> None:
    """Keep everything that goes on changing: named groups of tensors, as they are after ``step`` steps."""
    with writing_run(folder):
        _write_resume(folder, step, groups, _identity_in(folder / POLICY), _identity_in(folder / RUN))


def read_resume(folder: Path) -> tuple[int, Groups]:
    """The step, and the groups of :func:`save_resume`."""
    path = folder / RESUME
    if not path.exists():
        raise DataError(f"{folder}: nothing to resume (it has no {RESUME}); start anew, into another --out")
    tensors, step = _read(path, folder, f"start anew; --from {folder} begins with its newest weights")
    groups: dict[str, dict[str, Tensor]] = {}
    for name, value in tensors.items():
        group, _, rest = name.partition(":")
        groups.setdefault(group, {})[rest] = value
    return step, groups


def lines_behind(groups: Groups) -> int:
    """How many lines of metrics there were when a resume file was written; 0 where it does not tell."""
    return int(groups.get("metrics", {}).get("lines", torch.tensor(0)))


@contextmanager
def writing_run(folder: Path, advice: str | None = None) -> Iterator[None]:
    """Turns a failure to write into a sentence; what was there before is whole."""
    try:
        yield
    except FlowlabError:
        raise
    except (OSError, safetensors.SafetensorError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise DataError(f"{folder}: cannot be written ({reason}); {advice or resume_advice(folder)}") from error


def resume_advice(folder: Path) -> str:
    """What to do where a run cannot be written."""
    return f"what was saved before is whole. Make room, then go on with 'flowlab train {folder} --resume'"


def has_begun(folder: Path) -> bool:
    """Whether a folder holds a run that can go on, or has come to its end; not what a kill left of a beginning."""
    kept = (folder / RESUME).exists() or any((folder / CHECKPOINTS).glob("step-*.safetensors"))
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
    if any((folder / CHECKPOINTS).glob("step-*")):
        raise UsageError(f"{folder}: holds checkpoints, but no {POLICY} that says of what; choose another --out")
    about = with_checksum(json.loads(trained.model_dump_json()))
    plan = with_checksum(json.loads(run.model_dump_json()), _FREE)
    with writing_run(folder, "nothing was begun. Make room, then give the same command again, or choose another --out"):
        folder.mkdir(parents=True, exist_ok=True)
        remove_leftovers(folder)
        (folder / POLICY).unlink(missing_ok=True)
        _write_resume(folder, 0, groups, _identity(about), _identity(plan))
        write_json(folder / RUN, plan)
        write_json(folder / POLICY, about)


def _write_resume(folder: Path, step: int, groups: Groups, policy: str, run: str) -> None:
    tensors = {f"{group}:{name}": value for group, values in groups.items() for name, value in values.items()}
    _write(folder / RESUME, tensors, {"step": step, "policy": policy, "run": run})


def _write(path: Path, tensors: Mapping[str, Tensor], about: Mapping[str, Any]) -> None:
    plain = {k: v.detach().cpu().contiguous() for k, v in tensors.items()}
    told = json.dumps(with_checksum({**about, "tensors": _digest(plain)}))
    with new_file(path) as temporary:
        save_file(plain, temporary, {_ABOUT: told})  # under one key: several would come in any order


def _digest(tensors: Mapping[str, Tensor]) -> str:
    """SHA-256 of tensors and their names."""
    digest = hashlib.sha256()
    for name in sorted(tensors):
        values = tensors[name]
        digest.update(f"{name} {values.dtype} {tuple(values.shape)}\n".encode())
        digest.update(values.reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()


def _identity(values: Mapping[str, Any]) -> str:
    """Identifies what ``policy.json`` or ``run.json`` says, wherever the dataset is, for the weights beside it."""
    return json_checksum(values, _FREE)


def _identity_in(path: Path) -> str:
    return _identity(read_json(path, _RESTORE))


def _read(path: Path, run: Path, advice: str) -> tuple[dict[str, Tensor], int]:
    """Tensors of a run, and the step they are of."""
    old = is_old(read_json(run / POLICY))
    with _understood(path, advice):
        with safetensors.safe_open(path, "pt") as file:
            about = _metadata(file, str(path), advice)
        tensors, step = load_file(path), int(about["step"])
    if "tensors" in about and _digest(tensors) != about["tensors"]:
        raise DataError(f"{path}: damaged (its content does not match its checksum); {advice}")
    for name, other in (("policy", run / POLICY), ("run", run / RUN)):
        if name in about and about[name] != _identity_in(other):
            raise DataError(f"{path}: was saved beside another {other.name} than {other}; restore both from one run")
    return {migrate_tensor(name) if old else name: value for name, value in tensors.items()}, step


def _metadata(file: Any, where: str, advice: str) -> dict[str, Any]:
    """What is said in a file of tensors; of one from an earlier version, its step. A :class:`KeyError` where flowlab
    did not say it: a name that changed on disk must not pass for one that is left out."""
    told: dict[str, str] = file.metadata() or {}
    if told.keys() == {_ABOUT}:
        return dict(without_checksum(parse_json(told[_ABOUT], where, advice), where, advice))
    return {"step": told["step"]}


@contextmanager
def _understood(path: Path, advice: str) -> Iterator[None]:
    """Turns a failure to read weights into a sentence."""
    if not path.exists():
        raise DataError(f"{path}: there is no such checkpoint")
    try:
        yield
    except DataError:
        raise
    except (KeyError, ValueError) as error:
        raise DataError(f"{path}: not written by flowlab, or damaged (it does not tell its step); {advice}") from error
    except (OSError, safetensors.SafetensorError) as error:
        raise DataError(f"{path}: damaged ({first_line(error)}); {advice}") from error


def _validated(model: type[Model], path: Path, free: tuple[str, ...] = ()) -> Model:
    values: Any = read_json(path, _RESTORE)
    found = values.get("format", 1) if isinstance(values, dict) and model is TrainedPolicy else FORMAT
    if found not in (1, FORMAT):
        raise DataError(f"{path}: format is {shown(found)}, this flowlab reads {FORMAT}; use the flowlab that wrote it")
    values = without_checksum(values, str(path), _RESTORE, free)
    values = migrate_policy(values) if model is TrainedPolicy else values
    try:
        with names_from_file():
            return model.model_validate(values)
    except ValidationError as error:
        raise DataError(f"{path}: {explain(error, model)}") from error
    except UsageError as error:
        told = "PYTHONPATH" in str(error)  # where such a module may lie
        advice = "" if told else "; install what has this policy, or put its module's folder on PYTHONPATH"
        raise DataError(f"{path}: {error}{advice}") from error
