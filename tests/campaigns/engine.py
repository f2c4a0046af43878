"""An engine that does units in the program itself, so that a trial is one process, which can be forked and killed."""

from collections import deque
from typing import Any

from flowlab.engines.base import Engine, UnitResult

NAME = f"{__name__}:InProcess"


class InProcess(Engine[Any, Any]):
    def __init__(self, work: Any, **options: Any) -> None:
        super().__init__(work, **options)
        self._units: deque[Any] = deque()

    def submit(self, unit: Any) -> None:
        self._units.append(unit)

    def next_result(self) -> UnitResult[Any, Any]:
        unit = self._units.popleft()
        return UnitResult(unit, self.work(unit))
