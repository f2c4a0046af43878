"""Receipts: one JSON record per work unit, that says what became of it and makes its shard count."""

import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import reduce
from itertools import islice
from pathlib import Path

from pydantic import Field, ValidationError, model_validator

from flowlab.checksums import with_checksum, without_checksum
from flowlab.config import PlainName, Settings, explain
from flowlab.errors import DataError
from flowlab.files import write_json
from flowlab.records import Episode
from flowlab.storage.migrations import migrate_receipt
from flowlab.storage.shard_files import SUFFIX
from flowlab.storage.stats import MergeableStats, stats_problem
from flowlab.text import cut, shown
from flowlab.untrusted import read_json
from flowlab.version import __version__

_LOOKED_AT = 20
"""Receipts of recordings that are read to learn what the numbers of a dataset are called."""
ANEW = "the same extract or track command makes this unit anew"


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


@dataclass(frozen=True, slots=True)
class RowFormat:
    """What a state and an action are made of, the same in all episodes of a dataset."""

    state: int
    """How many numbers it has."""
    action: int
    state_names: tuple[str, ...] = ()
    """What the numbers are called; empty where that is not known."""
    action_names: tuple[str, ...] = ()

    @classmethod
    def of(cls, episode: Episode) -> "RowFormat":
        """The format of an episode."""
        state_names, action_names = (tuple(episode.extras.get(name, ())) for name in ("state_names", "action_names"))
        return cls(episode.state.shape[1], episode.action.shape[1], state_names, action_names)

    def or_names_of(self, other: "RowFormat | None") -> "RowFormat":
        """The same, with the names of another where it has none of its own."""
        if other is None:
            return self
        named = {f"{n}_names": getattr(other, f"{n}_names") or getattr(self, f"{n}_names") for n in ("state", "action")}
        return replace(self, **named)

    def problem(self, other: "RowFormat") -> str:
        """In what others differ from the dataset's, in words; empty where they do not."""
        for name in ("state", "action"):
            mine, found = getattr(self, name), getattr(other, name)
            if mine != found:
                return f"its {name} has {found} numbers a step, that of the dataset's other episodes {mine}"
            mine, found = getattr(self, f"{name}_names"), getattr(other, f"{name}_names")
            if mine and found and mine != found:
                theirs, ours = (cut(", ".join(map(repr, names))) for names in (found, mine))
                return f"its {name} is {theirs}, that of the dataset's other episodes {ours}"
        return ""


class Receipt(Settings):
    """What became of one work unit; a shard without a receipt does not count."""

    unit: PlainName
    task: PlainName
    seeds: tuple[int, ...]
    """All seeds tried."""
    accepted: tuple[int, ...]
    """Those whose episodes the shard holds, in its order."""
    frames: tuple[int, ...]
    """Length of each of these episodes."""
    rejects: tuple[Reject, ...] = ()
    digests: tuple[str, ...]
    """SHA-256 of each of these episodes."""
    contents: tuple[str, ...] = ()
    """Identity of the recording of each seed, by its content; empty for simulation, and of an earlier flowlab."""
    shard_sha256: str = ""
    """Of the shard's file; empty where there is none, or where it is a folder, as before schema version 2."""
    rejects_sha256: str = ""
    """Of the file that keeps rejected episodes; empty as above."""
    stages: Mapping[str, StageTally] = {}
    stats: MergeableStats = Field(default_factory=MergeableStats)
    """Mergeable statistics of the episodes."""
    state_names: tuple[str, ...] = ()
    """What the numbers of the state are called; empty where that is not known, or not of all."""
    action_names: tuple[str, ...] = ()
    peak_memory_mb: float = 0.0
    flowlab: str = __version__

    @model_validator(mode="after")
    def _lists_match(self) -> "Receipt":
        if not len(self.accepted) == len(self.frames) == len(self.digests):
            raise ValueError("accepted, frames and digests must be equally long")
        if self.accepted and (problem := stats_problem(self.stats)):
            raise ValueError(f"stats: {problem}")
        return self

    @property
    def shard(self) -> str:
        """Path of the shard below the dataset."""
        return shard_path("shards", self.unit, zipped=bool(self.shard_sha256))

    @property
    def row_format(self) -> RowFormat | None:
        """What a state and an action of its episodes are made of; None where that is not known."""
        if not self.accepted or "arrays" not in self.stats:
            return None
        moments = self.stats["arrays"]
        state, action = (len(moments[name]["mean"]) if name in moments else 0 for name in ("state", "action"))
        return RowFormat(state, action, self.state_names, self.action_names)

    @property
    def rejects_shard(self) -> str:
        """Path below the dataset of the shard that keeps rejected episodes, where there are any to keep."""
        return shard_path("rejects", self.unit, zipped=bool(self.rejects_sha256))

    @property
    def keeps_rejects(self) -> bool:
        """Whether there is such a shard."""
        return any(x.position is not None for x in self.rejects)

    @property
    def shards(self) -> tuple[str, ...]:
        """Paths below the dataset of all shards that there are."""
        return (self.shard,) * bool(self.accepted) + (self.rejects_shard,) * self.keeps_rejects


