"""Plans: which units are started next, so that a dataset gets what was asked for however it comes about."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from flowlab.pipeline.units import JobShard, WorkUnit
from flowlab.storage.receipts import Receipt
from flowlab.storage.recorded import Recorded


@dataclass(frozen=True, slots=True)
class ExtractionProgress:
    """How far a run is: episodes accepted of those wanted, and seeds or recordings rejected on the way."""

    accepted: int
    wanted: int
    rejected: int


class UnitScheduler(Protocol):
    """Decides from what is done and under way what to do next; it keeps nothing in mind."""

    def next_units(self, receipts: Iterable[Receipt], taken: Sequence[WorkUnit], share: JobShard) -> Iterable[WorkUnit]:
        """The units to submit now. ``taken`` are under way or given up: their seeds are not for anyone else."""
        ...

    def progress(self, receipts: Iterable[Receipt]) -> ExtractionProgress:
        """How far this run is."""
        ...


@dataclass(frozen=True, slots=True)
class SeedScheduler:
    """Simulation: seeds are tried in order until every task has its episodes."""

    wanted: Mapping[str, int]
    """Successful episodes, by task."""
    first_seed: int

    def next_units(self, receipts: Iterable[Receipt], taken: Sequence[WorkUnit], share: JobShard) -> Iterable[WorkUnit]:
        """See :func:`next_units`, which is asked for every task."""
        tried: dict[str, set[int]] = {task: set() for task in self.wanted}
        sure = dict.fromkeys(self.wanted, 0)
        for receipt in receipts:
            if receipt.task in self.wanted:
                tried[receipt.task].update(receipt.seeds)
                sure[receipt.task] += len(receipt.accepted)
        for unit in taken:
            tried[unit.task].update(unit.seeds)
            sure[unit.task] += len(unit.seeds)
        for task, episodes in self.wanted.items():
            yield from next_units(task, episodes, self.first_seed, tried[task], sure[task], share)

    def progress(self, receipts: Iterable[Receipt]) -> ExtractionProgress:
        """How far this run is."""
        accepted, rejected = dict.fromkeys(self.wanted, 0), 0
        for receipt in receipts:
            if receipt.task in self.wanted:
                accepted[receipt.task] += len(receipt.accepted)
                rejected += len(receipt.rejects)
        done = sum(min(accepted[t], n) for t, n in self.wanted.items())
        return ExtractionProgress(done, sum(self.wanted.values()), rejected)


@dataclass(frozen=True, slots=True)
class RecordingScheduler:
    """Recordings: each is one unit, tried once; what is rejected stays so."""

    recordings: Sequence[Recorded]

    def next_units(self, receipts: Iterable[Receipt], taken: Sequence[WorkUnit], share: JobShard) -> Iterable[WorkUnit]:
        """One for every recording of this share that nobody has done."""
        done = {(receipt.task, seed) for receipt in receipts for seed in receipt.seeds}
        done |= {(unit.task, seed) for unit in taken for seed in unit.seeds}
        for one in self.recordings:
            if (one.task, one.seed) not in done and one.seed % share.count == share.index:
                yield WorkUnit(task=one.task, seeds=(one.seed,), sources=(one.source,), contents=(one.content,))

    def progress(self, receipts: Iterable[Receipt]) -> ExtractionProgress:
        """How far this run is."""
        mine = {(one.task, one.seed) for one in self.recordings}
        receipts = list(receipts)
        accepted = sum((r.task, seed) in mine for r in receipts for seed in r.accepted)
        rejected = sum((x.task, x.seed) in mine for r in receipts for x in r.rejects)
        return ExtractionProgress(accepted, len(self.recordings), rejected)


def unit_size(episodes: int) -> int:
    """Seeds to a unit: enough units for many workers, few enough that writing them costs little.

    It depends on the request alone, never on the workers, so that the shards are the same everywhere.
    """
    return max(2, min(16, episodes // 16))


def next_units(
    task: str, wanted: int, first_seed: int, tried: Collection[int], accepted: int, share: JobShard
) -> Sequence[WorkUnit]:
    """The units to start now so that the first ``wanted`` successful seeds, in order, get accepted.

    ``tried`` holds the seeds done or under way; of the latter every one counts in ``accepted`` until it
    fails. The first ``wanted`` seeds go out in units of fixed composition; after that each failure is
    made good by the next seed, alone, so that timing does not decide what shares a shard.
    """
    size = unit_size(wanted)
    first_round = range(first_seed, first_seed + wanted)
    units = []
    for k, start in enumerate(range(first_round.start, first_round.stop, size)):
        seeds = tuple(s for s in range(start, min(start + size, first_round.stop)) if s not in tried)
        if seeds:
            units.append((k, WorkUnit(task=task, seeds=seeds)))
    if units:
        return [unit for k, unit in units if k % share.count == share.index]
    seed = first_round.stop
    replacements: list[WorkUnit] = []
    while accepted + len(replacements) < wanted:
        if seed not in tried:
            replacements.append(WorkUnit(task=task, seeds=(seed,)))
        seed += 1
    return replacements
