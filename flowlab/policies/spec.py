"""Everything a policy's network is built from; read and checked without PyTorch, which takes a second to load."""

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import Field, model_validator

from flowlab.config import Settings
from flowlab.data.channels import ChannelSpec
from flowlab.data.normalizer import Normalizer
from flowlab.limits import MAX_WIDTH
from flowlab.policies.profiles import AnyTrainSettings


class PolicySpec(Settings):
    """Everything a policy's network is built from; with the weights, everything that is needed to use it."""

    settings: AnyTrainSettings
    state_width: Annotated[int, Field(ge=0, le=MAX_WIDTH)]
    action_width: Annotated[int, Field(ge=1, le=MAX_WIDTH)]
    tasks: tuple[str, ...]
    channels: ChannelSpec
    normalizer: Normalizer
    observer: Mapping[str, Any] | None
    """Settings of the Observer that made the clouds; None where they are not known."""
    queries: Mapping[str, Any]
    """Settings of the query points, as this policy was trained with them."""

    @model_validator(mode="after")
    def _fits(self) -> "PolicySpec":
        """Refuse what would fail, or compute nonsense, when it is used."""
        n, c = self.normalizer, self.channels
        widths = {"position": 3, "state": self.state_width, "action": self.action_width, "flow": 3}
        for name, width in widths.items():
            if (scale := getattr(n, name)) is not None and not scale.fits(width):
                raise ValueError(f"normalizer.{name} must have {width} finite offsets and positive units")
        of_action = (c.action_position, c.action_displacement)
        for triples, width, of in (((c.gripper, *c.state_positions), self.state_width, "state"),
                                   (of_action, self.action_width, "action")):  # fmt: skip
            if any(not 0 <= k < width for triple in triples if triple is not None for k in triple):
                raise ValueError(f"channels name a number of the {of} that is not there; it has {width}")
        if not self.tasks or len(set(self.tasks)) < len(self.tasks):
            raise ValueError("tasks must be names, each there once")
        return self
