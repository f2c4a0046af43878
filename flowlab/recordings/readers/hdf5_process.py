"""HDF5 files of strangers, opened in a process of their own: a file that makes the library hang or crash is refused.

The library trusts what files say of themselves: one wrong byte can make it loop without an end. So it never runs in
this process: another one does what :class:`~flowlab.recordings.readers.hdf5_file.HDF5File` can, is asked through a
pipe, and is ended when it does not answer.
"""

import importlib.util
import os
from functools import partial
from pathlib import Path
from typing import Any

from flowlab.errors import MissingLibraryError
from flowlab.recordings.readers.hdf5_array import HDF5Array
from flowlab.recordings.readers.helper_process import FileWords, answer_requests, ask_of_file
from flowlab.untrusted import check_regular

_ANY_SIZE = 1 << 60
_SERVE = "flowlab.recordings.readers.hdf5_process:serve"
_WORDS = FileWords("the HDF5 library", "copy it again, or mend it with 'h5repack OLD NEW' if that can read it")


class HDF5Access:
    """An HDF5 file, read by another process."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            there = importlib.util.find_spec("h5py") is not None
        except ValueError:  # of a module that somebody took out
            there = False
        if not there:
            raise MissingLibraryError(f"{path}: reading HDF5 needs the h5py package; 'pip install flowlab[hdf5]'")
        check_regular(path, _ANY_SIZE)
        self._changed = path.stat().st_mtime_ns

    def children(self, group: str) -> list[str]:
        """Names of what is in a group, in natural order; empty where there is no such group."""
        return list(self._ask("children", group))

    def matching(self, pattern: str) -> list[str]:
        """Groups that a pattern means, ``data/demo_*``, in natural order."""
        return list(self._ask("matching", pattern))

    def arrays(self, group: str) -> list[str]:
        """Names of all arrays below a group, from there on, in natural order."""
        return list(self._ask("arrays", group))

    def array(self, group: str, name: str) -> HDF5Array | None:
        """An array, checked but not read; None where there is none."""
        about = self._ask("about", group, name)
        if about is None:
            return None
        called, shape, dtype, holds = about
        return HDF5Array(called, shape, dtype, holds, partial(self._ask, "read", group, name))

    def value(self, group: str, source: str) -> Any:
        """Numbers or text, see :meth:`~flowlab.recordings.readers.hdf5_file.HDF5File.value`."""
        return self._ask("value", group, source)

    def _ask(self, what: str, *arguments: Any) -> Any:
        """The answer of the other process. Raises :class:`DataError` where it has none."""
        return ask_of_file(_SERVE, self.path, self._changed, what, arguments, words=_WORDS)


def serve() -> None:
    """Answer requests until there are no more: what the other process does."""
    answer_requests(_Server().answer)


class _Server:
    """What the other process has: the file that was asked for last."""

    def __init__(self) -> None:
        self._opened: _Opened | None = None

    def answer(self, request: tuple[str, str, tuple[Any, ...]]) -> Any:
        """What a file says."""
        path, what, arguments = request
        about = os.stat(path)
        state = path, about.st_mtime_ns, about.st_size, about.st_ino
        if self._opened is None or self._opened.state != state:
            if self._opened is not None:
                self._opened.file.close()  # else the library takes a file that was written anew for the old one
            self._opened = _Opened(state)
        return self._opened.answer(what, arguments)


class _Opened:
    """The file that was asked for last, as the other process has it."""

    def __init__(self, state: tuple[str, int, int, int]) -> None:
        from flowlab.recordings.readers.hdf5_file import HDF5File

        self.state, self.file = state, HDF5File(Path(state[0]))
        self._arrays: dict[tuple[str, str], HDF5Array | None] = {}
        self._matching: dict[str, list[str]] = {}
        """What patterns mean: each of ten thousand episodes asks for it."""

    def answer(self, what: str, arguments: tuple[Any, ...]) -> Any:
        """What the file says."""
        if what == "matching":
            (pattern,) = arguments
            if pattern not in self._matching:
                self._matching[pattern] = self.file.matching(pattern)
            return self._matching[pattern]
        if what not in ("about", "read"):
            return getattr(self.file, what)(*arguments)
        group, name, *row = arguments
        array = self._arrays.get((group, name)) or self.file.array(group, name)
        if what == "read":
            assert array is not None
            self._arrays[group, name] = array  # with its cache of chunks
            return array.read(row[0])
        return None if array is None else (array.name, array.shape, array.dtype, array.holds)
