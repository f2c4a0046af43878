"""File operations that kill or fail: ``faults.c`` built, and this program begun anew with it."""

import ctypes
import errno
import os
import subprocess
import sys
import tempfile
from pathlib import Path

COUNT, KILL, TEAR, FAIL_ONCE, FAIL_ON = range(5)
"""What the n-th operation does: nothing; kill; write half and kill; fail; fail, and all after it too."""
ERRORS = {name: getattr(errno, name) for name in ("ENOSPC", "EROFS", "EIO", "EACCES")}
_SOURCE = Path(__file__).with_name("faults.c")


def begin_with_faults() -> None:
    """Have this program run with the counting of file operations, and one thread, from its beginning."""
    if os.environ.get("FLOWLAB_FAULTS"):
        return
    library = Path(tempfile.mkdtemp(prefix="flowlab-faults-")) / "faults.so"
    subprocess.run(["cc", "-O1", "-shared", "-fPIC", "-o", library, _SOURCE, "-ldl"], check=True)
    one_thread = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
    environment = os.environ | one_thread | {"FLOWLAB_FAULTS": str(library), "LD_PRELOAD": str(library)}
    module = sys.modules["__main__"].__spec__
    assert module is not None
    os.execve(sys.executable, [sys.executable, "-m", module.name, *sys.argv[1:]], environment)


def arm(folder: Path, how: int, nth: int = 0, number: int = 0) -> None:
    """Count operations below a folder from now on; the ``nth`` is struck."""
    ctypes.CDLL(None).faults_arm(os.fsencode(folder), how, ctypes.c_long(nth), number)


def seen() -> int:
    """Operations since then."""
    count = ctypes.CDLL(None).faults_seen
    count.restype = ctypes.c_long
    return int(count())
