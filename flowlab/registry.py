"""What can be added to flowlab, by name: trackers, readers, stages, policies, exporters, engines, loggers.

A package offers its own under one of the entry-point groups below, as flowlab itself does; a class that no package
offers is named by its import path, ``module:Class``.
"""

import importlib
import importlib.util
import os
import sys
import sysconfig
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import ModuleType
from typing import Any, Generic, TypeVar

from flowlab.errors import UsageError, first_line, unknown_name
from flowlab.text import cut

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Plugin:
    """One thing that a package offers by name."""

    family: str
    """``trackers``, say."""
    name: str
    place: str
    """Import path, ``module:Class``."""
    package: str
    """Name and version of the package that offers it."""


class Registry(Generic[T]):
    """One family of things that packages can add to."""

    def __init__(self, family: str, kind: str, base: str) -> None:
        self.family, self.kind = family, kind
        self.group = f"flowlab.{family}"
        """Entry-point group in which packages offer their own."""
        self._base = base

    def offers(self) -> tuple[Plugin, ...]:
        """Everything that is installed, one name possibly several times; nothing is imported."""
        return _offered(self.family, self.group, tuple(sys.path))

    def plugins(self) -> dict[str, Plugin]:
        """Everything that is installed, by name; nothing is imported."""
        return {plugin.name: plugin for plugin in self.offers()}

    def problem(self, plugin: Plugin) -> str:
        """Why a plug-in cannot be used, in a sentence; empty where it can. It is imported for that."""
        try:
            self.load(plugin.name)
        except UsageError as error:
            return str(error)
        except (Exception, SystemExit) as error:  # whatever its module does
            return f"{self.kind} '{plugin.name}' of {plugin.package}: cannot be imported ({first_line(error)})"
        return ""

    def load(self, name: str, folder: Path | None = None) -> type[T]:
        """The class of that name, or at that import path ``module:Class``; see :func:`names_from_file`, too.

        Args:
            name: An installed name, with hyphens or underscores, or an import path.
            folder: Where modules of an import path may lie beside what is installed: it is looked at last, and for
                this import only. Give it only where the user has named the path; never for names read from a file
                that somebody else may have made.

        Raises:
            UsageError: The name does not exist, two packages offer it, it cannot be imported, or it is not of this
                family. The message names what exists.
        """
        loaded = self._from_path(name, folder) if ":" in name else self._from_entry(name)
        base = getattr(importlib.import_module(self._base.partition(":")[0]), self._base.partition(":")[2])
        if not (isinstance(loaded, type) and _is_a(loaded, base)):
            raise UsageError(f"{self.kind} '{name}': is not a subclass of {base.__module__}.{base.__qualname__}")
        return loaded

    def _where(self, error: BaseException, folder: Path | None) -> str:
        """Where a module that was not found may lie, to be added to an error; empty where another thing went wrong."""
        if not isinstance(error, ModuleNotFoundError):
            return ""
        beside = {"stages": ", or its file beside the recipe that names it"}.get(self.family, "")
        looked = f" (looked in {folder.resolve()}, too)" if folder is not None else ""
        return f"; install what has this {self.kind}, or put its module's folder on PYTHONPATH{beside}{looked}"

    def _entries(self) -> list[EntryPoint]:
        return list(_installed(self.group, tuple(sys.path)))

    def _from_entry(self, name: str) -> Any:
        found = [e for e in self._entries() if e.name == name.replace("_", "-")]
        if not found:
            raise unknown_name(self.kind, name, [e.name for e in self._entries()])
        if len({e.value for e in found}) > 1:
            packages = " and ".join(sorted(_package(e) for e in found))
            raise UsageError(f"{self.kind} '{name}': is offered by {packages}; uninstall one of them")
        try:
            return found[0].load()
        except (Exception, SystemExit) as error:  # whatever somebody's package does
            if _package(found[0]).startswith("flowlab "):
                raise
            raise UsageError(
                f"{self.kind} '{name}' of {_package(found[0])}: cannot be imported ({first_line(error)})"
            ) from error

    def _from_path(self, place: str, folder: Path | None) -> Any:
        module, _, attribute = place.partition(":")
        package = module.partition(".")[0]
        _forget_others(package, folder)
        with _looked_at_last(folder):
            if not _may_import(place, module, folder):
                raise UsageError(
                    f"{self.kind} '{cut(place)}': is named by a file, which may be a stranger's, so it is not imported "
                    f"from what is installed; where you trust it, put the folder of its module on PYTHONPATH, or offer "
                    f"it under the entry points {self.group}"
                )
            try:
                imported = importlib.import_module(module)
                _remember(package, imported, folder)
                return getattr(imported, attribute)
            except (Exception, SystemExit) as error:  # whatever somebody's module does
                raise UsageError(
                    f"{self.kind} '{place}': cannot be imported ({first_line(error)}){self._where(error, folder)}"
                ) from error


