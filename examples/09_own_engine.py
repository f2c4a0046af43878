"""An engine of your own: where work units run. This one does them one after another, in this very process.

    python examples/09_own_engine.py data/serial
    PYTHONPATH=examples flowlab extract-sim push --episodes 3 --engine 09_own_engine:SerialEngine --out data/serial

An engine for a cluster sends ``work`` and a unit, both of which can be pickled, to a machine that sees the same disk,
and hands back the receipt. A :class:`~flowlab.errors.FlowlabError` or an :class:`OSError` of the work ends the run; any
other error is the failure of its unit alone, which the next run tries again. `flowlab/engines/local.py` has processes.

A package that offers the class as an entry point makes it known by name::

    [project.entry-points."flowlab.engines"]
    serial = "my_package.serial:SerialEngine"
"""

import sys
import traceback
from collections import deque
from typing import Any

import flowlab
from flowlab.engines.base import Engine, UnitResult


class SerialEngine(Engine[Any, Any]):
    """Does a unit when its result is asked for."""

    def __init__(self, work: Any, **options: Any) -> None:
        super().__init__(work, **options)
        self._waiting: deque[Any] = deque()

    def submit(self, unit: Any) -> None:
        """Remember a unit."""
        self._waiting.append(unit)

    def next_result(self) -> UnitResult[Any, Any]:
        """Do the unit that has waited longest."""
        unit = self._waiting.popleft()
        try:
            return UnitResult(unit, self.work(unit))
        except (flowlab.FlowlabError, OSError):
            raise
        except Exception:
            return UnitResult(unit, None, traceback.format_exc())


if __name__ == "__main__":
    print(flowlab.extract("push", sys.argv[1], episodes=1, engine="09_own_engine:SerialEngine"))
