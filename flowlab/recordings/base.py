"""What a reader is: it recognizes one layout of recordings, and gives its streams as they are."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from pathlib import Path
from typing import Any, ClassVar, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, Float64

from flowlab.config import SettingsError
from flowlab.errors import DataError, FlowlabError, UsageError, first_line
from flowlab.recordings.foreign import foreign_format
from flowlab.recordings.parts import place_of
from flowlab.recordings.recording_yaml import Metadata
from flowlab.recordings.stamps import IN_SECONDS, Timing, UnclearStamps
from flowlab.recordings.verdicts import Check
from flowlab.registry import READERS, Plugin
from flowlab.text import shown

_LOG = logging.getLogger(__name__)


class BadImage(Exception):
    """Raised for a picture that cannot be used; the message is the reason."""


@dataclass(frozen=True, slots=True)
class ImageStream:
    """A stream of pictures, not yet decoded, in the order in which the recording has them."""

    names: tuple[str, ...]
    """What errors call each: its file, say."""
    time_s: Float64[np.ndarray, "N"]
    """When each was taken, on the clock of the recording [s]; from a reader in the unit that ``timing`` says."""
    read: Callable[[int], np.ndarray]
    """Decodes one: uint8 (H, W, 3) RGB, or depth counts (H, W). Raises :class:`BadImage`."""
    timing: Timing = IN_SECONDS
    """What is known of the times."""

    def __len__(self) -> int:
        return len(self.names)


@dataclass(frozen=True, slots=True)
class SampleStream:
    """A stream of numbers, such as the robot's state, in the order in which the recording has them."""

    name: str
    time_s: Float64[np.ndarray, "N"]
    """On the clock of the pictures [s]; from a reader in the unit that ``timing`` says."""
    values: Float32[np.ndarray, "N D"] | Float64[np.ndarray, "N D"]
    timing: Timing = IN_SECONDS
    """What is known of the times."""
    columns: tuple[str, ...] = field(default=(), kw_only=True)
    """What each number is called; empty where that is not known."""


def channel_names(streams: Sequence[SampleStream]) -> list[str]:
    """What the numbers of streams side by side are called; nothing where that is not known of all."""
    named = bool(streams) and all(len(s.columns) == s.values.shape[1] for s in streams)
    return [name for s in streams for name in s.columns] if named else []


@dataclass(frozen=True, slots=True)
class Streams:
    """What a recording holds, as it was recorded."""

    color: ImageStream
    depth: ImageStream
    state: tuple[SampleStream, ...] = ()
    """Put side by side, in this order."""
    action: tuple[SampleStream, ...] = ()
    known: tuple[tuple[str, Metadata], ...] = ()
    """What the layout itself tells of calibration, and where it says so; the first wins."""
    registered: bool | None = None
    """Whether depth is seen from the color camera; None where the layout does not say."""
    checks: tuple[Check, ...] = ()
    """What the reader looked at, and what came of it."""
    used: tuple[str, ...] | None = None
    """The files and folders below a recording that it is made of; None where the reader does not say."""
    passed_over: tuple[tuple[str, str], ...] = ()
    """Patterns of files that the layout has and that are rightly not used, and why."""
    unread: tuple[str, ...] = ()
    """Keys of files that are used, as ``file:key``, which nothing reads; ``checks`` say so."""
    poses: SampleStream | None = None
    """Of a color camera that moves, see :func:`flowlab.recordings.poses.pose_stream`."""


@runtime_checkable
class Reader(Protocol):
    """Reads one layout of recordings. A reader has no settings: its class is called without arguments."""

    name: ClassVar[str]
    expects: ClassVar[str]
    """What a recording of this layout looks like, in a few words."""
    fallback: ClassVar[bool]
    """Whether recordings of other layouts may look like this one too, so that their readers win."""

    def probe(self, path: Path) -> bool:
        """Whether this is a recording of the layout; looks at names, hardly at content."""
        ...

    def read(self, path: Path, given: Metadata) -> Streams:
        """Find the streams of a recording; no picture is decoded yet.

        Args:
            path: The recording: a folder, a file, or a path that leads on into a file. Nothing outside it, or beside
                the file, is read.
            given: What the user says of the recording.

        Raises:
            DataError: The recording is damaged, or what it does not tell itself was not given.
        """
        ...


