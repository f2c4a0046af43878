"""What is the same in the results of two runs of a command: everything but times, memory and names of machines."""

import hashlib
import json
import re
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

_OF_THE_MOMENT = re.compile(
    r"^sha256$|(^|_)(s|ms|ms_per_frame|cpu|wall|time|seconds|memory_mb|peak|created|made|date|digest|digests|samples_per_s)$"
)
"""Keys whose values are of one run: how long it took, when it was, and digests over files that hold such."""
_UNCOMPARED = re.compile(r"\.(rrd|log|lock)$|(^|/)training\.png$|(^|/)curve\.png$|(^|/)report\.(html|json|csv)$")
"""Files that hold times, or that are drawn of them."""


def state(folder: Path, names: tuple[str, ...]) -> dict[str, str]:
    """Digests of all files of a result, by their paths."""
    found = {}
    for name in names:
        top = folder / name
        files = sorted(top.rglob("*")) if top.is_dir() else [top] if top.exists() else []
        for file in files:
            if not file.is_dir():
                path = file.relative_to(folder).as_posix()
                found[path] = "" if _UNCOMPARED.search(path) else _digest(file)
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
    if file.suffix in (".json", ".jsonl"):
        content = _without_moments(content)
    elif file.suffix == ".safetensors":
        content = _tensors(content)
    elif file.suffix == ".zip":
        content = _members(file)
    return hashlib.sha256(content).hexdigest()


def _without_moments(content: bytes) -> bytes:
    try:
        values = [json.loads(line) for line in content.splitlines() if line.strip()] if content[:1] == b"{" and (
            content.count(b"\n") > 0 and content.splitlines()[0].rstrip().endswith(b"}")
        ) else [json.loads(content)]  # fmt: skip
    except ValueError:
        return content
    return json.dumps([_still(v) for v in values], sort_keys=True).encode()


def _still(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _still(v) for k, v in value.items() if not _OF_THE_MOMENT.search(k)}
    return [_still(v) for v in value] if isinstance(value, list) else value


def _tensors(content: bytes) -> bytes:
    """The weights, without what the header says of the run."""
    length = int.from_bytes(content[:8], "little")
    try:
        header = json.loads(content[8 : 8 + length])
    except ValueError:
        return content
    header.pop("__metadata__", None)
    return json.dumps(header, sort_keys=True).encode() + content[8 + length :]


def _members(file: Path) -> bytes:
    try:
        with zipfile.ZipFile(file) as archive:
            each = [(n, hashlib.sha256(archive.read(n)).hexdigest()) for n in sorted(archive.namelist())]
    except (zipfile.BadZipFile, OSError, ValueError) as error:
        return repr(error).encode() + file.read_bytes()
    return json.dumps(each).encode()
