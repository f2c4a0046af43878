"""Where work units run: what an engine must do, so that a cluster's can stand in for the processes of this machine."""

import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import partial
from typing import Any, Generic, Self, TypeVar

from flowlab.arguments import check_optional_count
from flowlab.registry import ENGINES

Unit = TypeVar("Unit")
Receipt = TypeVar("Receipt")

WORKER_ENVIRONMENT = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "LP_NUM_THREADS",
    "OPENCV_FOR_THREADS_NUM",
    "MALLOC_ARENA_MAX",
)
"""All set to 1: a worker is one core's work, and memory pools for more threads would only lie idle."""


@dataclass(frozen=True, slots=True)
class UnitResult(Generic[Unit, Receipt]):
    """What became of a unit: its receipt, or why there is none."""

    unit: Unit
    receipt: Receipt | None
    failure: str = ""
    """Traceback, or how the worker died."""

    @property
    def reason(self) -> str:
        """The last line of the failure, for a sentence about it."""
        return self.failure.strip().splitlines()[-1]


class Engine(ABC, Generic[Unit, Receipt]):
    """Runs units of some kind and hands back results as they come; units never exchange arrays through it.

    An engine is a context: it begins when that is entered, and stops what still runs when it is left.

    Args:
        work: Does one unit and returns its receipt. It can be pickled, and so can units and receipts; it keeps what
            it makes on a disk that all workers and this program share.
        workers: How many units to run at a time.
        imports: Modules that a worker will need, to be imported before units come.
    """

    def __init__(self, work: Callable[[Unit], Receipt], *, workers: int, imports: Sequence[str] = ()) -> None:
        self.work, self.workers, self.imports = work, workers, tuple(imports)

    @classmethod
    def default_workers(cls) -> int:
        """How many units to run at a time if nobody says; the default is one for each core of this machine."""
        return core_count()

    def __enter__(self) -> Self:
        """Begin; the default has nothing to do."""
        return self

    def __exit__(self, *failure: object) -> None:
        """Stop what still runs; the default has nothing to do."""
        return

    @abstractmethod
    def submit(self, unit: Unit) -> None:
        """Start a unit as soon as there is room, and return at once."""

    @abstractmethod
    def next_result(self) -> UnitResult[Unit, Receipt]:
        """Wait for a unit to end.

        Raises:
            FlowlabError: Work raised it, so that going on is useless; :class:`OSError` likewise. Any other error of
                work is the failure of its unit.
        """

    def results_of(self, units: Sequence[Unit]) -> Iterator[UnitResult[Unit, Receipt]]:
        """Start all units, and hand back what became of each as it ends. Raises what :meth:`next_result` does."""
        for unit in units:
            self.submit(unit)
        for _ in units:
            yield self.next_result()


StartEngine = Callable[[Callable[[Unit], Receipt]], AbstractContextManager[Engine[Unit, Receipt]]]
"""Makes an engine that does units with the given function."""


def core_count() -> int:
    """Cores that this program may use: as many workers as there are by default."""
    return len(os.sched_getaffinity(0))


def engine_by_name(
    name: str, workers: int | None = None, imports: Sequence[str] = ()
) -> Callable[[Callable[[Unit], Receipt]], Engine[Unit, Receipt]]:
    """What makes an engine of that name, or at that import path.

    Args:
        name: ``local``, ``ray``, or another that ``flowlab plugins`` lists, or ``module:Class``.
        workers: How many units to run at a time; None for what the engine takes by default.
        imports: Modules that a worker will need.

    Raises:
        UsageError: There is no such engine, or fewer than one worker.
    """
    engine: Any = ENGINES.load(name)
    return partial(
        engine, workers=check_optional_count(workers, "workers") or engine.default_workers(), imports=imports
    )
