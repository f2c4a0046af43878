"""What was found when the recordings of a dataset were checked, as it is stored with their episodes."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

from flowlab.recordings.verdicts import Check, Verdict, stored_checks
from flowlab.storage.dataset import Dataset
from flowlab.storage.episodes import unit_shard


@dataclass(frozen=True, slots=True)
class EpisodeChecks:
    """The checks of one recorded episode."""

    task: str
    seed: int
    recording: str
    """Its name."""
    shard: str
    """Path of the file that says so."""
    checks: tuple[Check, ...] | None
    """None where the recording was not checked, as by an earlier flowlab."""

    @property
    def doubtful(self) -> tuple[Check, ...]:
        """Those against which something speaks."""
        return tuple(c for c in self.checks or () if c.verdict in (Verdict.DOUBTFUL, Verdict.REFUSED))

    def __str__(self) -> str:
        return f"{self.task} seed {self.seed} ({self.recording})"


def kept_checks(dataset: Dataset) -> Iterator[EpisodeChecks]:
    """The checks of every recorded episode; nothing of simulation.

    Raises:
        DataError: A shard is missing or damaged.
    """
    names = {(r.task, r.seed): r.name for r in dataset.manifest.recordings}
    for receipt in dataset.receipts if names else ():
        shard = unit_shard(dataset.path, receipt) if receipt.accepted else None
        for k, seed in enumerate(receipt.accepted):
            assert shard is not None
            name = names.get((receipt.task, seed), "")
            yield EpisodeChecks(receipt.task, seed, name, str(shard.path), stored_checks(shard.about(k)))


@dataclass(frozen=True, slots=True)
class CheckTotals:
    """The checks of a dataset in numbers."""

    verdicts: dict[str, int]
    """How many checks had each verdict."""
    not_checked: int
    """Episodes of which nothing is known."""
    doubtful: tuple[EpisodeChecks, ...]
    """Episodes with a doubt."""


def total_checks(dataset: Dataset) -> CheckTotals | None:
    """The checks of a dataset; None of one that holds no recorded episode. Raises as :func:`kept_checks` does."""
    kept = list(kept_checks(dataset))
    count = Counter(check.verdict.value for episode in kept for check in episode.checks or ())
    missing = sum(episode.checks is None for episode in kept)
    doubtful = tuple(episode for episode in kept if episode.doubtful)
    return CheckTotals({v.value: count[v.value] for v in Verdict}, missing, doubtful) if kept else None
