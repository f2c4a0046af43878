"""Work units: some seeds each, and who does them."""

from dataclasses import dataclass

from flowlab.config import Settings
from flowlab.errors import UsageError
from flowlab.pipeline.stage import EpisodeRequest


class WorkUnit(Settings):
    """Some seeds of one task, done by one worker into one shard."""

    task: str
    seeds: tuple[int, ...]
    sources: tuple[str, ...] = ()
    """Path of the recording that each seed stands for; empty for simulation."""
    contents: tuple[str, ...] = ()
    """What each of these recordings is known by; empty for simulation."""

    @property
    def requests(self) -> list[EpisodeRequest]:
        """What the pipeline is asked for, seed by seed."""
        sources = self.sources or ("",) * len(self.seeds)
        return [EpisodeRequest(task=self.task, seed=s, source=x) for s, x in zip(self.seeds, sources, strict=True)]

    @property
    def name(self) -> str:
        """The unit's name, and that of its shard and receipt."""
        first, last = f"{self.seeds[0]:06d}", f"{self.seeds[-1]:06d}"
        return f"{self.task}-{first}" if len(self.seeds) == 1 else f"{self.task}-{first}-{last}"


@dataclass(frozen=True, slots=True)
class JobShard:
    """Part ``index`` of ``count`` of the units, for jobs that fill one dataset together."""

    index: int = 0
    count: int = 1

    @classmethod
    def parse(cls, text: str) -> "JobShard":
        """From ``i/n`` with i counted from 0."""
        index, slash, count = text.partition("/")
        if not (slash and index.isdigit() and count.isdigit() and int(index) < int(count)):
            raise UsageError(f"--shard {text}: must be i/n with i from 0 to n-1, as in --shard 0/4")
        return cls(int(index), int(count))
