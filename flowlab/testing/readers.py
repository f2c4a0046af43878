"""Does a reader keep its promises? Checks for authors of plug-ins, against a small recording of its layout.

In the tests of a plug-in::

    from flowlab.testing.readers import CHECKS

    @pytest.mark.parametrize("check", CHECKS)
    def test_reader(check, recording):
        check(MyReader, recording)
"""

import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import wraps
from pathlib import Path

import cv2
import numpy as np

from flowlab.errors import FlowlabError
from flowlab.recordings import verdicts
from flowlab.recordings.base import BadImage, ImageStream, Reader, SampleStream, Streams, load_readers
from flowlab.recordings.clock import put_on_one_clock
from flowlab.recordings.image_files import COLOR_SUFFIXES, check_depth
from flowlab.recordings.parsing import RecordingSettings, known_beforehand
from flowlab.recordings.recording_yaml import FILE_NAME, combine
from flowlab.recordings.stamps import UnclearStamps
from flowlab.testing.promises import content, elsewhere, require, require_words

MakeReader = Callable[[], Reader]
_DAMAGED_FILES = 12
"""So many files of a recording are damaged, one at a time, evenly chosen."""


Check = Callable[[MakeReader, Path | str], None]


def _promise(check: Callable[[MakeReader, Path], None]) -> Check:
    """A check that takes the path as text, too."""

    @wraps(check)
    def checked(make: MakeReader, recording: Path | str) -> None:
        check(make, Path(recording))

    return checked


def check_reader(make: MakeReader, recording: Path | str) -> None:
    """Raise an AssertionError that says which promise a reader breaks.

    Args:
        make: Makes the reader, as its class does.
        recording: A folder or file of its layout, of a few frames, with what is needed to read it in or beside it;
            it is copied, and stays as it is.
    """
    for check in CHECKS:
        check(make, recording)


@_promise
def check_description(make: MakeReader, recording: Path) -> None:
    """It is made without arguments, and says what it is called and what it reads."""
    reader = make()
    require_words(reader, "name", "expects")
    require(isinstance(reader.fallback, bool), f"fallback must be True or False, but is {reader.fallback!r}")


@_promise
def check_recognized(make: MakeReader, recording: Path) -> None:
    """It recognizes its own layout, and no other reader claims that."""
    require(make().probe(recording), f"probe() must recognize {recording.name}, a recording of its layout")
    mine = type(make())
    others = [r.name for r in load_readers() if type(r) is not mine and not r.fallback and r.probe(recording)]
    require(
        make().fallback or not others,
        f"{recording.name} is claimed by the reader {' and '.join(others)} too; probe() for what it does not look for",
    )


@_promise
def check_strangers(make: MakeReader, recording: Path) -> None:
    """It leaves other files and folders alone, whatever they are."""
    reader = make()
    with _place() as folder:
        for stranger in _strangers(folder):
            try:
                claimed = reader.probe(stranger)
            except Exception as error:
                raise AssertionError(
                    f"probe() must not fail on other files, but on '{stranger.name}' raises {error!r}"
                ) from error
            own = reader.fallback and stranger.name == "plain"
            require(own or not claimed, f"probe() must not recognize '{stranger.name}', which is something else")


@_promise
def check_streams(make: MakeReader, recording: Path) -> None:
    """Streams have times that rise, in a unit that is clear, and as many names or rows."""
    streams = _read(make(), recording)
    require(isinstance(streams, Streams), f"read() must return Streams, but returns a {type(streams).__name__}")
    for what, images in (("color", streams.color), ("depth", streams.depth)):
        _check_images(what, images)
    for samples in (*streams.state, *streams.action):
        _check_samples(samples)
    given = known_beforehand(recording, RecordingSettings())
    try:
        put_on_one_clock(streams, combine([("given", given), *streams.known])[0])
    except UnclearStamps as error:
        raise AssertionError(f"times must be clear, in seconds or as their timing says, but {error}") from error
    for where, _ in streams.known:
        require(isinstance(where, str) and where, "known must say where it was found, in words")
    require(
        all(isinstance(c, verdicts.Check) and c.about and c.says for c in streams.checks), "checks must say something"
    )


