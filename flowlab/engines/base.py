"""What every engine does: run units of work, and hand back what became of them."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

Unit = TypeVar("Unit")
Receipt = TypeVar("Receipt")


@dataclass(frozen=True, slots=True)
class UnitResult(Generic[Unit, Receipt]):
    """What became of a unit: its receipt, or why there is none."""

    unit: Unit
    receipt: Receipt | None
    failure: str = ""
    """Traceback, or how the worker died."""


class Engine(Protocol[Unit, Receipt]):
    """Runs units of some kind and hands back outcomes as they come; units never exchange arrays through it."""

    def submit(self, unit: Unit) -> None:
        """Start a unit as soon as there is room."""
        ...

    def next_result(self) -> UnitResult[Unit, Receipt]:
        """Wait for a unit to end. A :class:`FlowlabError` or :class:`OSError` of a worker is raised here."""
        ...


StartEngine = Callable[[Callable[[Unit], Receipt]], AbstractContextManager[Engine[Unit, Receipt]]]
"""Makes an engine that does units with the given function; leaving the context stops it."""
