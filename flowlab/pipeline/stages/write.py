"""The stage that writes episodes into shards."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from flowlab.pipeline.stage import Writer
from flowlab.records import Episode
from flowlab.storage.shard import write_shard


class WriteStage(Writer):
    """Writes the episodes of a unit into its shard."""

    stage: str = "write"
    depth: bool = False
    """Store the depth pictures too, so that clouds can be cropped anew later."""
    rgb: bool = True
    """Store the color pictures, where there are any."""

    def process(self, record: Episode) -> Episode:
        """The episode without what is not stored."""
        return replace(record, depth=record.depth if self.depth else None, rgb=record.rgb if self.rgb else None)

    def store(self, path: Path, episodes: Sequence[Episode], settings_digest: str) -> None:
        """Write the shard in one step."""
        write_shard(path, episodes, settings_digest)
