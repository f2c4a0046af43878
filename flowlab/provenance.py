"""Where the episodes of a dataset come from, and what their numbers mean.

Written into the manifest by the stages that know, each its own part; read by training, evaluation, validation and the
dataset card. Nobody asks for the name of a stage.
"""

import json
from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self

from pydantic import Field, NonNegativeInt, model_validator

from flowlab.config import Settings, later
from flowlab.text import cut, shown


class Channels(Settings):
    """Some numbers of a state or an action that together mean one thing."""

    name: str
    """``hand``, ``left finger``, ``gripper``."""
    index: tuple[NonNegativeInt, ...] = Field(min_length=1)
    """Their places in the state or action, from 0."""
    kind: Literal["position", "displacement", "rotation", "joint", "effort", "other"]
    """``position`` and ``displacement`` are triples along x, y, z of ``frame``."""
    frame: str
    """``world`` is the dataset's world frame, in which its clouds and tracks are given; another name is another frame;
    empty where the numbers have none."""
    unit: str
    """``m``, ``cm``, ``rad``, ``1``."""

    @model_validator(mode="after")
    def _places_fit(self) -> Self:
        if len(set(self.index)) < len(self.index):
            raise ValueError(f"index of '{cut(self.name)}' names a place twice: {shown(self.index)}")
        if self.kind in ("position", "displacement") and len(self.index) != 3:
            raise ValueError(
                f"index of '{cut(self.name)}' is {shown(self.index)}, expected three places for a {self.kind}"
            )
        return self


class ChannelError(Settings):
    """How well a number of the state or action was inferred for demonstrations that were left out."""

    array: Literal["state", "action"]
    index: NonNegativeInt
    mean_error: float
    """Mean absolute error, in the unit of the array."""
    varies: float
    """Standard deviation of the number itself."""
    within_sigma: float
    """The share of errors within their stated size, calibrated on the other demonstrations; 0.68 is meant."""


class Inferred(Settings):
    """State or actions that nobody recorded: inferred from motion, see :func:`flowlab.label_actions`."""

    what: tuple[Literal["state", "action"], ...]
    films: str
    """Path of the dataset that they were inferred for."""
    labeled: str
    """Path of the labeled demonstrations that taught it."""
    fingerprint: str
    """Of these demonstrations."""
    method: str
    """By what, in words."""
    demonstrations: Mapping[str, NonNegativeInt]
    """How many of each task."""
    left_out: Mapping[str, tuple[ChannelError, ...]]
    """By task, the errors on labeled demonstrations that were left out one at a time."""


class Provenance(Settings):
    """Where the episodes of a dataset come from. What is not known is None or empty, and never guessed."""

    kind: Literal["simulated", "recorded", "imported", "unknown"] = "unknown"
    simulator: str = ""
    """Of simulated episodes: ``metaworld``."""
    scene: Mapping[str, Any] | None = None
    """Settings of the simulated scene, from which it can be shown again."""
    world_frame: str = ""
    """What the dataset's world frame is, in words."""
    camera: Mapping[str, Any] = {}
    """K [px] and T_world_cam, see :class:`flowlab.geometry.camera.Camera`; empty where every episode has its own."""
    state: tuple[Channels, ...] | None = None
    """What the numbers of the state mean; None where that is not known, empty where there is no state."""
    action: tuple[Channels, ...] | None = None
    """What the numbers of the action mean; None where that is not known, empty where there are no actions."""
    action_limits: tuple[tuple[float, ...], tuple[float, ...]] | None = None
    """Least and greatest value of every number of an action, as executed; None where that is not known."""
    observer: Mapping[str, Any] | None = None
    """Settings of the Observer that made the clouds."""
    queries: Mapping[str, Any] | None = None
    """Settings by which the query points were chosen."""
    tracks: Literal["exact", "estimated", "none"] = "none"
    """Whether tracks are the simulator's own, or estimated from pictures, with a stated error."""
    tracker: str = ""
    """Name of what estimated them."""
    inferred: Inferred | None = None
    """What of state and action was inferred from motion; None where all was recorded or simulated."""
    license: Annotated[str, later("")] = ""
    """Under which others may use it, as the Hugging Face Hub names licenses; empty where nobody has said."""
    hub: Annotated[str, later("")] = ""
    """Where on the Hub it was pulled from, with the commit: ``user/name@commit``; empty where it was not."""

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        if (self.tracks == "estimated") != bool(self.tracker):
            raise ValueError(
                f"tracks are '{self.tracks}', and the tracker is {shown(self.tracker)}; say both or neither"
            )
        for name in ("scene", "camera", "observer", "queries"):
            _check_json(name, getattr(self, name))
        if self.action_limits is not None:
            _check_limits(*self.action_limits)
            if problem := self.width_problem(action=len(self.action_limits[0])):
                raise ValueError(f"{problem}, as many as there are limits")
        return self

    def width_problem(self, state: int | None = None, action: int | None = None) -> str:
        """What does not fit a state or an action.

        Args:
            state: How many numbers a state has; None where that is not asked.
            action: The same of an action.

        Returns:
            What does not fit, in words; empty where everything does.
        """
        for what, channels, width in (("state", self.state, state), ("action", self.action, action)):
            if channels == () and width:
                return f"{what}: is said not to be there, and has {width} numbers"
            for c in channels or ():
                if width is not None and max(c.index) >= width:
                    return f"{what}: the channel '{cut(c.name)}' has number {max(c.index)}, and there are {width}"
        if action is not None and self.action_limits is not None and len(self.action_limits[0]) != action:
            return f"action_limits: there are {len(self.action_limits[0])}, and the action has {action} numbers"
        return ""

    @property
    def is_simulated(self) -> bool:
        """Whether a simulator made the episodes, so that an episode's seed decides its scene."""
        return self.kind == "simulated"


def _check_json(name: str, values: Any) -> None:
    """Refuse what cannot be written into a manifest and read back."""
    try:
        json.dumps(values, allow_nan=False, default=_as_settings)
    except (TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"{name}: holds what is no JSON ({cut(str(error))})") from error


def _as_settings(value: Any) -> Any:
    if isinstance(value, Mapping):
        return dict(value)
    raise TypeError(f"{type(value).__name__} {shown(value)}")


def _check_limits(low: tuple[float, ...], high: tuple[float, ...]) -> None:
    """Refuse limits that are none."""
    if len(low) != len(high) or not low:
        raise ValueError(f"action_limits: there are {len(low)} least and {len(high)} greatest values, expected as many")
    for k, (a, b) in enumerate(zip(low, high, strict=True)):
        if not a <= b:
            raise ValueError(f"action_limits: number {k} is from {a:g} to {b:g}, expected the least value first")