@_promise
def check_pictures(make: MakeReader, recording: Path) -> None:
    """Every picture is decoded, in any order, the same each time, and belongs to whoever asked for it."""
    streams = _read(make(), recording)
    for what, images in (("color", streams.color), ("depth", streams.depth)):
        forth = [_decoded(images, k, what).copy() for k in range(len(images))]
        for k in reversed(range(len(images))):
            again = _decoded(images, k, what)
            same = np.array_equal(forth[k], again, equal_nan=again.dtype.kind == "f")
            require(same, f"{what} picture {k} must be the same every time it is read")
            if again.flags.writeable:
                again[...] = 0
        rewritten = [k for k in range(len(images)) if not np.array_equal(
            forth[k], _decoded(images, k, what), equal_nan=forth[k].dtype.kind == "f")]  # fmt: skip
        require(not rewritten, f"{what} pictures must not change where somebody writes into those that were given out")


@_promise
def check_repeatable(make: MakeReader, recording: Path) -> None:
    """Reading a recording again gives the same streams."""
    one, other = _read(make(), recording), _read(make(), recording)
    for a, b in ((one.color, other.color), (one.depth, other.depth)):
        require(a.names == b.names and np.array_equal(a.time_s, b.time_s), "read() must find the same streams again")
    for c, d in zip((*one.state, *one.action), (*other.state, *other.action), strict=True):
        require(np.array_equal(c.values, d.values), "read() must find the same samples again")


@_promise
def check_nothing_written(make: MakeReader, recording: Path) -> None:
    """Nothing is written, moved or deleted: not in the recording, not beside it, not in the current folder."""
    with _place() as folder, _place() as current:
        copy = _copied(recording, folder)
        (folder / "beside.txt").write_text("somebody else's")
        before = content(folder)
        with elsewhere(current):
            streams = _read(make(), copy)
            for images in (streams.color, streams.depth):
                for k in range(len(images)):
                    images.read(k)
        changed = sorted(k for k in before.keys() | content(folder).keys() if before.get(k) != content(folder).get(k))
        require(not changed, f"a reader must not write into or beside a recording, but changes {', '.join(changed)}")
        require(not any(current.iterdir()), "a reader must not write into the current folder")


