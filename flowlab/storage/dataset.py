"""A dataset: a folder with a manifest, receipts and shards, open to reading at any moment of its making."""

import hashlib
import json
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from flowlab.checksums import has_sha256
from flowlab.errors import DataError, MissingFileError
from flowlab.files import locked, remove_leftovers, write_atomically
from flowlab.provenance import Provenance
from flowlab.records import Episode
from flowlab.storage import stats
from flowlab.storage.card import CARD, dataset_card
from flowlab.storage.episodes import EpisodeRef, EpisodeSequence, checked, unit_refs, unit_shard
from flowlab.storage.manifest import MANIFEST, Manifest, differences
from flowlab.storage.receipts import RowFormat, check_row_formats, read_receipts
from flowlab.storage.recorded import number_recordings
from flowlab.storage.schema import SCHEMA_VERSION
from flowlab.storage.shard import REPAIR, Shard
from flowlab.text import cut
from flowlab.untrusted import is_there


@dataclass(frozen=True, slots=True)
class RejectRef:
    """What was kept out of a dataset, and where its episode lies if there is one to look at."""

    task: str
    seed: int
    stage: str
    reason: str
    source: str
    """Path of the recording; empty for simulation."""
    shard: str | None
    """Path below the dataset; None where no episode could be made."""
    position: int | None
    """Index within the shard."""


def open_dataset(path: Path | str) -> "Dataset":
    """Open a dataset for reading.

    Args:
        path: Its folder; it may still be in the making.

    Returns:
        The episodes as a sequence: ``len(d)``, ``d[0]``, ``d[-3:]``, ``for episode in d``, ``d.task("push")``.

    Raises:
        MissingFileError: There is no such folder; a :class:`FileNotFoundError`, too.
        DataError: The folder holds no dataset, or one that is damaged.
    """
    return Dataset(path)


