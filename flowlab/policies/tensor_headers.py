"""What files of tensors (safetensors) say of themselves, read without their tensors, and without PyTorch."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import safetensors

from flowlab.checksums import without_checksum
from flowlab.errors import DataError, MissingFileError, first_line
from flowlab.limits import MAX_WEIGHTS_BYTES
from flowlab.untrusted import check_regular, parse_json

ABOUT = "flowlab"
"""Key under which a file of tensors says what it is."""
_MOST_STEPS = 1 << 62


def metadata_of(file: Any, where: str, advice: str) -> dict[str, Any]:
    """What is said in a file of tensors; of one from an earlier version, its step. A :class:`KeyError` where flowlab
    did not say it: a name that changed on disk must not pass for one that is left out."""
    told: dict[str, str] = file.metadata() or {}
    if told.keys() == {ABOUT}:
        return dict(without_checksum(parse_json(told[ABOUT], where, advice), where, advice))
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
