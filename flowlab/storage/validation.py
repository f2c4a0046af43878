"""Everything that would spoil training on a dataset, found before it does."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flowlab.checksums import has_sha256
from flowlab.errors import DataError
from flowlab.provenance import Provenance
from flowlab.records import Episode
from flowlab.storage.card import CARD, says_the_same
from flowlab.storage.checks import ArrayProblem, episode_problems
from flowlab.storage.dataset import Dataset, summaries
from flowlab.storage.manifest import MANIFEST
from flowlab.storage.receipts import Receipt
from flowlab.storage.schema import EPISODE_ENDS, SCHEMA, SCHEMA_VERSION
from flowlab.storage.shard import REPAIR, Shard, episode_digest
from flowlab.storage.stats import differing_stats, summarize
from flowlab.storage.trainable import row_problems
from flowlab.text import counted
from flowlab.untrusted import read_text
from flowlab.version import __version__


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing wrong with a dataset."""

    place: str
    """The file."""
    problem: str
    """What was found, what was expected, what to do."""

    def __str__(self) -> str:
        return f"{self.place}: {self.problem}"


def validate(path: Path) -> Iterator[Finding]:
    """Every finding about a dataset; none if it is sound and complete."""
    try:
        dataset = Dataset(path)
    except DataError as error:
        yield finding_of(path, error)
        return
    yield from _check_complete(dataset)
    yield from _check_books(dataset)
    yield from validate_content(dataset)


def validate_content(dataset: Dataset) -> Iterator[Finding]:
    """Every finding about the episodes of a dataset, and what it says of their numbers; none if they are sound."""
    path = dataset.path
    yield from (Finding(str(path), problem) for problem in row_problems(dataset))
    seen: dict[tuple[str, int], str] = {}
    for receipt in dataset.receipts:
        place = str(path / receipt.shard)
        for task_seed in ((receipt.task, s) for s in receipt.accepted):
            if task_seed in seen:
                yield Finding(place, f"{task_seed[0]} seed {task_seed[1]} is also in {seen[task_seed]}")
            seen[task_seed] = place
        yield from check_unit(dataset, receipt)


def check_unit(dataset: Dataset, receipt: Receipt, *, contents: bool = True) -> Iterator[Finding]:
    """Every finding about a unit: what is missing or damaged, or not what the receipt says, and then what is wrong with
    its episodes, unless only the damage is asked for."""
    for shard, checksum in (receipt.shard, receipt.shard_sha256), (receipt.rejects_shard, receipt.rejects_sha256):
        place = dataset.path / shard
        if checksum and place.is_file() and not has_sha256(place, checksum):
            yield Finding(str(place), f"damaged (its content does not match the checksum in its receipt); {REPAIR}")
            return
    lost = lost_shards(dataset.path, receipt)
    for place in lost:
        book = f"{dataset.path}/receipts/{receipt.unit}.json counts it"
        yield Finding(str(place), f"missing, but {book}; {REPAIR}")
    place = dataset.path / receipt.shard
    if not receipt.accepted or place in lost:
        return
    try:
        yield from _check_shard(dataset, receipt, Shard(place), contents)
    except DataError as error:
        yield finding_of(place, error)


def lost_shards(folder: Path, receipt: Receipt) -> list[Path]:
    """The shards that a receipt counts, and that are not there."""
    shards = [receipt.shard] if receipt.accepted else []
    shards += [receipt.rejects_shard] if receipt.keeps_rejects else []
    return [folder / shard for shard in shards if not (folder / shard).exists()]


def finding_of(path: Path, error: DataError) -> Finding:
    """An error as a finding: the file that it begins with, or else ``path``."""
    place, separator, problem = str(error).partition(": ")
    return Finding(place, problem) if separator else Finding(str(path), place)


def _under(shard: str, problem: ArrayProblem, who: str = "") -> Finding:
    return Finding(f"{shard}/{problem.array}", who + problem.what)


def _check_complete(dataset: Dataset) -> Iterator[Finding]:
    """What is still to be made."""
    path = dataset.path
    what = "recordings" if dataset.manifest.recordings else "episodes"
    for task, missing in dataset.missing.items():
        asked = dataset.manifest.requested[task]
        problem = f"{task}: {asked - missing} of {asked} {what}; run the same extract command again for the rest"
        yield Finding(str(path / MANIFEST), problem)


