"""What a recording is known by: its content, wherever it lies and whatever it is called.

The identity is a text of two parts with a ``/`` between them: a digest of the files of the recording, and a digest of
what is said of it (``recording.yaml`` and the calibration file as they are understood, and the reader). Small files are
digested whole, of larger ones parts that are evenly spread: no two pictures of a sensor have the same noise, and those
that are compressed end in a checksum. Numbers in HDF5, Parquet and NumPy's files can change without a change of size,
so these are digested whole. Times of files are not part of it, for copies have others.
"""

import hashlib
import json
import time
from collections.abc import Iterable, Iterator
from functools import lru_cache
from itertools import pairwise
from pathlib import Path

from flowlab.errors import DataError
from flowlab.recordings.base import DatasetReader, choose_reader
from flowlab.recordings.folder_files import FoundFile, files_below
from flowlab.recordings.image_files import COLOR_SUFFIXES, DEPTH_SUFFIXES
from flowlab.recordings.parsing import RecordingSettings, known_beforehand
from flowlab.recordings.parts import place_of, split_path
from flowlab.recordings.readers.hdf5_file import is_hdf5
from flowlab.recordings.recording_yaml import FILE_NAME

_PART = 4096
"""Bytes of each part of a large file."""
_WHOLE = {True: 1 << 15, False: 1 << 22}
"""Bytes up to which a file is digested whole, by whether it is a picture."""
_TABLES = (".npy", ".npz", ".parquet")
"""Numbers, which somebody may put right without changing the size of the file."""
_PARTS = 64
"""Most parts of a file; a picture has three."""
_QUIET = 5
"""A recording is being written until this many times the usual pause between its last files has passed."""
_QUIET_S = (0.2, 3.0)
"""At least and at most so long [s]."""


def identity(path: Path, settings: RecordingSettings) -> str:
    """What a recording is known by.

    Args:
        path: The recording, a folder or a file.
        settings: How it is read; of these only the reader and the content of the calibration file count.

    Returns:
        A text of two digests: of its files, and of what is said of it.

    Raises:
        DataError: A file of it cannot be read.
    """
    reader = choose_reader(path, settings.reader)
    files = [*_found(reader.files(path))] if isinstance(reader, DatasetReader) else None
    return f"{_digest_files(path, files)}/{_digest_said(path, reader.name, settings)}"


def difference(old: str, new: str) -> str:
    """In what two identities of a recording differ, in words."""
    (files, said), (files_now, said_now) = (text.partition("/")[::2] for text in (old, new))
    parts = ["its files"] * (files != files_now) + [f"{FILE_NAME} or its calibration"] * (said != said_now)
    return " and ".join(parts)


def changed_since(content: str, path: Path, settings: RecordingSettings) -> str:
    """What of a recording has changed since it was known by ``content``, after its path; empty where nothing has.

    Raises:
        DataError: A file of it cannot be read.
    """
    what = difference(content, identity(path, settings))
    return f"{path}: {what}" if what else ""


def wait_until_quiet(path: Path) -> None:
    """Return when nothing has been written into a recording for a while, or when it is clear that this lasts.

    Args:
        path: The recording.
    """
    times = sorted(f.changed_s for f in files_below(place_of(path)))[-5:]
    if not times:
        return
    pauses = [b - a for a, b in pairwise(times)] or [0.0]
    quiet = min(max(_QUIET * max(pauses), _QUIET_S[0]), _QUIET_S[1])
    age = max(time.time() - times[-1], 0.0)  # of a server whose clock is ahead: as if it were from now
    if age < quiet:
        time.sleep(quiet - age)


def _found(files: Iterable[Path]) -> Iterator[FoundFile]:
    """Files that are there."""
    for file in files:
        yield from files_below(file)


def _digest_files(path: Path, files: Iterable[FoundFile] | None) -> str:
    """Of every file but those that say something of the recording, which count as they are understood.

    Args:
        path: The recording.
        files: Those that it is made of, where its reader says so; else all that are in its folder.
    """
    digest = hashlib.blake2b(digest_size=16)
    path, inside = split_path(path)
    digest.update(inside.encode("utf-8", "replace"))
    for file in files_below(path) if files is None else files:
        if file.name == FILE_NAME:
            continue
        digest.update(f"{file.name if path.is_dir() else file.path.suffix}\0{file.size}\0".encode("utf-8", "replace"))
        for part in _parts(file):
            digest.update(part)
    return digest.hexdigest()


def _parts(file: FoundFile) -> Iterator[bytes]:
    """What of a file is digested."""
    suffix = file.path.suffix.lower()
    if (file.size > _WHOLE[False] and suffix in _TABLES) or is_hdf5(file.path):
        about = file.path.stat()
        yield _whole(file.path, about.st_size, about.st_mtime_ns, about.st_ino)
        return
    picture = suffix in {*COLOR_SUFFIXES, *DEPTH_SUFFIXES} - {*_TABLES}
    try:
        with file.path.open("rb", buffering=0) as opened:
            if file.size <= _WHOLE[picture]:
                yield opened.read()
                return
            count = 3 if picture else _PARTS
            for k in range(count):
                opened.seek((file.size - _PART) * k // (count - 1))
                yield opened.read(_PART)
    except OSError as error:
        raise DataError(f"{file.path}: cannot be read ({error.strerror or error})") from error


@lru_cache(maxsize=64)
def _whole(path: Path, *state: int) -> bytes:
    """A digest of all of a file as it is now: one for all the episodes in it."""
    try:
        with path.open("rb") as opened:
            return hashlib.file_digest(opened, lambda: hashlib.blake2b(digest_size=16)).digest()
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror or error})") from error


def _digest_said(path: Path, reader: str, settings: RecordingSettings) -> str:
    """Of what the user says of a recording, but for its task, by which the dataset knows it anyway."""
    said = known_beforehand(path, settings).model_dump(mode="json", exclude_defaults=True, exclude={"task"})
    text = json.dumps([reader, said], sort_keys=True)
    return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()
