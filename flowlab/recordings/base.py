"""What a reader is: it recognizes one layout of recordings, and gives its streams as they are."""

from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import ClassVar, Protocol

import numpy as np
from jaxtyping import Float32, Float64

from flowlab.errors import DataError, UsageError, unknown_name
from flowlab.recordings.metadata import Metadata

GROUP = "flowlab.readers"
"""Entry-point group in which a package offers readers of its own."""


class BadImage(Exception):
    """Raised for a picture that cannot be used; the message is the reason."""


@dataclass(frozen=True, slots=True)
class ImageStream:
    """A stream of pictures, not yet decoded, in the order of time."""

    names: tuple[str, ...]
    """What errors call each: its file, say."""
    time_s: Float64[np.ndarray, "N"]
    """When each was taken, on the clock of the recording [s]."""
    read: Callable[[int], np.ndarray]
    """Decodes one: uint8 (H, W, 3) RGB, or depth counts (H, W). Raises :class:`BadImage`."""

    def __len__(self) -> int:
        return len(self.names)


@dataclass(frozen=True, slots=True)
class SampleStream:
    """A stream of numbers, such as the robot's state, in the order of time."""

    name: str
    time_s: Float64[np.ndarray, "N"]
    """On the clock of the pictures [s]."""
    values: Float32[np.ndarray, "N D"]


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
    notes: tuple[str, ...] = ()
    """What a user should know, a sentence each."""


class Reader(Protocol):
    """Reads one layout."""

    name: ClassVar[str]
    looks_for: ClassVar[str]
    """What a recording of this layout looks like, in a few words."""
    general: ClassVar[bool]
    """Whether other layouts may look like this one too, so that they are asked first."""

    def probe(self, path: Path) -> bool:
        """Whether this is a recording of the layout; looks at names, hardly at content."""
        ...

    def read(self, path: Path, given: Metadata) -> Streams:
        """The streams. ``given`` is what the user says of the recording. Raises :class:`DataError`."""
        ...


def load_readers() -> tuple[Reader, ...]:
    """Every installed reader, in the order in which they are asked."""
    readers = [entry.load()() for entry in entry_points(group=GROUP)]
    return tuple(sorted(readers, key=lambda r: (r.general, r.name)))


def choose_reader(path: Path, name: str | None = None) -> Reader:
    """The reader of that name, else the one that recognizes the recording."""
    readers = load_readers()
    if name is not None:
        found = [r for r in readers if r.name == name]
        if not found:
            raise unknown_name("reader", name, (r.name for r in readers))
        return found[0]
    if not path.exists():
        raise UsageError(f"{path}: there is no such file or folder")
    able = [r for r in readers if r.probe(path)]
    special = [r for r in able if not r.general]
    if len(special) > 1:
        names = " and ".join(r.name for r in special)
        raise UsageError(f"{path}: the readers {names} both recognize it; choose one with the setting 'reader'")
    if not able:
        raise DataError(f"{path}: not a recording flowlab knows; looked for {what_is_looked_for(readers)}")
    return able[0]


def what_is_looked_for(readers: tuple[Reader, ...]) -> str:
    """All layouts in one phrase, the general one first."""
    return "; ".join(f"{r.looks_for} ({r.name})" for r in sorted(readers, key=lambda r: not r.general))
