"""Everything that would spoil training on a dataset, found before it does."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flowlab.errors import DataError
from flowlab.provenance import Provenance
from flowlab.storage.checks import ArrayProblem, episode_problems
from flowlab.storage.dataset import Dataset
from flowlab.storage.manifest import MANIFEST
from flowlab.storage.receipts import Receipt, check_widths
from flowlab.storage.schema import EPISODE_ENDS, SCHEMA
from flowlab.storage.shard import Shard, episode_digest


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
        yield _finding(path, error)
        return
    yield from _check_books(dataset)
    seen: dict[tuple[str, int], str] = {}
    for receipt in dataset.receipts:
        if not receipt.accepted:
            continue
        place = path / receipt.shard
        if not place.exists():
            yield Finding(str(place), f"missing, but {path}/receipts/{receipt.unit}.json counts it; {_ANEW}")
            continue
        for task_seed in ((receipt.task, s) for s in receipt.accepted):
            if task_seed in seen:
                yield Finding(str(place), f"{task_seed[0]} seed {task_seed[1]} is also in {seen[task_seed]}")
            seen[task_seed] = str(place)
        try:
            yield from _check_shard(dataset, receipt, Shard(place))
        except DataError as error:
            yield _finding(place, error)


_ANEW = "delete the receipt and run the same extract command again"


def _finding(path: Path, error: DataError) -> Finding:
    place, separator, problem = str(error).partition(": ")
    return Finding(place, problem) if separator else Finding(str(path), place)


def _under(shard: str, problem: ArrayProblem, who: str = "") -> Finding:
    return Finding(f"{shard}/{problem.array}", who + problem.what)


def _check_books(dataset: Dataset) -> Iterator[Finding]:
    """Manifest, receipts and folder against each other."""
    path = dataset.path
    what = "recordings" if dataset.manifest.recordings else "episodes"
    for task, missing in dataset.missing.items():
        asked = dataset.manifest.requested[task]
        problem = f"{task}: {asked - missing} of {asked} {what}; run the same extract command again for the rest"
        yield Finding(str(path / MANIFEST), problem)
    try:
        check_widths(path, dataset.receipts)
    except DataError as error:
        yield _finding(path, error)
    kept = {r.rejects_shard for r in dataset.receipts if any(x.position is not None for x in r.rejects)}
    counted = kept | {r.shard for r in dataset.receipts if r.accepted}
    for shard in sorted([*(path / "shards").glob("*.zarr"), *(path / "rejects").glob("*.zarr")]):
        if str(shard.relative_to(path)) not in counted:
            yield Finding(str(shard), "has no receipt, so it does not count; run the same extract command again")
    for name in sorted(kept):
        if not (path / name).exists():
            receipt = f"{path}/receipts/{Path(name).stem}.json"
            yield Finding(f"{path}/{name}", f"missing, but {receipt} keeps a rejected episode there; {_ANEW}")


def _check_shard(dataset: Dataset, receipt: Receipt, shard: Shard) -> Iterator[Finding]:
    place = str(shard.path)
    if shard.attributes.get("settings_digest") != dataset.manifest.settings_digest:
        yield Finding(place, f"made with other settings than {MANIFEST} states; remove it and extract again")
    if len(shard) != len(receipt.accepted):
        yield Finding(place, f"holds {len(shard)} episodes, its receipt says {len(receipt.accepted)}; {_ANEW}")
        return
    columns, problems = {}, False
    for spec in shard.specs():
        try:
            columns[spec.path] = shard.array(spec.path)
        except DataError as error:
            problems = True
            yield _finding(shard.path, error)
    ends = shard.array(EPISODE_ENDS)
    for problem in [] if problems else _shape_problems(dataset.manifest.provenance, columns, ends):
        problems = True
        yield _under(place, problem)
    if problems:
        return
    episodes = list(shard.episodes())
    held = [(e.task, e.seed, len(e)) for e in episodes]
    told = [(receipt.task, *x) for x in zip(receipt.accepted, receipt.frames, strict=True)]
    if held != told:
        yield Finding(place, f"holds (task, seed, frames) {held}, its receipt says {told}; {_ANEW}")
        return
    for episode, digest in zip(episodes, receipt.digests, strict=True):
        for problem in episode_problems(episode, dataset.manifest.provenance):
            yield _under(place, problem, f"seed {episode.seed}: ")
        if episode_digest(episode) != digest:
            yield Finding(place, f"seed {episode.seed}: content differs from what its receipt says; {_ANEW}")


def _shape_problems(known: Provenance, columns: dict[str, np.ndarray], ends: np.ndarray) -> Iterator[ArrayProblem]:
    """Types and shapes against the schema, the provenance and each other."""
    if len(ends) == 0 or (np.diff(ends, prepend=0) <= 0).any():
        yield ArrayProblem(EPISODE_ENDS, f"must rise from above 0, found {ends.tolist()[:8]}")
        return
    sizes = {"time": int(ends[-1]), "episode": len(ends), "xyz": 3, "rgb": 3, "pose": 9}
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
