"""Files of tensors (safetensors) that say what they are, and whose content is checked as it is read."""

import hashlib
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import safetensors
import torch
from safetensors.torch import load_file, save
from torch import Tensor

from flowlab.checksums import with_checksum, without_checksum
from flowlab.errors import DataError, MissingFileError, first_line
from flowlab.files import new_file
from flowlab.limits import MAX_WEIGHTS_BYTES
from flowlab.untrusted import check_regular, parse_json

_ABOUT = "flowlab"
"""Key under which a file of tensors says what it is."""
_MOST_STEPS = 1 << 62


def write_tensors(path: Path, tensors: Mapping[str, Tensor], about: Mapping[str, Any]) -> None:
    """Write tensors, and what they are. Raises :class:`OSError` where they cannot be written."""
    plain = {k: v.detach().cpu().contiguous() for k, v in tensors.items()}
    told = json.dumps(with_checksum({**about, "tensors": _digest(plain)}))
    with new_file(path) as temporary:
        about_all = {_ABOUT: told}  # under one key: several would come in any order
        temporary.write_bytes(save(plain, about_all))  # save_file has a temporary name of its own, which a kill leaves


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


def metadata_of(file: Any, where: str, advice: str) -> dict[str, Any]:
    """What is said in a file of tensors; of one from an earlier version, its step. A :class:`KeyError` where flowlab
    did not say it: a name that changed on disk must not pass for one that is left out."""
    told: dict[str, str] = file.metadata() or {}
    if told.keys() == {_ABOUT}:
        return dict(without_checksum(parse_json(told[_ABOUT], where, advice), where, advice))
    return {"step": told["step"]}


def step_in(about: Mapping[str, Any]) -> int:
    """The step that a file of tensors is of; where it tells none, what :func:`understood` turns into a sentence."""
    told = about["step"]
    step = int(told) if isinstance(told, str) or type(told) is int else -1  # a word in files of earlier versions
    if not 0 <= step < _MOST_STEPS:
        raise ValueError("no step")
    return step


@contextmanager
def understood(path: Path, advice: str) -> Iterator[None]:
    """Turns a failure to read weights into a sentence."""
    try:
        check_regular(path, MAX_WEIGHTS_BYTES)  # a pipe would be waited at for ever
        yield
    except MissingFileError as error:
        raise DataError(f"{path}: there is no such checkpoint") from error
    except DataError:
        raise
    except (KeyError, ValueError) as error:
        raise DataError(f"{path}: not written by flowlab, or damaged (it does not tell its step); {advice}") from error
    except (OSError, safetensors.SafetensorError) as error:
        raise DataError(f"{path}: damaged ({first_line(error)}); {advice}") from error
