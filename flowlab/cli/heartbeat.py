"""A sign of life: no command is silent for longer than half a minute, wherever its output goes."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import click

SILENT_S = 25.0
"""After so long without a word it is said that the command is at work."""
_QUIET = "flowlab.quiet"


class Heartbeat:
    """Remembers what was said last, and when."""

    def __init__(self) -> None:
        self.begin()

    def begin(self) -> None:
        """A command begins, and has said nothing yet."""
        self.began = self._last = time.monotonic()
        self._line = ""
        self.bars = 0
        """How many bars move on a terminal, which are sign enough."""

    def said(self, line: str) -> None:
        """Be told that the user was told."""
        self._last, self._line = time.monotonic(), line

    def due(self, now: float, command: str) -> str:
        """What to say now, if nothing has been for long; else nothing."""
        if self.bars or now - self._last < SILENT_S:
            return ""
        self._last = now
        return f"{command}: at work for {now - self.began:.0f} s" + (f"; {self._line}" if self._line else "")


PULSE = Heartbeat()
"""That of the command that runs; a process runs one."""


@contextmanager
def beating(context: click.Context, tell: Callable[[str], None]) -> Iterator[None]:
    """While it is open, long silences are broken, unless the command was asked to be quiet."""
    PULSE.begin()
    ended = threading.Event()

    def watch() -> None:
        while not ended.wait(min(1.0, SILENT_S / 5)):
            line = PULSE.due(time.monotonic(), f"flowlab {context.invoked_subcommand}")
            if line and not context.meta.get(_QUIET):
                tell(line)

    thread = threading.Thread(target=watch, name="heartbeat", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def be_quiet(context: click.Context | None = None) -> None:
    """Say nothing of how far the command is, until it ends."""
    (context or click.get_current_context()).meta[_QUIET] = True


def is_quiet() -> bool:
    """Whether the command was asked to say nothing of how far it is."""
    context = click.get_current_context(silent=True)
    return bool(context and context.meta.get(_QUIET))
