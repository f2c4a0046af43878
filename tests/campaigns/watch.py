"""What a program does beside its work: files written outside its folder, programs started, code of others run."""

import os
import sys
from pathlib import Path
from typing import Any

_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
_CHANGES = {
    "os.remove", "os.rename", "os.rmdir", "os.mkdir", "os.symlink", "os.link", "os.truncate", "os.chmod", "os.chown",
    "shutil.rmtree", "shutil.move", "shutil.copyfile",
}  # fmt: skip
_STARTS = {
    "subprocess.Popen", "os.exec", "os.system", "os.posix_spawn", "os.fork", "os.forkpty", "pty.spawn",
    "socket.connect", "ctypes.dlopen",
}  # fmt: skip
_HARMLESS = ("/dev/null", "/dev/tty", "/proc/self/", "/dev/shm/")


class Watch:
    """Notes what happens outside a folder, from when it is armed on; there is no way to take it off again."""

    def __init__(self, inside: Path) -> None:
        self.inside = str(inside)
        self.armed = False
        self.seen: list[str] = []
        """What was done, in words."""
        sys.addaudithook(self._note)

    def _note(self, event: str, arguments: tuple[Any, ...]) -> None:
        if not self.armed:
            return
        if event == "open":
            path, _, flags = arguments
            if isinstance(flags, int) and flags & _WRITING and not self._is_inside(path):
                self._add(f"wrote {path}")
        elif event in _CHANGES:
            for path in arguments[:2]:
                if isinstance(path, str | bytes | os.PathLike) and not self._is_inside(path):
                    self._add(f"{event} {path}")
        elif event in _STARTS and not (event == "ctypes.dlopen" and _is_installed(arguments[0])):
            self._add(f"{event} {str(arguments)[:200]}")
        elif event == "exec" and str(getattr(arguments[0], "co_filename", "")).startswith(self.inside):
            self._add(f"ran {arguments[0].co_filename}")

    def _is_inside(self, path: Any) -> bool:
        name = os.path.abspath(os.fsdecode(path)) if isinstance(path, str | bytes | os.PathLike) else ""
        return not name or name.startswith((self.inside, *_HARMLESS)) or "__pycache__" in name

    def _add(self, what: str) -> None:
        self.armed = False  # what is noted must not be noted itself
        self.seen.append(what)
        self.armed = True


def _is_installed(library: Any) -> bool:
    """Whether a library is the program itself, or one of the packages'."""
    return library is None or "site-packages" in str(library)