def _check_books(dataset: Dataset) -> Iterator[Finding]:
    """Receipts and folder against each other."""
    path = dataset.path
    counted = {shard for receipt in dataset.receipts for shard in receipt.shards}
    for shard in sorted([*(path / "shards").glob("*.zarr*"), *(path / "rejects").glob("*.zarr*")]):
        if str(shard.relative_to(path)) not in counted:
            yield Finding(str(shard), "has no receipt, so it does not count; run the same extract command again")
    yield from _check_summaries(dataset)


def _check_summaries(dataset: Dataset) -> Iterator[Finding]:
    """What follows from the receipts and is stored for people: does it say what they say?"""
    made_by = dataset.manifest.schema_version, dataset.manifest.flowlab
    if made_by != (SCHEMA_VERSION, __version__):  # another one may put it in other words
        return
    try:
        wanted = summaries(dataset)
    except DataError:  # of widths that differ, which has been told
        return
    for name, text in wanted.items():
        place = dataset.path / name
        try:
            found = read_text(place)
        except DataError as error:
            yield finding_of(place, error)
            continue
        if name == CARD and says_the_same(found, text, dataset.manifest, dataset.receipts, dataset.stats):
            continue
        if found != text:
            yield Finding(
                str(place), "does not say what the receipts say; run the same command again, it writes it anew"
            )


def _check_shard(dataset: Dataset, receipt: Receipt, shard: Shard, contents: bool) -> Iterator[Finding]:
    place = str(shard.path)
    if shard.attributes.settings_digest != dataset.manifest.settings_digest:
        yield Finding(place, f"made with other settings than {MANIFEST} states; {REPAIR}")
    if len(shard) != len(receipt.accepted):
        yield Finding(
            place, f"holds {counted(len(shard), 'episode')}, its receipt says {len(receipt.accepted)}; {REPAIR}"
        )
        return
    columns, problems = {}, False
    for spec in shard.specs():
        try:
            columns[spec.path] = shard.array(spec.path)
        except DataError as error:
            problems = True
            yield finding_of(shard.path, error)
    ends = shard.array(EPISODE_ENDS)
    for problem in [] if problems else _shape_problems(dataset.manifest.provenance, columns, ends):
        problems = True
        yield _under(place, problem)
    if not problems:
        yield from _check_episodes(dataset, receipt, place, list(shard.episodes_of(columns)), contents)


def _check_episodes(
    dataset: Dataset, receipt: Receipt, place: str, episodes: list[Episode], contents: bool
) -> Iterator[Finding]:
    held = [(e.task, e.seed, len(e)) for e in episodes]
    told = [(receipt.task, *x) for x in zip(receipt.accepted, receipt.frames, strict=True)]
    if held != told:
        yield Finding(place, f"holds (task, seed, frames) {held}, its receipt says {told}; {REPAIR}")
        return
    changed = [e for e, digest in zip(episodes, receipt.digests, strict=True) if episode_digest(e) != digest]
    for episode in changed:
        yield Finding(place, f"seed {episode.seed}: content differs from what its receipt says; {REPAIR}")
    problems = [(e, p) for e in episodes for p in episode_problems(e, dataset.provenance)] if contents else []
    for episode, problem in problems:
        yield _under(place, problem, f"seed {episode.seed}: ")
    if changed or problems:
        return
    if different := differing_stats(receipt.stats, summarize(episodes)):
        path = dataset.path / "receipts" / f"{receipt.unit}.json"
        yield Finding(str(path), f"stats.{different}: is not what the episodes of {place} have; {REPAIR}")


def _shape_problems(known: Provenance, columns: dict[str, np.ndarray], ends: np.ndarray) -> Iterator[ArrayProblem]:
    """Types and shapes against the schema, the provenance and each other."""
    if len(ends) == 0 or (np.diff(ends, prepend=0) <= 0).any():
        yield ArrayProblem(EPISODE_ENDS, f"must rise from above 0, found {ends.tolist()[:8]}")
        return
    sizes = {"time": int(ends[-1]), "episode": len(ends), "xyz": 3, "rgb": 3, "pose": 9, "row": 4, "column": 4}
    sizes |= {dim: made["points"] for dim, made in (("point", known.observer), ("query", known.queries)) if made}
    for spec in SCHEMA:
        if spec.path not in columns:
            continue
        values = columns[spec.path]
        if values.dtype != spec.dtype:
            yield ArrayProblem(spec.path, f"type is {values.dtype}, expected {spec.dtype}")
        expected = tuple(sizes.setdefault(dim, n) for dim, n in zip(spec.dims, values.shape, strict=False))
        if values.shape != expected or len(values.shape) != len(spec.dims):
            yield ArrayProblem(spec.path, f"shape is {values.shape}, expected {expected} for {', '.join(spec.dims)}")
