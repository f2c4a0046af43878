"""A policy on disk: what it is (``policy.json``), and its weights (safetensors), as a training run keeps them."""

import json
import logging
import math
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy
import safetensors
import torch
from pydantic import ValidationError
from torch import Tensor

from flowlab.checksums import json_checksum, without_checksum
from flowlab.config import Settings, explain, later
from flowlab.data.mixture import MixedDataset
from flowlab.data.replay_buffer import ReplayBuffer
from flowlab.data.source import TrainingSource
from flowlab.errors import DataError, FlowlabError, UsageError
from flowlab.files import check_inside, remove_leftovers
from flowlab.policies.base import PolicyNetwork, PolicySpec, make_policy
from flowlab.policies.migrations import FORMAT, is_old, migrate_policy, migrate_tensor
from flowlab.policies.tensor_files import metadata_of, read_tensors, step_in, understood, write_tensors
from flowlab.registry import names_from_file
from flowlab.storage.manifest import differences
from flowlab.text import shown
from flowlab.untrusted import read_json
from flowlab.version import __version__

POLICY = "policy.json"
RUN = "run.json"
RESUME = "resume.safetensors"
CHECKPOINTS = "checkpoints"
_CHECKPOINT_NAME = re.compile(r"step-\d{8}\.safetensors")
_LOG = logging.getLogger(__name__)
_ADVICE = "delete it to use the checkpoint before it"
_RESTORE = "restore it from a copy, or train anew into another --out"
FREE = ("dataset", "more_datasets", "license", "hub")
"""What is said of a run, and changes nothing of it: where the datasets are, whose content is checked, which people may
change in ``run.json``; under which license the policy is, and where it was pulled from."""
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
    license: Annotated[str, later("")] = ""
    """Under which others may use it, as the Hugging Face Hub names licenses; empty where nobody has said."""
    hub: Annotated[str, later("")] = ""
    """Where on the Hub it was pulled from, with the commit: ``user/name@commit``; empty where it was not."""
    mixture: Annotated[tuple[MixedDataset, ...], later(())] = ()
    """The datasets in the order of ``dataset``, where each had a weight."""

    @classmethod
    def now(
        cls, policy: PolicySpec, source: TrainingSource, buffer: ReplayBuffer, mixture: tuple[MixedDataset, ...] = ()
    ) -> "TrainedPolicy":
        """A policy trained on a source by this flowlab."""
        about = source.provenance
        seeds = {t: tuple(e.seed for e in buffer.episodes if e.task == t) for t in buffer.tasks}
        return cls(
            policy=policy,
            dataset=", ".join(map(str, source.paths)),
            fingerprint=source.fingerprint,
            scene_seeds=seeds if about.is_simulated else {},
            scene=about.scene,
            versions={"flowlab": __version__, "torch": torch.__version__, "numpy": numpy.__version__},
            mixture=mixture,
        )


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
    weights = path
    if path.suffix != ".safetensors":
        warn_of_lost_checkpoints(path)
        weights = newest_checkpoint(path)
    folder = weights.absolute().parents[1]
    trained = read_trained(folder)
    tensors, step = read_run_tensors(weights, folder, _ADVICE)
    if _CHECKPOINT_NAME.fullmatch(weights.name) and weights.name != checkpoint_name(step):
        raise DataError(f"{weights}: holds the weights after {step} steps; restore it, or call it after them")
    policy = build_policy(trained.policy, tensors, f"{weights}: does not fit {folder / POLICY}")
    return LoadedPolicy(policy.requires_grad_(False).eval().to(device), trained, step, weights)


def checkpoint_name(step: int) -> str:
    """What the weights after so many steps are called."""
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
    return all_checkpoints(run)[-1]


def all_checkpoints(run: Path) -> list[Path]:
    """The weights of a run, those that have seen fewest steps first. Raises :class:`DataError` where there are none."""
    read_trained(run)
    checkpoints = checkpoint_files(run)
    if not checkpoints:
        raise DataError(f"{run}: has no checkpoint yet; resume it with 'flowlab train {run} --resume'")
    return checkpoints


def checkpoint_files(run: Path) -> list[Path]:
    """The weights that are there, those that have seen fewest steps first."""
    return sorted((run / CHECKPOINTS).glob("step-*.safetensors"))


def warn_of_lost_checkpoints(run: Path) -> None:
    """Say which checkpoints there were when the run was last saved, and are no longer: others would pass for them."""
    path = run / RESUME
    known: Any = None
    with suppress(DataError), understood(path, ""), safetensors.safe_open(path, "pt") as file:
        known = metadata_of(file, str(path), "").get("checkpoints")
    names = map(str, known if isinstance(known, list) else ())  # a damaged resume file is told by who resumes
    lost = set(filter(_CHECKPOINT_NAME.fullmatch, names)) - {weights.name for weights in checkpoint_files(run)}
    if lost:
        _LOG.warning(
            "flowlab: %s: there were weights called %s, and are no longer", run / CHECKPOINTS, ", ".join(sorted(lost))
        )


def step_of(weights: Path) -> int:
    """Training steps that a checkpoint has seen. Raises :class:`DataError` where it is damaged."""
    with understood(weights, _ADVICE), safetensors.safe_open(weights, "pt") as file:
        return step_in(metadata_of(file, str(weights), _ADVICE))


def count_weights(weights: Path) -> int:
    """How many numbers a checkpoint holds. Raises :class:`DataError` where it is damaged."""
    with understood(weights, _ADVICE), safetensors.safe_open(weights, "pt") as file:
        return sum(math.prod(file.get_slice(name).get_shape()) for name in file.keys())  # noqa: SIM118 - no mapping


def read_trained(folder: Path) -> TrainedPolicy:
    """``policy.json`` of a run."""
    path = folder / POLICY
    if not path.exists():
        raise DataError(
            f"{folder}: not a training run (it has no {POLICY}); what a kill left of one begins again with the command "
            "that began it"
        )
    return validated(TrainedPolicy, path)


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
    path = folder / CHECKPOINTS / checkpoint_name(step)
    with writing_run(folder):
        check_inside(folder, path.parent)
        path.parent.mkdir(exist_ok=True)
        remove_leftovers(path.parent)
        write_tensors(path, policy.state_dict(), {"step": step, "policy": identity_in(folder / POLICY)})
    return path


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


def identity(values: Mapping[str, Any]) -> str:
    """Identifies what ``policy.json`` or ``run.json`` says, wherever the dataset is, for the weights beside it."""
    return json_checksum(values, FREE)


def identity_in(path: Path) -> str:
    """The same of a file. Raises :class:`DataError` where it cannot be read."""
    return identity(read_json(path, _RESTORE))


def read_run_tensors(path: Path, run: Path, advice: str) -> tuple[dict[str, Tensor], int]:
    """Tensors of a run, and the step they are of."""
    old = is_old(read_json(run / POLICY))
    tensors, about = read_tensors(path, advice)
    for name, other in (("policy", run / POLICY), ("run", run / RUN)):
        if name in about and about[name] != identity_in(other):
            raise DataError(f"{path}: was saved beside another {other.name} than {other}; restore both from one run")
    return {migrate_tensor(name) if old else name: value for name, value in tensors.items()}, about["step"]


def validated(model: type[Model], path: Path, free: tuple[str, ...] = ()) -> Model:
    """What a JSON file of a run says; ``free`` are keys that people may change.

    Raises:
        DataError: It is damaged, of another version, or names a policy that is not installed here.
    """
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
