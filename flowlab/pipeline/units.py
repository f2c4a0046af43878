"""Work units: which seeds are tried next, and by whom."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

from flowlab.config import Settings
from flowlab.errors import UsageError


class WorkUnit(Settings):
    """Some seeds of one task, done by one worker into one shard."""

    task: str
    seeds: tuple[int, ...]

    @property
    def name(self) -> str:
        """The unit's name, and that of its shard and receipt."""
        first, last = f"{self.seeds[0]:06d}", f"{self.seeds[-1]:06d}"
        return f"{self.task}-{first}" if len(self.seeds) == 1 else f"{self.task}-{first}-{last}"


@dataclass(frozen=True, slots=True)
class Share:
    """Part ``index`` of ``count`` of the units, for jobs that fill one dataset together."""

    index: int = 0
    count: int = 1

    @classmethod
    def parse(cls, text: str) -> "Share":
        """From ``i/n`` with i counted from 0."""
        index, slash, count = text.partition("/")
        if not (slash and index.isdigit() and count.isdigit() and int(index) < int(count)):
            raise UsageError(f"--shard {text}: must be i/n with i from 0 to n-1, as in --shard 0/4")
        return cls(int(index), int(count))


def unit_size(episodes: int) -> int:
    """Seeds to a unit: enough units for many workers, few enough that writing them costs little.

    It depends on the request alone, never on the workers, so that the shards are the same everywhere.
    """
    return max(2, min(16, episodes // 16))


def next_units(
    task: str, wanted: int, first_seed: int, tried: Collection[int], accepted: int, share: Share
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
