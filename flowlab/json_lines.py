"""Files with a line of JSON for each event, which several processes may add to; each line has a checksum."""

import fcntl
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO

from flowlab.checksums import with_checksum, without_checksum
from flowlab.errors import DataError
from flowlab.files import told_when_unwritable
from flowlab.text import shown
from flowlab.untrusted import parse_json, read_bytes


def line_of(values: Mapping[str, Any]) -> bytes:
    """Values as a line with its checksum."""
    return json.dumps(with_checksum(values)).encode() + b"\n"


def append_line(path: Path, values: Mapping[str, Any], advice: str) -> None:
    """Add a line to a file, whole or not at all; what a kill left of another's is taken off.

    Raises:
        DataError: It cannot be written; the message ends with ``advice``.
    """
    line = line_of(values)
    with told_when_unwritable(path, advice), path.open("a+b", buffering=0) as file:
        with suppress(OSError):  # where the file system has no locks
            fcntl.flock(file, fcntl.LOCK_EX)
        end = _end_of_lines(file)
        try:
            if file.seek(0, os.SEEK_END) != end:
                file.truncate(end)
            if file.write(line) != len(line):
                raise OSError(None, "No space left on device")
            os.fsync(file.fileno())
        except OSError:
            with suppress(OSError):
                file.truncate(end)
            raise


def read_lines(path: Path, expected: str, advice: str) -> Iterator[tuple[int, Any]]:
    """The values of every line with its number, from 1; none where there is no file.

    A last line that a kill cut off is left out.

    Args:
        path: The file.
        expected: What a line holds, in words.
        advice: What to do about a damaged one.

    Raises:
        DataError: A line is damaged.
    """
    *whole, _ = (read_bytes(path) if path.exists() else b"").split(b"\n")
    for number, line in enumerate(whole, 1):
        where = (
            f"{path}: line {number} is damaged (expected {expected}, found {shown(line[:60].decode(errors='replace'))})"
        )
        try:
            yield number, without_checksum(parse_json(line, where), where, advice)
        except DataError as error:
            raise DataError(f"{where}; {advice}") from error


def _end_of_lines(file: BinaryIO | Any) -> int:
    """The length of a file up to its last whole line."""
    size: int = file.seek(0, os.SEEK_END)
    if size:
        file.seek(-1, os.SEEK_END)
        if file.read(1) != b"\n":
            file.seek(0)
            return int(file.read().rfind(b"\n")) + 1
    return size
