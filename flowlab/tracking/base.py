"""What a tracker is: settings, and a session per clip that follows points through part of it."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32
from pydantic import ValidationError

from flowlab.config import Settings
from flowlab.errors import UsageError, unknown_name
from flowlab.records import Clip, Tracks2D
from flowlab.registry import TRACKERS
from flowlab.text import shown


@runtime_checkable
class Session(Protocol):
    """One clip, opened by a tracker: whatever is made once per frame is made here, once."""

    def track(self, queries_txy: Float32[np.ndarray, "M 3"], start: int, stop: int) -> Tracks2D:
        """Follow points through part of the clip.

        At its own frame a point is where it was asked for, and visible; before it, it is held there and
        not visible.

        Args:
            queries_txy: (t, x, y) of every point: its frame, ``start <= t < stop``, and its pixel there, integer
                pixel centers.
            start: The first frame that is asked for.
            stop: The frame after the last.

        Returns:
            Tracks through frames ``start`` to ``stop - 1``; row k is frame ``start + k``.
        """
        ...


class Tracker(Settings, ABC):
    """Follows points through a clip. The fields of a subclass are its options, settable in recipes."""

    name: ClassVar[str]
    license: ClassVar[str]
    """Of its code and weights, in a few words; stored with everything it labeled."""
    chunked: ClassVar[bool] = True
    """Whether a long clip is given in overlapping chunks; else whole."""

    @abstractmethod
    def open(self, clip: Clip) -> Session:
        """Get ready to track points of a clip."""

    def describe(self) -> dict[str, Any]:
        """Where labels of this tracker come from, as JSON values; stored in every episode."""
        return {"tracker": self.name, "license": self.license, "options": self.model_dump(mode="json")}


def make_tracker(name: str, options: Mapping[str, Any] | None = None) -> Tracker:
    """A tracker with options.

    Args:
        name: An installed tracker, or an import path ``module:Class``.
        options: Values of the tracker's own fields.

    Raises:
        UsageError: There is no such tracker, or no such option, or an option has a value that does not fit.
    """
    cls = TRACKERS.load(name)
    try:
        tracker: Tracker = cls.model_validate(dict(options or {}))
    except ValidationError as error:
        first = error.errors()[0]
        option = ".".join(map(str, first["loc"]))
        if first["type"] == "extra_forbidden":
            raise UsageError(f"tracker '{name}': {unknown_name('option', option, cls.model_fields)}") from error
        raise UsageError(f"tracker '{name}': {option}: {first['msg']} (found {shown(first['input'])})") from error
    return tracker