@_promise
def check_damaged(make: MakeReader, recording: Path) -> None:
    """What is damaged is noticed: a bad picture is a BadImage, all else one sentence, never another error."""
    files = [f for f in sorted(recording.rglob("*")) if f.is_file()] if recording.is_dir() else [recording]
    for file in files[:: max(1, len(files) // _DAMAGED_FILES)]:
        for how, change in _DAMAGE.items():
            with _place() as folder:
                copy = _copied(recording, folder)
                damaged = copy / file.relative_to(recording) if recording.is_dir() else copy
                damaged.write_bytes(change(damaged.read_bytes()))
                noticed = _complaint(make, copy, f"{damaged.name}, {how},")
                unseen = file.suffix.lower() in COLOR_SUFFIXES and not noticed
                require(not unseen, f"{damaged.name}, {how}, must be a BadImage, but is read as if it were whole")


@_promise
def check_missing(make: MakeReader, recording: Path) -> None:
    """A recording that is gone is one sentence."""
    with _place() as folder:
        gone = folder / recording.name
        require(not make().probe(gone), "probe() must not recognize what is not there")
        _complaint(make, gone, "a recording that is not there")


CHECKS: tuple[Check, ...] = (
    check_description,
    check_recognized,
    check_strangers,
    check_streams,
    check_pictures,
    check_repeatable,
    check_nothing_written,
    check_damaged,
    check_missing,
)
"""Every promise of :class:`~flowlab.recordings.base.Reader`, one at a time."""

_DAMAGE: dict[str, Callable[[bytes], bytes]] = {
    "cut short": lambda whole: whole[: len(whole) // 2],
    "emptied": lambda whole: b"",
    "garbled": lambda whole: bytes(b ^ 0x5A for b in whole),
}


def _read(reader: Reader, recording: Path) -> Streams:
    """The streams of a recording, with what is beside it."""
    return reader.read(recording, known_beforehand(recording, RecordingSettings()))


def _complaint(make: MakeReader, recording: Path, what: str) -> bool:
    """Whether reading everything is refused, or a picture is bad; any other error breaks a promise."""
    noticed = False
    try:
        streams = _read(make(), recording)
        for images in (streams.color, streams.depth):
            for k in range(len(images)):
                try:
                    images.read(k)
                except BadImage as error:
                    require(str(error).strip(), f"{what} must be a BadImage with its reason, but the reason is empty")
                    noticed = True
    except AssertionError:
        raise
    except FlowlabError as error:
        require(str(error).strip(), f"{what} must be one sentence, but the error says nothing")
        return True
    except Exception as error:
        raise AssertionError(
            f"{what} must be a BadImage or a DataError that says what is wrong, but raises {error!r}"
        ) from error
    return noticed


def _check_images(what: str, images: ImageStream) -> None:
    """Require names and times of pictures."""
    require(len(images) > 0, f"the {what} stream must have pictures")
    require(all(isinstance(n, str) and n for n in images.names), f"every {what} picture must have a name")
    _check_times(f"the {what} stream", images.time_s, len(images))


def _check_samples(samples: SampleStream) -> None:
    """Require times and finite float32 rows."""
    require_words(samples, "name")
    values = samples.values
    _check_times(f"the stream '{samples.name}'", samples.time_s, len(values))
    require(values.dtype == np.float32, f"'{samples.name}' must be float32, but is {values.dtype}")
    require(values.ndim == 2, f"'{samples.name}' must have the shape (rows, width), but has {values.shape}")
    require(np.isfinite(values).all(), f"'{samples.name}' must be finite")


def _check_times(what: str, time_s: np.ndarray, count: int) -> None:
    """Require as many times as there are things."""
    require(time_s.shape == (count,), f"{what} must have a time for each of {count}, but has {time_s.shape}")
    require(time_s.dtype == np.float64, f"{what} must have times of float64 [s], but they are {time_s.dtype}")


def _decoded(images: ImageStream, k: int, what: str) -> np.ndarray:
    """A picture, of the type and shape that its stream should have."""
    try:
        picture = images.read(k)
    except BadImage as error:
        raise AssertionError(f"{what} picture {k} must be decoded, but {error}") from error
    if what == "depth":
        try:
            check_depth(picture)
        except BadImage as error:
            raise AssertionError(f"depth picture {k} {error}") from error
        require(picture.ndim == 2, f"depth pictures must have the shape (height, width), but have {picture.shape}")
        return picture
    require(picture.dtype == np.uint8, f"color pictures must be uint8, but are {picture.dtype}")
    require(picture.ndim == 3 and picture.shape[2] == 3, f"color pictures must be (h, w, 3), but are {picture.shape}")
    return picture


def _strangers(folder: Path) -> Iterator[Path]:
    """Files and folders that are no recordings, and recordings of flowlab's own plain layout."""
    (folder / "empty").mkdir()
    (folder / "notes.txt").write_text("nothing to see\n")
    for name in ("notes.bin", "notes.zip", "notes.h5"):
        (folder / name).write_bytes(bytes(range(256)))
    (folder / "folder").mkdir()
    (folder / "folder" / "notes.txt").write_text("nothing to see\n")
    for name in ("color", "depth"):
        (folder / "plain" / name).mkdir(parents=True)
        picture = cv2.imencode(".png", np.ones((4, 4), np.uint16))[1].tobytes()
        (folder / "plain" / name / "0.png").write_bytes(picture)
    (folder / "plain" / FILE_NAME).write_text("fps: 30\n")
    with suppress(OSError):
        (folder / "loop").symlink_to(folder / "loop")
    yield from sorted(folder.iterdir())
    yield folder / "missing"


def _copied(recording: Path, folder: Path) -> Path:
    """The recording, and what is beside it to be read with it, in another folder."""
    if recording.is_dir():
        return Path(shutil.copytree(recording, folder / recording.name))
    for beside in (recording.with_suffix(".yaml"), recording.parent / FILE_NAME):
        if beside.is_file():
            shutil.copy(beside, folder)
    return Path(shutil.copy(recording, folder))


@contextmanager
def _place() -> Iterator[Path]:
    """A temporary folder."""
    with tempfile.TemporaryDirectory(prefix="flowlab-check-") as folder:
        yield Path(folder).resolve()
