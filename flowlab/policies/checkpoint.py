"""The weights of a policy (safetensors), as a training run keeps them, and the policy that they make."""

import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from flowlab.data.source import TrainingSource
from flowlab.errors import DataError
from flowlab.files import check_inside, remove_leftovers
from flowlab.policies.base import PolicyNetwork, make_policy
from flowlab.policies.migrations import is_old, migrate_tensor
from flowlab.policies.spec import PolicySpec
from flowlab.policies.tensor_files import read_tensors, write_tensors
from flowlab.policies.trained import (
    ADVICE,
    CHECKPOINT_NAME,
    CHECKPOINTS,
    POLICY,
    RUN,
    TrainedPolicy,
    checkpoint_name,
    identity_in,
    read_trained,
    weights_at,
    writing_run,
)
from flowlab.storage.manifest import differences
from flowlab.untrusted import read_json


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
    weights = weights_at(path)
    folder = weights.absolute().parents[1]
    trained = read_trained(folder)
    tensors, step = read_run_tensors(weights, folder, ADVICE)
    if CHECKPOINT_NAME.fullmatch(weights.name) and weights.name != checkpoint_name(step):
        raise DataError(f"{weights}: holds the weights after {step} steps; restore it, or call it after them")
    policy = build_policy(trained.policy, tensors, f"{weights}: does not fit {folder / POLICY}")
    return LoadedPolicy(policy.requires_grad_(False).eval().to(device), trained, step, weights)


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


def read_run_tensors(path: Path, run: Path, advice: str) -> tuple[dict[str, Tensor], int]:
    """Tensors of a run, and the step they are of."""
    old = is_old(read_json(run / POLICY))
    tensors, about = read_tensors(path, advice)
    for name, other in (("policy", run / POLICY), ("run", run / RUN)):
        if name in about and about[name] != identity_in(other):
            raise DataError(f"{path}: was saved beside another {other.name} than {other}; restore both from one run")
    return {migrate_tensor(name) if old else name: value for name, value in tensors.items()}, about["step"]
