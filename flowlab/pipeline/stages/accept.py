"""The stage that keeps failed demonstrations out."""

from pydantic import Field

from flowlab.pipeline.stage import Rejected, Stage
from flowlab.records import Episode


class AcceptStage(Stage):
    """Keeps failed demonstrations out."""

    stage: str = "accept"
    success_steps: int = Field(default=5, ge=0)
    """Steps the task must have been solved for; 5 is DP3's rule."""

    def process(self, record: Episode) -> Episode:
        """Let a successful episode pass."""
        solved = int(record.success.sum())
        if solved < self.success_steps:
            raise Rejected(f"solved for {solved} steps of {len(record)}, at least {self.success_steps} asked for")
        return record
