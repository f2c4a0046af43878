"""Parquet and MP4 files of LeRobot datasets, read by another process: one that makes a library crash is refused."""

import resource
from functools import partial
from pathlib import Path
from typing import Any

from flowlab.errors import DataError, MissingFileError
from flowlab.limits import MAX_ARRAY_BYTES, MAX_HELPER_BYTES
from flowlab.recordings.readers.helper_process import FileWords, answer_requests, ask_of_file
from flowlab.untrusted import check_regular, read_bytes

_SERVE = "flowlab.recordings.readers.lerobot_process:serve"
_WORDS = FileWords("the library that reads it", "copy it again")
_POINTER = b"version https://git-lfs"


def ask(path: Path, what: str, *arguments: Any) -> Any:
    """What the other process says of a file.

    Args:
        path: A Parquet or MP4 file.
        what: ``rows``, ``count``, ``columns``, ``texts`` or ``picture`` of :mod:`.lerobot_tables`, ``film`` or
            ``frame`` of :mod:`.lerobot_video`.
        arguments: Of that function.

    Raises:
        DataError: The file is not there, is damaged, or holds something else.
    """
    try:
        size = check_regular(path, MAX_ARRAY_BYTES)
    except MissingFileError as error:
        raise MissingFileError(
            f"{path}: there is no such file, and the dataset says so; copy the dataset again"
        ) from error
    if size < 1024 and read_bytes(path).startswith(_POINTER):
        raise DataError(f"{path}: is a pointer of Git LFS, not the file itself; get it with 'git lfs pull'")
    return ask_of_file(_SERVE, path, path.stat().st_mtime_ns, what, arguments, words=_WORDS)


def decode_tiff(path: Path, content: bytes) -> Any:
    """The picture of a TIFF that was embedded in a file. Raises :class:`DataError`."""
    return ask_of_file(_SERVE, path, path.stat().st_mtime_ns, "tiff", (content,), words=_WORDS)


def serve() -> None:
    """Answer requests until there are no more: what the other process does."""
    resource.setrlimit(resource.RLIMIT_DATA, (MAX_HELPER_BYTES, MAX_HELPER_BYTES))
    answer_requests(partial(_answer, {}))


def _answer(known: dict[str, Any], request: tuple[str, str, tuple[Any, ...]]) -> Any:
    """What a file says."""
    path, what, arguments = request
    if what == "tiff":
        from flowlab.recordings.readers.lerobot_tables import tiff

        return tiff(*arguments)
    if what in ("film", "frame"):
        from flowlab.recordings.readers.lerobot_video import VideoFiles

        files = known.setdefault("videos", VideoFiles())
    else:
        from flowlab.recordings.readers.lerobot_tables import ParquetTables

        files = known.setdefault("tables", ParquetTables())
    return getattr(files, what)(path, *arguments)
