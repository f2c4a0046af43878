"""Checksums of files: what was written is what is read, or the difference is told."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from flowlab.errors import DataError

_KEY = "sha256"


def sha256_of(path: Path) -> str:
    """The SHA-256 of a file. Raises :class:`OSError`."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def with_checksum(values: Mapping[str, Any]) -> dict[str, Any]:
    """JSON values, and the SHA-256 of them all as ``sha256``."""
    return {**values, _KEY: _checksum(values)}


def without_checksum(values: Any, path: Path, advice: str) -> Any:
    """The values of a JSON file without their checksum, which files of earlier versions lack.

    Raises:
        DataError: They are not what was written.
    """
    if not isinstance(values, dict) or _KEY not in values:
        return values
    rest = {key: value for key, value in values.items() if key != _KEY}
    if values[_KEY] != _checksum(rest):
        raise DataError(f"{path}: damaged (its content does not match its checksum); {advice}")
    return rest


def _checksum(values: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()
