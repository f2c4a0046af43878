"""Limits for the ``rosbags`` package, which takes the sizes that a recording claims for true."""

import resource
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache, partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from flowlab.errors import DataError
from flowlab.limits import MAX_CHUNK_BYTES, MAX_LOADED_BYTES, MAX_READER_BYTES, MAX_UNPACKING
from flowlab.untrusted import check_regular


@cache
def limit_decompression() -> None:
    """Have ``rosbags`` unpack chunks, messages and files up to a limit; it has none, and no way to give it one."""
    import bz2

    import lz4.frame
    from rosbags.rosbag1 import reader as reader1
    from rosbags.rosbag2 import reader as reader2
    from rosbags.rosbag2 import storage_mcap

    lz4_frame, zstd = lz4.frame.LZ4FrameDecompressor, reader2.zstd
    reader1.decompressors.update(bz2=partial(unpack, bz2.BZ2Decompressor), lz4=partial(unpack, lz4_frame))
    storage_mcap.DECOMPRESSORS.update(
        lz4=lambda content, size: unpack(lz4_frame, content, size),
        zstd=lambda content, size: unpack(zstd.ZstdDecompressor, content, size),
    )
    reader2.zstd = SimpleNamespace(
        open=lambda file, mode: _BoundedFile(zstd.open(file, mode), Path(file.name)),
        decompress=partial(unpack, zstd.ZstdDecompressor),
    )


def unpack(decompressor: Callable[[], Any], content: bytes, limit: int = MAX_CHUNK_BYTES) -> bytes:
    """Compressed bytes, unpacked.

    Args:
        decompressor: Makes a decompressor of the standard library's form.
        content: One compressed stream or more, one after the other.
        limit: Bytes that they may unpack to.

    Returns:
        The bytes.

    Raises:
        ValueError: They are more, or the content is cut short.
    """
    parts, left = [], min(limit, MAX_CHUNK_BYTES)
    while content:
        stream = decompressor()
        parts.append(stream.decompress(content, left + 1))
        left -= len(parts[-1])
        if left < 0:
            raise ValueError(f"unpacks to more than the {min(limit, MAX_CHUNK_BYTES):,} bytes that are expected")
        if not stream.eof:
            raise ValueError("its compressed bytes are cut short")
        content = stream.unused_data or b""
    return b"".join(parts)


class _BoundedFile:
    """A compressed file that is read up to a limit, and as far as there is room where it is unpacked to."""

    def __init__(self, file: Any, path: Path) -> None:
        size = check_regular(path, MAX_UNPACKING * MAX_LOADED_BYTES)
        room = shutil.disk_usage(tempfile.gettempdir()).free // 2
        self._file, self._path, self._left = file, path, min(room, max(MAX_LOADED_BYTES, MAX_UNPACKING * size))

    def __enter__(self) -> "_BoundedFile":
        return self

    def __exit__(self, *_: Any) -> None:
        self._file.close()

    def read(self, count: int) -> bytes:
        """The next bytes. Raises :class:`DataError` beyond the limit."""
        content: bytes = self._file.read(count)
        self._left -= len(content)
        if self._left < 0:
            raise DataError(f"{self._path}: unpacks to more than there is room for; unpack it, or set TMPDIR")
        return content


@contextmanager
def limited_memory(limit: int = MAX_READER_BYTES) -> Iterator[None]:
    """So much more memory and no more, as far as the system can tell: beyond it a :class:`MemoryError` is raised."""
    before = resource.getrlimit(resource.RLIMIT_AS)
    with suppress(OSError, ValueError):  # no Linux, or a lower limit from outside
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        allowed = used + limit if before[0] == resource.RLIM_INFINITY else min(before[0], used + limit)
        resource.setrlimit(resource.RLIMIT_AS, (allowed, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)
