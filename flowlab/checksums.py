"""Checksums of files: what was written is what is read, or the difference is told."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from flowlab.errors import DataError

CHECKSUM = "sha256"
"""Key under which JSON values tell their checksum."""


def sha256_of(path: Path) -> str:
    """The SHA-256 of a file. Raises :class:`OSError`."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def has_sha256(path: Path, checksum: str) -> bool:
    """Whether a file's content is what it was; that of one that cannot be read (a broken disk, a link) is not."""
    try:
        return sha256_of(path) == checksum
    except OSError:
        return False


def with_checksum(values: Mapping[str, Any], free: Sequence[str] = ()) -> dict[str, Any]:
    """JSON values, and the SHA-256 of them all as ``sha256``, but for the keys ``free``, which people may change."""
    return {**values, CHECKSUM: json_checksum(values, free)}


def without_checksum(values: Any, where: Path | str, advice: str, free: Sequence[str] = ()) -> Any:
    """The values of a JSON file without their checksum, which files of earlier versions lack.

    Raises:
        DataError: They are not what was written.
    """
    if not isinstance(values, dict) or CHECKSUM not in values:
        return values
    if values[CHECKSUM] != json_checksum(values, free):
        raise DataError(f"{where}: damaged (its content does not match its checksum); {advice}")
    return {key: value for key, value in values.items() if key != CHECKSUM}


def json_checksum(values: Mapping[str, Any], free: Sequence[str] = ()) -> str:
    """The SHA-256 of JSON values, but for the keys ``free`` and a checksum of theirs."""
    counted = {key: value for key, value in values.items() if key not in (*free, CHECKSUM)}
    return hashlib.sha256(json.dumps(counted, sort_keys=True).encode()).hexdigest()
