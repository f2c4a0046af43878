"""Receipts: one JSON record per work unit, that says what became of it and makes its shard count."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError, model_validator

from flowlab.config import Settings
from flowlab.errors import DataError
from flowlab.files import read_json, write_json
from flowlab.storage.migrations import migrate_receipt
from flowlab.version import __version__


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
    def _plain_names(self) -> "Receipt":
        for name in (self.unit, self.task):
            if not name or name.startswith(".") or "/" in name or "\0" in name:
                raise ValueError(f"'{name}' is no plain name; unit and task name files of this dataset")
        return self

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
            receipt = Receipt.model_validate(migrate_receipt(read_json(path)))
        except ValidationError as error:
            first = error.errors()[0]
            field = ".".join(map(str, first["loc"])) or "lists"
            raise DataError(f"{path}: field '{field}': {first['msg']}") from error
        if receipt.unit != path.stem:
            raise DataError(f"{path}: field 'unit': is '{receipt.unit}', expected '{path.stem}' as the file is called")
        receipts.append(receipt)
    return sorted(receipts, key=lambda r: (r.task, r.seeds))


def keep_receipt(folder: Path, receipt: Receipt) -> None:
    """Write a unit's receipt: from now on its shard counts."""
    write_json(folder / "receipts" / f"{receipt.unit}.json", json.loads(receipt.model_dump_json()))