class Dataset(EpisodeSequence):
    """A dataset opened for reading: episodes in order of task and seed, and all that is known of them."""

    def __init__(self, path: Path | str) -> None:
        self._path = Path(path)
        if not is_there(self.path):
            raise MissingFileError(f"{self.path}: there is no such folder")
        self.manifest = Manifest.read(self.path)
        self.receipts = read_receipts(self.path)

    @property
    def path(self) -> Path:
        """Its folder."""
        return self._path

    @cached_property
    def refs(self) -> list[EpisodeRef]:
        """All episodes that count: those with a receipt."""
        return sorted((ref for r in self.receipts for ref in unit_refs(r)), key=lambda ref: (ref.task, ref.seed))

    @property
    def row_format(self) -> RowFormat | None:
        """What a state and an action are made of; None where that is not known, as of a dataset without episodes."""
        return next((r.row_format for r in self.receipts if r.row_format is not None), None)

    @cached_property
    def provenance(self) -> Provenance:
        """Where the episodes come from, and what their numbers mean. That recordings came without state or without
        actions is known only when they have been opened."""
        known, said = self.row_format, self.manifest.provenance
        none: dict[str, Any] = {name: () for name in ("state", "action") if known and not getattr(known, name)}
        return said.model_copy(update={name: x for name, x in none.items() if getattr(said, name) is None})

    def episode(self, index: int) -> Episode:
        """The episode at a position of :attr:`refs`.

        Args:
            index: Its position, from 0.

        Returns:
            The episode, all of its arrays read.

        Raises:
            DataError: There is no such episode, or its shard is damaged.
        """
        if not 0 <= index < len(self):
            raise DataError(f"{self.path}: no episode {index}; there are {len(self)}, counted from 0")
        return self[index]

    def episodes(self) -> Iterator[Episode]:
        """All episodes, shard by shard: the quickest order.

        Yields:
            Every episode that counts, all of its arrays read.
        """
        for receipt in self.receipts:
            if receipt.accepted:
                refs = unit_refs(receipt)
                for ref, episode in zip(refs, unit_shard(self.path, receipt).episodes(), strict=True):
                    yield checked(self.path, ref, episode)

    @cached_property
    def rejects(self) -> list[RejectRef]:
        """What was tried and kept out, in order of task and seed."""
        return sorted(
            (
                RejectRef(
                    x.task, x.seed, x.stage, x.reason, x.source,
                    None if x.position is None else r.rejects_shard, x.position,
                )
                for r in self.receipts
                for x in r.rejects
            ),
            key=lambda ref: (ref.task, ref.seed),
        )  # fmt: skip

    def rejected(self, index: int) -> Episode:
        """The episode at a position of :attr:`rejects`, where there is one to look at.

        Args:
            index: Its position, from 0.

        Returns:
            The episode as it was when it was rejected.

        Raises:
            DataError: There is no such reject, it was rejected before there was an episode, or its shard is damaged.
        """
        if not 0 <= index < len(self.rejects):
            raise DataError(f"{self.path}: no reject {index}; there are {len(self.rejects)}, counted from 0")
        ref = self.rejects[index]
        if ref.shard is None or ref.position is None:
            raise DataError(
                f"{self.path}: {ref.task} seed {ref.seed} was rejected at {ref.stage} ({ref.reason}), "
                "before there was an episode to look at"
            )
        checksum = next(r.rejects_sha256 for r in self.receipts if r.rejects_shard == ref.shard)
        if checksum and is_there(self.path / ref.shard) and not has_sha256(self.path / ref.shard, checksum):
            raise DataError(
                f"{self.path / ref.shard}: damaged (its content does not match the checksum in its receipt); {REPAIR}"
            )
        return Shard(self.path / ref.shard).episode(ref.position)

    @cached_property
    def stats(self) -> dict[str, Any]:
        """Limits, mean and deviation of every array, and how much moves.

        Raises:
            DataError: States or actions of some episodes are others than those of the rest.
        """
        check_row_formats(self.path, self.receipts)
        return stats.describe(stats.merge(r.stats for r in self.receipts if r.accepted))

    @property
    def arrays(self) -> frozenset[str]:
        """Paths of the arrays with anything in them, of all tasks: of the first shard of each that can be read."""
        first = {r.task: r for r in reversed(self.receipts) if r.accepted}
        found: set[str] = set()
        for receipt in first.values():
            with suppress(DataError):
                found |= {a.path for a in unit_shard(self.path, receipt).describe() if 0 not in a.shape}
        return frozenset(found)

    @property
    def fingerprint(self) -> str:
        """Identifies settings and content, however they are spread over shards; a checkpoint names the data it
        was trained on by it."""
        episodes = [(r.task, *x) for r in self.receipts for x in zip(r.accepted, r.digests, strict=True)]
        content = [self.manifest.settings_digest, *(f"{t} {seed} {digest}" for t, seed, digest in sorted(episodes))]
        return hashlib.sha256("\n".join(content).encode()).hexdigest()[:16]

    @property
    def missing(self) -> dict[str, int]:
        """Episodes still to be made, by task; empty when the dataset is complete.

        Of recordings, those not yet looked at: what was rejected is done with.
        """
        if self.provenance.inferred is not None:  # films that were kept out are done with, too
            tried = Counter(r.task for r in self.receipts for _ in r.seeds)
            return {t: n - tried[t] for t, n in self.manifest.requested.items() if tried[t] < n}
        if self.manifest.recordings:
            done = {(r.task, seed) for r in self.receipts for seed in r.seeds}
            return dict(Counter(r.task for r in self.manifest.recordings if (r.task, r.seed) not in done))
        have: dict[str, int] = {}
        for r in self.receipts:
            have[r.task] = have.get(r.task, 0) + len(r.accepted)
        return {t: n - have.get(t, 0) for t, n in self.manifest.requested.items() if have.get(t, 0) < n}

    @property
    def reservation(self) -> str:
        """That it is not complete, for those who use what there is of it; empty where it is."""
        missing = ", ".join(f"{n} of {task}" for task, n in self.missing.items())
        what = "recordings" if self.manifest.recordings else "episodes"
        return f"{self.path}: {what} are still to be made: {cut(missing)}; what there is, is used" if missing else ""


