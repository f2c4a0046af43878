"""The two kinds of JSON record in a dataset: one manifest, and one receipt per work unit."""

import hashlib
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError, model_validator

from flowlab.config import Settings
from flowlab.errors import DataError
from flowlab.files import read_json
from flowlab.provenance import Provenance
from flowlab.storage.migrations import migrate_manifest, migrate_receipt
from flowlab.storage.recorded import Recorded
from flowlab.storage.schema import SCHEMA_VERSION
from flowlab.version import __version__

MANIFEST = "flowlab.json"
UNITS = {
    "length": "m",
    "time": "s",
    "camera": "OpenCV axes (x right, y down, z forward); pixel centers at integer coordinates",
    "rotation": "6D: first two columns of the rotation matrix",
}


class Manifest(Settings):
    """``flowlab.json``: how a dataset was made, and in what frames and units it speaks."""

    schema_version: int = SCHEMA_VERSION
    flowlab: str = __version__
    recipe: str
    """Name of the recipe."""
    settings: Mapping[str, Any]
    """Every setting of every stage, by stage name."""
    units: Mapping[str, str] = UNITS
    first_seed: int
    requested: Mapping[str, int]
    """Episodes asked for, by task."""
    provenance: Provenance
    """Where the episodes come from, and what their numbers mean."""
    recordings: tuple[Recorded, ...] = ()
    """What the episodes are made from, where that is no simulation."""
    first_settings_digest: str = ""
    """Of a dataset that an earlier flowlab began: what its shards call the settings; empty in others."""

    @property
    def settings_digest(self) -> str:
        """Identifies the settings of the stages, in their order, whatever the stages are called; every shard has it."""
        if self.first_settings_digest:
            return self.first_settings_digest
        stages = list(json.loads(self.model_dump_json())["settings"].values())
        return hashlib.sha256(json.dumps(stages, sort_keys=True).encode()).hexdigest()[:16]

    @classmethod
    def read(cls, folder: Path) -> "Manifest":
        """The manifest of a dataset folder."""
        path = folder / MANIFEST
        if not path.exists():
            raise DataError(f"{folder}: not a flowlab dataset (it has no {MANIFEST})")
        values = read_json(path)
        found = values.get("schema_version") if isinstance(values, dict) else None
        if found != SCHEMA_VERSION:
            raise DataError(
                f"{path}: schema_version is {found}, this flowlab reads {SCHEMA_VERSION}; "
                "use the flowlab version that wrote it"
            )
        try:
            return cls.model_validate(migrate_manifest(values))
        except ValidationError as error:
            first = error.errors()[0]
            field = ".".join(map(str, first["loc"]))
            raise DataError(f"{path}: field '{field}': {first['msg']}") from error


class Reject(Settings):
    """A seed, or a recording, that gave no episode, or none that is good enough."""

    task: str
    seed: int
    stage: str
    reason: str
    source: str = ""
    """Path of the recording."""
    position: int | None = None
    """Index of the episode within the shard of its unit's rejects; None where there is nothing to look at."""
    retry: bool = False
    """Whether the next run tries again, since the cause lies outside the dataset: a recording could not be opened."""


class StageTally(Settings):
    """What one stage did in a unit."""

    calls: int = 0
    cpu_s: float = 0.0
    rejects: int = 0

    def since(self, before: "StageTally") -> "StageTally":
        """What was added after ``before``."""
        return StageTally(
            calls=self.calls - before.calls, cpu_s=self.cpu_s - before.cpu_s, rejects=self.rejects - before.rejects
        )

    def plus(self, other: "StageTally") -> "StageTally":
        """Both together."""
        return StageTally(
            calls=self.calls + other.calls, cpu_s=self.cpu_s + other.cpu_s, rejects=self.rejects + other.rejects
        )


class Receipt(Settings):
    """What became of one work unit; a shard without a receipt does not count."""

    unit: str
    task: str
    seeds: tuple[int, ...]
    """All seeds tried."""
    accepted: tuple[int, ...]
    """Those whose episodes the shard holds, in its order."""
    frames: tuple[int, ...]
    """Length of each of these episodes."""
    rejects: tuple[Reject, ...] = ()
    digests: tuple[str, ...]
    """SHA-256 of each of these episodes."""
    stages: Mapping[str, StageTally] = {}
    stats: Mapping[str, Any] = {}
    """Mergeable statistics, see :mod:`flowlab.storage.stats`."""
    peak_memory_mb: float = 0.0
    flowlab: str = __version__

    @model_validator(mode="after")
    def _lists_match(self) -> "Receipt":
        if not len(self.accepted) == len(self.frames) == len(self.digests):
            raise ValueError("accepted, frames and digests must be equally long")
        return self

    @property
    def shard(self) -> str:
        """Path of the shard below the dataset."""
        return f"shards/{self.unit}.zarr"

    @property
    def rejects_shard(self) -> str:
        """Path below the dataset of the shard that keeps rejected episodes, where there are any to keep."""
        return f"rejects/{self.unit}.zarr"


def read_receipts(folder: Path) -> list[Receipt]:
    """All receipts of a dataset, by task and seed."""
    receipts = []
    for path in (folder / "receipts").glob("*.json"):
        if path.name.startswith("."):
            continue
        try:
            receipts.append(Receipt.model_validate(migrate_receipt(read_json(path))))
        except ValidationError as error:
            first = error.errors()[0]
            field = ".".join(map(str, first["loc"])) or "lists"
            raise DataError(f"{path}: field '{field}': {first['msg']}") from error
    return sorted(receipts, key=lambda r: (r.task, r.seeds))


def differences(old: Any, new: Any, where: str = "") -> Iterator[str]:
    """One line for every setting in which two groups of settings differ."""
    if isinstance(old, Mapping) and isinstance(new, Mapping):
        for key in sorted({*old, *new}):
            yield from differences(old.get(key), new.get(key), f"{where}.{key}".strip("."))
    elif old != new:
        yield f"{where}: the dataset has {json.dumps(old)}, this run has {json.dumps(new)}"
