"""The engine that runs work units on this machine."""

import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import contextmanager
from multiprocessing import forkserver
from multiprocessing.context import ForkServerContext, ForkServerProcess
from types import ModuleType
from typing import Any, Self

from pebble import ProcessExpired, ProcessPool

from flowlab.engines.base import WORKER_ENVIRONMENT, Engine, Receipt, Unit, UnitResult
from flowlab.errors import FlowlabError
from flowlab.files import is_running

_STARTING = threading.Lock()
"""The pool starts workers from threads of its own."""


@contextmanager
def _main_hidden() -> Iterator[None]:
    """Let multiprocessing find a program that has no file, so that a worker does not run that of the user again."""
    with _STARTING:
        main = sys.modules["__main__"]
        sys.modules["__main__"] = ModuleType("__main__")
        try:
            yield
        finally:
            sys.modules["__main__"] = main


@contextmanager
def _current_folder_hidden() -> Iterator[None]:
    """Python started anew would look for modules in the current folder first, whatever lies there."""
    before = os.environ.get("PYTHONSAFEPATH")
    os.environ["PYTHONSAFEPATH"] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ["PYTHONSAFEPATH"]
        else:
            os.environ["PYTHONSAFEPATH"] = before


class _Worker(ForkServerProcess):
    """A process that imports what it works with, and never the script that asked for it."""

    @staticmethod
    def _Popen(process_obj: Any) -> Any:
        with _main_hidden():
            return ForkServerProcess._Popen(process_obj)


class _OwnProgramContext(ForkServerContext):
    """Starts such workers: a script needs no ``if __name__ == "__main__"``."""

    Process = _Worker


class LocalEngine(Engine[Unit, Receipt]):
    """A pool of processes on this machine.

    A worker that dies loses its own unit only, which is tried once more in a fresh worker.
    """

    def __init__(self, work: Callable[[Unit], Receipt], *, workers: int, imports: Sequence[str] = ()) -> None:
        super().__init__(work, workers=workers, imports=imports)
        self._tries: dict[Future[Receipt], tuple[Unit, int]] = {}

    def __enter__(self) -> Self:
        for name in WORKER_ENVIRONMENT:
            os.environ.setdefault(name, "1")
        # Workers are forked from a clean process that has imported everything once, and share its memory.
        context = _OwnProgramContext()
        context.set_forkserver_preload([*self.imports])
        with _current_folder_hidden():
            forkserver.ensure_running()
        self._pool = ProcessPool(
            max_workers=self.workers, context=context, initializer=_start_worker, initargs=[os.getpid()]
        )
        return self

    def __exit__(self, *failure: object) -> None:
        self._pool.stop()
        self._pool.join()

    def submit(self, unit: Unit) -> None:
        """Start a unit as soon as a worker is free."""
        self._schedule(unit, tries=1)

    def next_result(self) -> UnitResult[Unit, Receipt]:
        """Wait for a unit to end."""
        while True:
            done, _ = wait(self._tries, return_when=FIRST_COMPLETED)
            future = done.pop()
            unit, tries = self._tries.pop(future)
            try:
                return UnitResult(unit, future.result())
            except ProcessExpired as death:
                if tries == 1:
                    self._schedule(unit, tries=2)
                    continue
                return UnitResult(unit, None, f"its worker died twice (exit code {death.exitcode})")
            except (FlowlabError, OSError):
                raise
            except Exception as error:
                return UnitResult(unit, None, "".join(traceback.format_exception(error)))

    def _schedule(self, unit: Unit, tries: int) -> None:
        self._tries[self._pool.schedule(self.work, args=[unit])] = unit, tries


def _start_worker(program: int) -> None:
    """Leave Ctrl-C to the program, and end with it, however it ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def watch() -> None:
        while is_running(program):
            time.sleep(1.0)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