@runtime_checkable
class EpisodesReader(Reader, Protocol):
    """A reader of files or folders that may hold several recordings, each of which is read by a path of its own."""

    def episodes(self, path: Path, given: Metadata) -> Sequence[str]:
        """The recordings in a file or folder, as paths from there on; none where it is one itself.

        Args:
            path: The file or folder.
            given: What the user says of it.

        Raises:
            DataError: The file is damaged.
        """
        ...


@runtime_checkable
class DatasetReader(EpisodesReader, Protocol):
    """A reader of folders whose files hold many recordings, and that say of each what is done in it."""

    def files(self, path: Path) -> Sequence[Path]:
        """The files that a recording is made of, by which a change of it is noticed.

        Args:
            path: The recording.

        Raises:
            DataError: The folder is damaged.
        """
        ...

    def task(self, path: Path) -> str | None:
        """What is done in a recording, in words; None where nothing says so.

        Args:
            path: The recording.

        Raises:
            DataError: The folder is damaged.
        """
        ...


def read_streams(reader: Reader, path: Path, given: Metadata) -> Streams:
    """The streams of a recording, whatever its files hold: what a reader lets through becomes one sentence.

    Args:
        reader: What reads it.
        path: The recording.
        given: What the user says of it.

    Returns:
        The streams, whose pictures raise nothing but :class:`BadImage`.

    Raises:
        DataError: The recording is damaged, is none that the reader can read, or the reader gives no streams.
    """
    try:
        streams = reader.read(path, given)
    except SettingsError as error:  # of calibration that the recording itself holds
        raise DataError(f"{path}: {error}") from error
    except UnclearStamps as error:
        raise DataError(f"{path}: clock: {error}") from error
    except FlowlabError:
        raise
    except Exception as error:  # damaged files lead libraries, and readers of others, to raise anything
        raise DataError(f"{path}: the reader '{reader.name}' cannot read it ({_words(error)})") from error
    if not isinstance(streams, Streams):
        raise DataError(f"{path}: the reader '{reader.name}' gives {shown(streams)}, expected Streams")
    poses = () if streams.poses is None else (streams.poses,)
    every: tuple[Any, ...] = (streams.color, streams.depth, *streams.state, *streams.action, *poses)
    for stream in every:
        _check_stream(stream, f"{path}: the reader '{reader.name}'")
    return replace(streams, color=_guarded(streams.color), depth=_guarded(streams.depth))


def _check_stream(stream: ImageStream | SampleStream, who: str) -> None:
    """Refuse streams whose parts do not fit together."""
    if not isinstance(stream, ImageStream | SampleStream):
        raise DataError(f"{who} gives {shown(stream)}, expected a stream")
    time_s, name = stream.time_s, getattr(stream, "name", "pictures")
    count = len(stream.values) if isinstance(stream, SampleStream) else len(stream.names)
    if not isinstance(time_s, np.ndarray) or time_s.shape != (count,) or time_s.dtype.kind != "f":
        found = f"{time_s.dtype}{time_s.shape}" if isinstance(time_s, np.ndarray) else shown(time_s)
        raise DataError(f"{who} gives {found} as the times of {name}, expected {count} seconds")
    timing = stream.timing
    if not np.isfinite(time_s).all() and timing.recorded_s is None:
        raise DataError(f"{who} gives times of {name} that are not finite")
    if timing.recorded_s is not None and (
        timing.recorded_s.shape != (count,) or not np.isfinite(timing.recorded_s).all()
    ):
        raise DataError(f"{who} gives other than {count} finite times of recording of {name}")
    if isinstance(stream, SampleStream) and (stream.values.ndim != 2 or not np.isfinite(stream.values).all()):
        raise DataError(f"{who} gives rows of {name} that are no finite numbers (rows, numbers)")


