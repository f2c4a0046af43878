"""Code of others that is a folder and no package: imported from there, without getting in anything's way."""

import importlib
import sys
from pathlib import Path
from types import ModuleType, TracebackType
from typing import Self


class Checkout:
    """A folder of Python code.

    Research code has modules of such names as ``models`` and ``utils``. They can be imported, and import each other,
    inside ``with checkout:`` only; so neither another folder's modules nor an installed package of the same name are
    mistaken for them, or they for those.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder.resolve()
        found = {p.stem if p.suffix == ".py" else p.name for p in self.folder.iterdir()}
        self._names = {name for name in found if name.isidentifier()}
        self._own: dict[str, ModuleType] = {}
        self._others: dict[str, ModuleType] = {}

    def __enter__(self) -> Self:
        self._others = self._taken()
        sys.modules.update(self._own)
        sys.path.insert(0, str(self.folder))
        importlib.invalidate_caches()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        sys.path.remove(str(self.folder))
        self._own = self._taken()
        sys.modules.update(self._others)

    def _taken(self) -> dict[str, ModuleType]:
        """All imported modules of the folder's names, which then are not imported any more."""
        return {name: sys.modules.pop(name) for name in list(sys.modules) if name.partition(".")[0] in self._names}
