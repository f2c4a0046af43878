"""Keeping workers small."""

import ctypes


def return_freed_memory() -> None:
    """Give freed memory back to the system.

    glibc keeps the holes that a MuJoCo model leaves behind, so that a worker grows with every change of
    task, to more than 500 MB over all 50. Does nothing where the C library is another.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)
