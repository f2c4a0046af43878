"""A process of its own for libraries that trust what files say of themselves: one that hangs or crashes is ended."""

import os
import pickle
import select
import subprocess
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flowlab.errors import DataError

PATIENCE_S = 60.0
"""An answer takes milliseconds, that of a long list seconds [s]."""


@dataclass(frozen=True, slots=True)
class FileWords:
    """What errors say of files that a library cannot read."""

    library: str
    mend: str


class NoAnswerError(Exception):
    """Raised where the other process hangs or dies; the message says which."""


class HelperProcess:
    """Another process, which answers requests through a pipe until it does not."""

    def __init__(self, serve: str) -> None:
        env = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path)), "HDF5_PLUGIN_PRELOAD": "::"}
        module, _, function = serve.partition(":")
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-c", f"from {module} import {function}; {function}()"],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=env,
        )  # fmt: skip
        self._owner, self._lock = os.getpid(), threading.Lock()

    @property
    def is_mine(self) -> bool:
        """Whether it lives, and answers to this process and no copy of it."""
        return self._owner == os.getpid() and self._process.poll() is None

    def ask(self, request: Any) -> tuple[bool, Any]:
        """Whether there is an answer, and that or what is wrong. Raises :class:`NoAnswerError`."""
        with self._lock:
            given, told = self._process.stdin, self._process.stdout
            assert given is not None
            assert told is not None
            try:
                pickle.dump(request, given)
                given.flush()
                if select.select([told], [], [], PATIENCE_S)[0]:
                    answer: tuple[bool, Any] = pickle.load(told)
                    return answer
                how = f"does not come to an end in {PATIENCE_S:.0f} s"
            except (OSError, EOFError, pickle.UnpicklingError):
                how = "crashes"
            self._process.kill()
            self._process.wait()
        raise NoAnswerError(how)


HELPERS: dict[str, HelperProcess] = {}
"""Those of this process, by the function that answers in them."""


def helper_process(serve: str) -> HelperProcess:
    """The one of this process, started when it is first needed, and again when it had to be ended.

    Args:
        serve: ``module:function``, which answers requests with :func:`answer_requests`.
    """
    if not (serve in HELPERS and HELPERS[serve].is_mine):
        HELPERS[serve] = HelperProcess(serve)
    return HELPERS[serve]


_REFUSED: dict[tuple[str, int], str] = {}
"""Files on which a library hangs or crashes, by path and time of change: none is waited for twice."""


def ask_of_file(
    serve: str, path: Path, changed: int, what: str, arguments: tuple[Any, ...], *, words: FileWords
) -> Any:
    """What the other process says of a file.

    Args:
        serve: As for :func:`helper_process`.
        path: The file.
        changed: When it was last written [ns].
        what: Which question; it is asked as ``(absolute path, what, arguments)``.
        arguments: Of the question.
        words: For the sentence where there is no answer.

    Raises:
        DataError: The other process says what is wrong, or has no answer.
    """
    place = str(path.absolute())
    if (place, changed) not in _REFUSED:
        try:
            found, value = helper_process(serve).ask((place, what, arguments))
        except NoAnswerError as error:
            _REFUSED[place, changed] = str(error)
        else:
            if found:
                return value
            raise DataError(value.replace(place, str(path)))
    how = _REFUSED[place, changed]
    raise DataError(f"{path}: {words.library} {how} on it, so it is damaged or made to do that; {words.mend}")


def answer_requests(answer: Callable[[Any], Any]) -> None:
    """Answer requests until there are no more: what the other process does.

    Args:
        answer: Of a request; what it raises is told as what is wrong.
    """
    while True:
        try:
            request = pickle.load(sys.stdin.buffer)
        except EOFError:
            return
        try:
            reply = True, answer(request)
        except Exception as error:
            reply = False, str(error)
        pickle.dump(reply, sys.stdout.buffer, protocol=5)
        sys.stdout.buffer.flush()