TRACKERS: Registry[Any] = Registry("trackers", "tracker", "flowlab.tracking.base:Tracker")
READERS: Registry[Any] = Registry("readers", "reader", "flowlab.recordings.base:Reader")
STAGES: Registry[Any] = Registry("stages", "stage", "flowlab.pipeline.stage:Stage")
POLICIES: Registry[Any] = Registry("policies", "policy", "flowlab.policies.base:PolicyNetwork")
EXPORTERS: Registry[Any] = Registry("exporters", "exporter", "flowlab.storage.exporters.base:Exporter")
ENGINES: Registry[Any] = Registry("engines", "engine", "flowlab.engines.base:Engine")
LOGGERS: Registry[Any] = Registry("loggers", "logger", "flowlab.training.loggers:MetricsLogger")
REGISTRIES = (TRACKERS, READERS, STAGES, POLICIES, EXPORTERS, ENGINES, LOGGERS)


_named_by_user: ContextVar[Collection[str] | None] = ContextVar("_named_by_user", default=None)
"""What the user has typed, where other names are those of a file; None where all are the user's."""


@contextmanager
def names_from_file(but: Collection[str] = ()) -> Iterator[None]:
    """Within it, import paths are taken to come from a file that somebody else may have written.

    Then a module is imported only if the user has put its folder on ``PYTHONPATH``, or it lies in the folder that is
    given with the name; what is imported already is taken as it is. Nothing else that is installed runs for its name.

    Args:
        but: Import paths that the user has typed beside the file.
    """
    before = _named_by_user.set(but)
    try:
        yield
    finally:
        _named_by_user.reset(before)


def _may_import(place: str, module: str, folder: Path | None) -> bool:
    """Whether a module may be imported for that name."""
    named, top = _named_by_user.get(), module.partition(".")[0]
    if named is None or place in named or module in sys.modules or top == "flowlab":
        return True
    try:
        spec = importlib.util.find_spec(top)
    except (ImportError, ValueError):  # a name that is none, say: importing it tells what is wrong
        return True
    if spec is None:
        return True
    files = [spec.origin] if spec.has_location and spec.origin else list(spec.submodule_search_locations or ())
    depth = 1 if spec.has_location and spec.submodule_search_locations else 0  # of a package it is its __init__
    own = {p.resolve() for p in (*_on_pythonpath(), *([] if folder is None else [folder]))}
    return bool(files) and all(Path(f).resolve().parents[depth] in own for f in files)


def _on_pythonpath() -> list[Path]:
    """Folders that the user has named, but for those of Python and of installed packages."""
    installed = {Path(p).resolve() for p in sysconfig.get_paths().values()}
    folders = [Path(p) for p in os.environ.get("PYTHONPATH", "").split(os.pathsep) if p]
    return [p for p in folders if p.resolve() not in installed and p.name not in ("site-packages", "dist-packages")]


def registry_of(family: str) -> Registry[Any]:
    """The registry of a family, such as ``trackers``. Raises :class:`UsageError` with the names of all."""
    known = {registry.family: registry for registry in REGISTRIES}
    if family not in known:
        raise unknown_name("family of plug-ins", family, known)
    return known[family]


@cache
def _installed(group: str, path: tuple[str, ...]) -> tuple[EntryPoint, ...]:
    """What packages offer in a group, by name. Looking through all that is installed takes 50 ms."""
    return tuple(sorted(entry_points(group=group), key=lambda e: e.name))


@cache
def _offered(family: str, group: str, path: tuple[str, ...]) -> tuple[Plugin, ...]:
    return tuple(Plugin(family, e.name, e.value, _package(e)) for e in _installed(group, path))


def _is_a(cls: type, base: type) -> bool:
    """Whether a class is of a family; where that is told by a protocol, whether it has what the protocol asks for."""
    if getattr(base, "_is_protocol", False):
        return all(hasattr(cls, name) for name in _members(base))
    return issubclass(cls, base)


def _members(protocol: type) -> list[str]:
    names = {*protocol.__dict__, *getattr(protocol, "__annotations__", ())}
    return sorted(n for n in names if not n.startswith("_"))


def _package(entry: EntryPoint) -> str:
    return f"{entry.dist.name} {entry.dist.version}" if entry.dist else "an unknown package"


_lent: dict[str, Path] = {}
"""Folder that a module or package was imported from because it was lent for that, by its name."""


def _forget_others(name: str, folder: Path | None) -> None:
    """Forget a package's modules that another folder lent: nobody may get those of somebody else."""
    if folder is not None and _lent.get(name, folder.resolve()) != folder.resolve():
        del _lent[name]
        for module in [m for m in sys.modules if m == name or m.startswith(f"{name}.")]:
            del sys.modules[module]


def _remember(name: str, module: ModuleType, folder: Path | None) -> None:
    """Remember that a package's module is from a folder, where it is."""
    if folder is not None and Path(module.__file__ or "").resolve().is_relative_to(folder.resolve()):
        _lent[name] = folder.resolve()


@contextmanager
def _looked_at_last(folder: Path | None) -> Iterator[None]:
    """A folder at the end of the module search path."""
    if folder is None:
        yield
        return
    place = str(folder.resolve())
    sys.path.append(place)
    importlib.invalidate_caches()
    try:
        yield
    finally:
        if place in sys.path:
            sys.path.reverse()
            sys.path.remove(place)  # the one appended
            sys.path.reverse()
