"""An engine that does its units one after the other in this process, and whose first one fails, whatever it is."""

from collections.abc import Callable, Sequence
from typing import Any

from flowlab.engines.base import Engine, UnitResult

FAILURE = 'Traceback (most recent call last):\n  File "mill.py", line 3, in grind\nValueError: low tide\n'


class FirstFails(Engine[Any, Any]):
    """Give it to a command as ``--engine failing_engine:FirstFails``."""

    def __init__(self, work: Callable[[Any], Any], *, workers: int, imports: Sequence[str] = ()) -> None:
        super().__init__(work, workers=workers, imports=imports)
        self._units: list[Any] = []
        self._ended = 0

    def submit(self, unit: Any) -> None:
        self._units.append(unit)

    def next_result(self) -> UnitResult[Any, Any]:
        unit, self._ended = self._units.pop(0), self._ended + 1
        return UnitResult(unit, None, FAILURE) if self._ended == 1 else UnitResult(unit, self.work(unit))