def _guarded(stream: ImageStream) -> ImageStream:
    """The same pictures; whatever reading one raises is a :class:`BadImage`."""
    return replace(stream, read=partial(_read_guarded, stream.read))


def _read_guarded(read: Callable[[int], np.ndarray], index: int) -> np.ndarray:
    try:
        picture = read(index)
    except BadImage:
        raise
    except Exception as error:  # whatever decoders do
        raise BadImage(f"cannot be read ({_words(error)})") from error
    if not isinstance(picture, np.ndarray):
        raise BadImage(f"is read as {shown(picture)}, expected an array")
    return picture


def _words(error: Exception) -> str:
    """What an error says, and of which kind it is where that is not told by its words."""
    return str(error) if isinstance(error, FlowlabError) else f"{type(error).__name__}: {first_line(error)}"


def load_readers(name: str | None = None) -> tuple[Reader, ...]:
    """Every installed reader, in the order in which they are asked.

    A reader of another package that cannot be imported is left out, and a warning says so: the recordings of the
    other layouts can be read without it.

    Args:
        name: An import path ``module:Class`` of one more.

    Raises:
        UsageError: There is no reader at that import path.
    """
    readers = [reader for plugin in READERS.plugins().values() if (reader := _load_installed(plugin)) is not None]
    if name is not None and ":" in name:
        readers.append(READERS.load(name)())
    return tuple(sorted(readers, key=lambda r: (r.fallback, r.name)))


def choose_reader(path: Path, name: str | None = None) -> Reader:
    """The reader of a recording.

    Args:
        path: The recording.
        name: An installed reader or an import path ``module:Class``; else the one that recognizes the recording.

    Raises:
        UsageError: There is no such file or reader, or several readers recognize the recording.
        DataError: No reader recognizes it.
    """
    if name is not None:
        reader: Reader = READERS.load(name)()
        return reader
    if not place_of(path).exists():
        raise UsageError(f"{path}: there is no such file or folder")
    readers = load_readers()
    able = [r for r in readers if recognizes(r, path)]
    special = [r for r in able if not r.fallback]
    if len(special) > 1:
        names = " and ".join(r.name for r in special)
        raise UsageError(f"{path}: the readers {names} both recognize it; choose one with --reader or the setting "
                         "recording.reader")  # fmt: skip
    if not able:
        says = foreign_format(path) or f"not a recording flowlab knows; looked for {expected_layouts(readers)}"
        raise DataError(f"{path}: {says}")
    return able[0]


def recognizes(reader: Reader, path: Path) -> bool:
    """Whether a reader recognizes a recording; one that fails does not, and a warning says so."""
    try:
        return bool(reader.probe(path))
    except Exception as error:  # whatever somebody's package does, or a file that says nothing of itself
        _warn_once(f"reader '{reader.name}': fails on {path} ({first_line(error)}); it is not asked")
        return False


def expected_layouts(readers: tuple[Reader, ...]) -> str:
    """All layouts in one phrase, the general one first."""
    return "; ".join(f"{r.expects} ({r.name})" for r in sorted(readers, key=lambda r: not r.fallback))


def _load_installed(plugin: Plugin) -> Reader | None:
    """A reader; None where that of another package cannot be used, of which a warning is given."""
    try:
        reader: Reader = READERS.load(plugin.name)()
        return reader
    except UsageError as error:
        _warn_once(f"{error}; it is left out")
    except Exception as error:  # whatever somebody's class does
        if plugin.package.startswith("flowlab "):
            raise
        _warn_once(f"reader '{plugin.name}' of {plugin.package}: cannot be made ({first_line(error)}); it is left out")
    return None


@cache
def _warn_once(sentence: str) -> None:
    """Log a warning the first time."""
    _LOG.warning("flowlab: %s", sentence)
