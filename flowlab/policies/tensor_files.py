"""Files of tensors (safetensors) that say what they are, and whose content is checked as it is read."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import safetensors
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor

from flowlab.checksums import with_checksum
from flowlab.errors import DataError
from flowlab.files import new_file_alone
from flowlab.policies.tensor_headers import ABOUT, metadata_of, step_in, understood


def write_tensors(path: Path, tensors: Mapping[str, Tensor], about: Mapping[str, Any]) -> None:
    """Write tensors, and what they are, without a copy of them in memory: those of a large run fill it.

    Raises:
        OSError: They cannot be written.
        SafetensorError: Likewise.
    """
    plain = {k: v.detach().cpu().contiguous() for k, v in tensors.items()}
    told = json.dumps(with_checksum({**about, "tensors": _digest(plain)}))
    with new_file_alone(path) as temporary:  # it has a temporary name of its own, which a kill would leave beside it
        save_file(plain, temporary, {ABOUT: told})  # under one key: several would come in any order


def _digest(tensors: Mapping[str, Tensor]) -> str:
    """SHA-256 of tensors and their names."""
    digest = hashlib.sha256()
    for name in sorted(tensors):
        values = tensors[name]
        digest.update(f"{name} {values.dtype} {tuple(values.shape)}\n".encode())
        digest.update(values.reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()


def read_tensors(path: Path, advice: str) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """The tensors of a file, and what it says of itself. Raises :class:`DataError` where it is damaged."""
    with understood(path, advice):
        with safetensors.safe_open(path, "pt") as file:
            about = metadata_of(file, str(path), advice)
        tensors = load_file(path)
        about["step"] = step_in(about)
    if "tensors" in about and _digest(tensors) != about["tensors"]:
        raise DataError(f"{path}: damaged (its content does not match its checksum); {advice}")
    return tensors, about


def check_finite(path: Path, tensors: Mapping[str, Tensor]) -> None:
    """Refuse tensors of a file that are no numbers. Raises :class:`DataError`."""
    for name, values in tensors.items():
        if values.is_floating_point() and not values.isfinite().all():
            raise DataError(f"{path}: '{name}' has values that are not finite; delete it, or restore it")
