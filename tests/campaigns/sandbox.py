"""Commands run in a forked child of a program that has imported everything: a trial takes a fraction of a second."""

import atexit
import ctypes
import faulthandler
import os
import pkgutil
import shutil
import signal
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

_COLD = ("flowlab.viz.recording", "flowlab.viz.blueprint", "flowlab.report.videos", "flowlab.__main__")
"""Modules that are imported by each trial itself: Rerun begins threads, and a fork would lose them."""
_WARM = ("metaworld", "matplotlib.figure", "matplotlib.style", "av", "numba.core.typing.templates", "torch._dynamo",
         "safetensors.torch", "tests.campaigns.engine")  # fmt: skip


@dataclass(frozen=True)
class Ended:
    """How a command ended."""

    code: int
    """Negative: the signal that killed it; :data:`HUNG` where time was up."""
    out: str
    err: str
    seconds: float
    operations: int = -1
    """File operations that were counted, where it ended by itself."""

    @property
    def traceback(self) -> bool:
        return "Traceback (most recent call last)" in self.err or self.code in (-signal.SIGSEGV, -signal.SIGABRT)

    @property
    def last_line(self) -> str:
        return (self.err.strip().splitlines() or [""])[-1][:300]


HUNG = -1000
CACHE = "user-cache"
"""Folder beside a trial's inputs that stands for the user's cache."""
_DIE_WITH_PARENT = 1


def warm_up() -> None:
    """Import all that commands need, here, where it is shared by all that are forked."""
    import flowlab

    for name in (*_WARM, *(m.name for m in pkgutil.walk_packages(flowlab.__path__, "flowlab."))):
        if name not in _COLD:
            import_module(name)
    import numba
    from PIL import Image

    Image.init()
    numba.njit(lambda x: x + 1)(1)  # which imports what compiles
    threads = len(os.listdir("/proc/self/task"))
    if threads > 1:
        raise RuntimeError(f"{threads} threads run, and a fork would lose them")


def call(
    arguments: Sequence[str | Path],
    folder: Path,
    *,
    before: Callable[[], None] = lambda: None,
    kill_after: float | None = None,
    limit: float = 120,
    environment: Mapping[str, str] | None = None,
) -> Ended:
    """``flowlab`` with these arguments, in a child of its own process group, with ``folder`` as its current one.

    Args:
        before: Called in the child, just before.
        kill_after: When to kill it [s].
        limit: When it counts as hung [s].
    """
    from tests.campaigns import faults

    logs = folder.parent / f"{folder.name}.log"
    shutil.rmtree(logs, ignore_errors=True)
    logs.mkdir()
    for name in ("out", "err", "stacks"):  # a kill may come before anything else
        (logs / name).touch()
    start = time.monotonic()
    child = os.fork()
    if child == 0:
        faulthandler.dump_traceback_later(0.95 * limit, file=os.open(logs / "stacks", os.O_WRONLY | os.O_CREAT))
        _run([str(a) for a in arguments], folder, logs, before, environment or {}, faults.seen)
    code = _wait(child, start, kill_after, limit)
    out, err, stacks = ((logs / name).read_text(errors="backslashreplace") for name in ("out", "err", "stacks"))
    if code == HUNG:
        err += f"{' '.join(map(str, arguments))} took more than {limit} s\n{stacks}"
    count = logs / "operations"
    operations = int(count.read_text()) if count.exists() else -1
    return Ended(code, out, err, time.monotonic() - start, operations)


def in_child(work: Callable[[], None]) -> None:
    """Do something in a child, which may begin threads."""
    child = os.fork()
    if child == 0:
        code = 1
        try:
            work()
            code = 0
        finally:
            os._exit(code)
    if os.waitpid(child, 0)[1]:
        raise RuntimeError("a child failed; see above")


def _run(
    arguments: list[str],
    folder: Path,
    logs: Path,
    before: Callable[[], None],
    environment: Mapping[str, str],
    seen: Callable[[], int],
) -> None:
    """The child: never returns."""
    code = 70
    try:
        os.setsid()
        ctypes.CDLL(None).prctl(_DIE_WITH_PARENT, signal.SIGKILL)
        for name, handle in (("out", 1), ("err", 2)):
            os.dup2(os.open(logs / name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644), handle)
        sys.stdout, sys.stderr = (os.fdopen(h, "w", buffering=1, encoding="utf-8", closefd=False) for h in (1, 2))
        os.chdir(folder)
        os.environ.update({"FLOWLAB_CACHE": str(folder / CACHE)} | dict(environment))
        from flowlab.cli import main

        try:
            before()
            main(*arguments)
            code = 0
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else int(end.code is not None)
        except BaseException:
            import traceback

            traceback.print_exc()
            code = 1
        atexit._run_exitfuncs()
        sys.stdout.flush()
        sys.stderr.flush()
        if os.environ.get("FLOWLAB_FAULTS"):
            (logs / "operations").write_text(str(seen()))
    finally:
        os._exit(code)


def _wait(child: int, start: float, kill_after: float | None, limit: float) -> int:
    """The child's exit code; a child that takes too long is killed with all that it started."""
    killed = False
    while True:
        pid, status = os.waitpid(child, os.WNOHANG)
        if pid:
            break
        spent = time.monotonic() - start
        if spent > limit or (kill_after is not None and spent > kill_after):
            killed = killed or spent > limit
            _kill_group(child)
        time.sleep(0.002)
    _kill_group(child)  # what it started and left
    return HUNG if killed else os.waitstatus_to_exitcode(status)


def _kill_group(leader: int) -> None:
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(leader, signal.SIGKILL)
