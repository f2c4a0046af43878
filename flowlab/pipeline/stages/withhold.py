"""The stage that leaves out what the robot knew of itself, as in films of a robot whose commands were not kept."""

from dataclasses import replace
from typing import Annotated, Any, Literal

from pydantic import Field, PlainSerializer

from flowlab.pipeline.stage import Stage
from flowlab.provenance import Provenance
from flowlab.records import Episode


class WithholdStage(Stage):
    """Leaves state or actions out of episodes, as if they had never been known."""

    stage: str = "withhold"
    what: Annotated[frozenset[Literal["state", "action"]], PlainSerializer(sorted)] = Field(min_length=1)
    """What is left out."""

    def process(self, record: Episode) -> Episode:
        """The episode without it: the array keeps its rows, and has no columns."""
        changes: dict[str, Any] = {name: getattr(record, name)[:, :0] for name in self.what}
        names = {f"{name}_names" for name in self.what}
        return replace(record, **changes, extras={k: v for k, v in record.extras.items() if k not in names})

    def describe(self, provenance: Provenance, task: str) -> Provenance:
        """There is none of it."""
        known: dict[str, Any] = dict.fromkeys(self.what, ())
        return provenance.model_copy(update=known | ({"action_limits": None} if "action" in self.what else {}))
