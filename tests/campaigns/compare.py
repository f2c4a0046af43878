"""What is the same in the results of two runs of a command: all but measured times, memory and what shows them."""

import csv
import hashlib
import io
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from flowlab.checksums import CHECKSUM, json_checksum

_MEASURED = re.compile(r"^(cpu_s|training_cpu_s|wall_s|samples_per_s|ms_per_frame|peak_memory_mb)$")
"""Keys whose values are of one run: how long it took, and how much memory."""
_PICTURES_OF_TIMES = ("curve.png",)
_RERUN = b"RRF2"


def state(folder: Path, names: tuple[str, ...]) -> dict[str, str]:
    """Digests of all files of a result, by their paths."""
    found = {}
    for name in names:
        top = folder / name
        files = sorted(top.rglob("*")) if top.is_dir() else [top] if top.exists() else []
        for file in files:
            if not file.is_dir():
                found[file.relative_to(folder).as_posix()] = _digest(file)
    return found


def differences(one: dict[str, str], other: dict[str, str]) -> Iterator[str]:
    """Paths of files that are not the same, or not in both."""
    for path in sorted({*one, *other}):
        if one.get(path) != other.get(path):
            yield path


def leftovers(folder: Path) -> list[str]:
    """Temporary files that stayed."""
    return sorted(p.relative_to(folder).as_posix() for p in folder.rglob(".tmp-*"))


def _digest(file: Path) -> str:
    content = file.read_bytes()
    if file.name in _PICTURES_OF_TIMES:
        return f"a picture of {content[:4]!r}{content[-8:]!r}"  # begun and ended
    if file.suffix == ".rrd":  # holds the moment it was made
        return f"a recording of {content[:4]!r}{_RERUN in content[-64:]}"
    if file.suffix in (".json", ".jsonl"):
        content = _without_measures(content)
    if file.suffix == ".csv":
        rows = list(csv.DictReader(io.StringIO(content.decode())))
        content = json.dumps(still(rows)).encode()
    return hashlib.sha256(content).hexdigest()


def _without_measures(content: bytes) -> bytes:
    """JSON, or lines of it, without what was measured; content that is none stays what it is."""
    try:
        try:
            documents = [json.loads(content)]
        except ValueError:
            documents = [json.loads(line) for line in content.splitlines()]
    except ValueError:
        return content
    if all(still(d) == d for d in documents):
        return content
    return json.dumps([_checked(d) for d in documents]).encode()  # the order of keys counts


def _checked(document: Any) -> Any:
    """A document without measures, and whether the checksum over both is right in place of it."""
    values = still(document)
    if isinstance(document, dict) and CHECKSUM in document:
        values[CHECKSUM] = document[CHECKSUM] == json_checksum(document)
    return values


def still(value: Any) -> Any:
    """Nested values without what was measured."""
    if isinstance(value, dict):
        return {k: still(v) for k, v in value.items() if not _MEASURED.search(k)}
    return [still(v) for v in value] if isinstance(value, list) else value