def shard_path(place: str, unit: str, *, zipped: bool = True) -> str:
    """Path below a dataset of a unit's shard, in ``shards`` or ``rejects``."""
    return f"{place}/{unit}{SUFFIX if zipped else '.zarr'}"


def read_receipts(folder: Path) -> list[Receipt]:
    """All receipts of a dataset, by task and seed."""
    return sorted(_receipts(folder), key=lambda r: (r.task, r.seeds))


def known_row_format(folder: Path) -> RowFormat | None:
    """What the episodes of a dataset have as state and action; None as long as there is no episode.

    Every unit asks, so that only the first of many are read: the names that any of these has. All are compared where
    a dataset is validated and trained on (:func:`check_row_formats`).
    """
    known: RowFormat | None = None
    found = ((receipt, own) for receipt in _receipts(folder) if (own := receipt.row_format))
    for receipt, own in islice(found, _LOOKED_AT):
        known = own.or_names_of(known)
        if known.state_names or known.action_names or not receipt.contents:  # in simulation, numbers have no names
            break
    return known


def common_format(formats: Iterable[RowFormat]) -> RowFormat | None:
    """What fits all of some, with the names that any of them has; None where there are none."""
    return reduce(lambda known, more: more.or_names_of(known), formats, None)


def check_row_formats(folder: Path, receipts: Iterable[Receipt]) -> None:
    """Raises :class:`DataError` where states or actions of some episodes are others than those of the rest."""
    known, first = None, ""
    for receipt in receipts:
        if (found := receipt.row_format) is None:
            continue
        first = first or receipt.unit
        if problem := known.problem(found) if known else "":
            raise DataError(
                f"{folder}: an episode does not fit, {problem} ({receipt.unit} and {first}); a dataset has one kind of "
                f"each: make those of another in another --out, and remove {folder}/receipts/{receipt.unit}.json"
            )
        known = found.or_names_of(known)


def _receipts(folder: Path) -> Iterator[Receipt]:
    """All receipts of a dataset, as they are found."""
    yield from map(read_receipt, receipt_files(folder))


def receipt_files(folder: Path) -> list[Path]:
    """The files of all receipts."""
    return sorted(p for p in (folder / "receipts").glob("*.json") if not p.name.startswith("."))


def read_receipt(path: Path) -> Receipt:
    """A receipt. Raises :class:`DataError` where it is damaged."""
    values = without_checksum(read_json(path, ANEW), path, ANEW)
    try:
        receipt = Receipt.model_validate(migrate_receipt(values))
    except ValidationError as error:
        raise DataError(f"{path}: {explain(error, Receipt)}; {ANEW}") from error
    if receipt.unit != path.stem:
        raise DataError(
            f"{path}: unit: is {shown(receipt.unit)}, expected {shown(path.stem)} as the file is called; {ANEW}"
        )
    return receipt


def keep_receipt(folder: Path, receipt: Receipt) -> None:
    """Write a unit's receipt: from now on its shard counts."""
    values = with_checksum(json.loads(receipt.model_dump_json()))
    write_json(folder / "receipts" / f"{receipt.unit}.json", values)
