"""What a run says of its policy (``policy.json``) and which checkpoints it has, read without PyTorch."""

import logging
import math
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy
import safetensors
from pydantic import ValidationError

from flowlab.checksums import json_checksum, without_checksum
from flowlab.config import Settings, explain, later
from flowlab.data.mixture import MixedDataset
from flowlab.data.replay_buffer import ReplayBuffer
from flowlab.data.source import TrainingSource
from flowlab.errors import DataError, FlowlabError, UsageError
from flowlab.policies.migrations import FORMAT, migrate_policy
from flowlab.policies.spec import PolicySpec
from flowlab.policies.tensor_headers import metadata_of, step_in, understood
from flowlab.registry import names_from_file
from flowlab.text import shown
from flowlab.untrusted import read_json
from flowlab.version import __version__

POLICY = "policy.json"
RUN = "run.json"
RESUME = "resume.safetensors"
CHECKPOINTS = "checkpoints"
CHECKPOINT_NAME = re.compile(r"step-\d{8}\.safetensors")
_LOG = logging.getLogger(__name__)
ADVICE = "delete it to use the checkpoint before it"
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
        import torch

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


def checkpoint_name(step: int) -> str:
    """What the weights after so many steps are called."""
    return f"step-{step:08d}.safetensors"


def weights_at(path: Path) -> Path:
    """The weights that a path means: the file itself, or the newest of a run, whose lost ones are told.

    Raises:
        DataError: It is neither, or the run has none.
    """
    if path.suffix == ".safetensors":
        return path
    warn_of_lost_checkpoints(path)
    return newest_checkpoint(path)


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
    with suppress(DataError), understood(path, ""), safetensors.safe_open(path, "np") as file:
        known = metadata_of(file, str(path), "").get("checkpoints")
    names = map(str, known if isinstance(known, list) else ())  # a damaged resume file is told by who resumes
    lost = set(filter(CHECKPOINT_NAME.fullmatch, names)) - {weights.name for weights in checkpoint_files(run)}
    if lost:
        _LOG.warning(
            "flowlab: %s: there were weights called %s, and are no longer", run / CHECKPOINTS, ", ".join(sorted(lost))
        )


def step_of(weights: Path) -> int:
    """Training steps that a checkpoint has seen. Raises :class:`DataError` where it is damaged."""
    with understood(weights, ADVICE), safetensors.safe_open(weights, "np") as file:
        return step_in(metadata_of(file, str(weights), ADVICE))


def count_weights(weights: Path) -> int:
    """How many numbers a checkpoint holds. Raises :class:`DataError` where it is damaged."""
    with understood(weights, ADVICE), safetensors.safe_open(weights, "np") as file:
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


def identity(values: Mapping[str, Any]) -> str:
    """Identifies what ``policy.json`` or ``run.json`` says, wherever the dataset is, for the weights beside it."""
    return json_checksum(values, FREE)


def identity_in(path: Path) -> str:
    """The same of a file. Raises :class:`DataError` where it cannot be read."""
    return identity(read_json(path, _RESTORE))


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