def begin(folder: Path, manifest: Manifest) -> Manifest:
    """Make a dataset folder, or check that an existing one was made with the same settings.

    Returns the manifest now on disk, which asks for the episodes of both. Raises :class:`DataError` with
    the differing settings.
    """
    places = [folder / name for name in ("shards", "receipts", "rejects")]
    if linked := [p for p in places if p.is_symlink()]:
        raise DataError(f"{linked[0]}: is a link, and nothing is written through one; put the folder itself there")
    try:
        (folder / "shards").mkdir(parents=True, exist_ok=True)
        (folder / "receipts").mkdir(exist_ok=True)
    except (PermissionError, NotADirectoryError, FileExistsError) as error:
        raise DataError(f"{folder}: cannot make a dataset here ({error.strerror}); choose another --out") from error
    with locked(folder):
        manifest = _joined(folder, manifest)
        manifest.write(folder)
    for place in (folder, *places):
        remove_leftovers(place)
    return manifest


def check_continues(folder: Path, manifest: Manifest) -> None:
    """Refuse a folder that holds a dataset made with other settings. Raises :class:`DataError` with the difference."""
    if (folder / MANIFEST).exists():
        _check_settings(folder, Manifest.read(folder), manifest)


def _joined(folder: Path, manifest: Manifest) -> Manifest:
    """The manifest of a folder that may have one, now asking for what ``manifest`` asks for too."""
    joined, known = manifest, manifest.recordings[:0]
    if (folder / MANIFEST).exists():
        old = Manifest.read(folder)
        _check_settings(folder, old, manifest)
        known = old.recordings
        requested = {t: max(n, manifest.requested.get(t, 0)) for t, n in old.requested.items()}
        joined = old.model_copy(
            update={"requested": {**manifest.requested, **requested}, "schema_version": SCHEMA_VERSION}
        )
    if manifest.provenance.inferred is not None:  # films have their numbers
        joined = joined.model_copy(update={"recordings": manifest.recordings})
    elif manifest.recordings:
        recordings = number_recordings(known, manifest.recordings)
        requested = dict(Counter(r.task for r in recordings))
        joined = joined.model_copy(update={"recordings": recordings, "requested": requested})
    return joined


def _check_settings(folder: Path, old: Manifest, manifest: Manifest) -> None:
    """Refuse a dataset that was made with other settings."""
    # Through JSON, so that tuples and lists compare as they are stored.
    mine = json.loads(manifest.model_dump_json())
    theirs = json.loads(old.model_dump_json())
    for values in (theirs, mine):
        values |= {"stages": list(values["settings"]), "camera": values["provenance"]["camera"]}
    compared = ("stages", "settings", "first_seed", "camera")
    lines = list(differences({k: theirs[k] for k in compared}, {k: mine[k] for k in compared}))
    if lines:
        raise DataError(
            f"{folder}: made with other settings, and one dataset has one setting. "
            f"Choose another --out, or the same settings:\n  " + "\n  ".join(lines)
        )


def summarize(folder: Path) -> Dataset:
    """Write what follows from the receipts: statistics, rejects and the dataset card."""
    dataset = Dataset(folder)
    for name, text in summaries(dataset).items():
        write_atomically(folder / name, text)
    return dataset


def summaries(dataset: Dataset) -> dict[str, str]:
    """The files of a dataset that follow from its receipts, by name."""
    rejects = [x.model_dump_json(exclude_defaults=True) + "\n" for r in dataset.receipts for x in r.rejects]
    return {
        "stats.json": json.dumps(dataset.stats, indent=1) + "\n",
        "rejects.jsonl": "".join(rejects),
        CARD: dataset_card(dataset.manifest, dataset.receipts, dataset.stats, dataset.arrays),
    }
