"""The engine that runs work units on the machines of a Ray cluster."""

import logging
import os
import socket
import traceback
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, Generic, Self

from flowlab.engines.base import WORKER_ENVIRONMENT, Engine, Receipt, Unit, UnitResult
from flowlab.errors import FlowlabError, MissingLibraryError, UsageError, first_line
from flowlab.version import __version__

_CLIENT = "ray://"
"""Begins the address of a server of Ray Client, which warns of any setting but its own two."""
_OWN_WORDS = {"log_to_driver": False, "logging_level": "ERROR"}


class RayEngine(Engine[Unit, Receipt]):
    """Tasks of a Ray cluster that already runs: that of ``RAY_ADDRESS``, else the one this machine belongs to.

    A worker or a machine that dies loses its own units only, each of which is tried once more elsewhere. All machines
    have the same flowlab, and see the folder this program runs in, and that of the dataset, at the same paths.
    """

    def __init__(self, work: Callable[[Unit], Receipt], *, workers: int, imports: Sequence[str] = ()) -> None:
        super().__init__(work, workers=workers, imports=imports)
        self._waiting: deque[Unit] = deque()
        self._running: dict[Any, Unit] = {}

    @classmethod
    def default_workers(cls) -> int:
        """One for each core of the cluster."""
        return max(1, int(_connected().cluster_resources().get("CPU", 1)))

    def __enter__(self) -> Self:
        self._ray = _connected()
        task = self._ray.remote(num_cpus=1, max_retries=1, scheduling_strategy="SPREAD")
        self._run = task(_run_unit).options(runtime_env={"env_vars": dict.fromkeys(WORKER_ENVIRONMENT, "1")})
        self._setting = _Setting(__version__, Path.cwd(), self.imports)
        self._work = self._ray.put(self.work)
        return self

    def __exit__(self, *failure: object) -> None:
        for task in self._running:
            self._ray.cancel(task, force=True)

    def submit(self, unit: Unit) -> None:
        """Start a unit, or let it wait here: the cluster is never handed more than run at a time."""
        self._waiting.append(unit)
        self._start()

    def next_result(self) -> UnitResult[Unit, Receipt]:
        """Wait for a unit to end."""
        done, _ = self._ray.wait(list(self._running), num_returns=1)
        unit = self._running.pop(done[0])
        self._start()
        try:
            ended: _Ended[Receipt] = self._ray.get(done[0])
        except self._ray.exceptions.RayError as error:
            return UnitResult(unit, None, f"its worker died twice, or could not start ({first_line(error)})")
        if ended.fatal is not None:
            raise ended.fatal
        return UnitResult(unit, ended.receipt, ended.failure)

    def _start(self) -> None:
        while self._waiting and len(self._running) < self.workers:
            unit = self._waiting.popleft()
            self._running[self._run.remote(self._setting, self._work, unit)] = unit


@dataclass(frozen=True, slots=True)
class _Setting:
    """What a worker must have in common with the program that asks it."""

    version: str
    folder: Path
    imports: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class _Ended(Generic[Receipt]):
    """How a unit ended in a worker that lived: with a receipt, a failure of its own, or an error that ends the run."""

    receipt: Receipt | None = None
    failure: str = ""
    fatal: Exception | None = None


def _run_unit(setting: _Setting, work: Callable[[Unit], Receipt], unit: Unit) -> _Ended[Receipt]:
    """Do a unit in a worker."""
    try:
        _take_place(setting)
        return _Ended(work(unit))
    except (FlowlabError, OSError) as error:
        return _Ended(fatal=error)
    except Exception:
        return _Ended(failure=traceback.format_exc())


def _take_place(setting: _Setting) -> None:
    """Work where the program works. Raises :class:`FlowlabError` where this machine is not set up like that one."""
    if setting.version != __version__:
        raise FlowlabError(
            f"the machine {os.uname().nodename} has flowlab {__version__}, expected {setting.version} as here; "
            f"install the same on every machine of the cluster"
        )
    try:
        os.chdir(setting.folder)
    except OSError as error:
        raise FlowlabError(
            f"the machine {os.uname().nodename} has no folder {setting.folder} ({error.strerror}); run from a folder "
            f"that all machines of the cluster share"
        ) from error
    for module in setting.imports:
        import_module(module)


def _connected() -> Any:
    """The library, connected to a cluster.

    Raises:
        MissingLibraryError: It is not installed.
        UsageError: No cluster runs.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        ray: Any = import_module("ray")
    except ImportError as error:
        raise MissingLibraryError(
            f"--engine ray needs a library: pip install 'flowlab[ray]' ({first_line(error)})"
        ) from error
    if ray.is_initialized():
        return ray
    address = os.environ.get("RAY_ADDRESS", "auto")
    try:
        _check_reachable(address)
        logging.getLogger("ray").setLevel(logging.ERROR)
        ray.init(address=address, **({} if address.startswith(_CLIENT) else _OWN_WORDS))
    except (OSError, RuntimeError, ValueError) as error:
        raise UsageError(
            f"--engine ray finds no Ray cluster at {address!r} ({first_line(error)}); start one with "
            f"`ray start --head` here and `ray start --address=HOST:6379` on the other machines, or set RAY_ADDRESS"
        ) from error
    return ray


def _check_reachable(address: str) -> None:
    """Raise :class:`OSError` where nobody listens at HOST:PORT: Ray itself would try for minutes."""
    host, _, port = address.removeprefix(_CLIENT).rpartition(":")
    if host and port.isdigit() and "/" not in host:
        socket.create_connection((host, int(port)), timeout=5).close()
