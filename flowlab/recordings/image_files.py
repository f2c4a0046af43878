"""Picture files: lists of them, and decoding that notices damage."""

import re
import zlib
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float64, Num, Shaped, UInt8

from flowlab.array_files import load_array, load_arrays
from flowlab.errors import DataError
from flowlab.limits import MAX_PICTURE_BYTES, MAX_PIXELS, MAX_SCANS
from flowlab.recordings.base import BadImage, ImageStream
from flowlab.recordings.stamps import IN_SECONDS, Timing
from flowlab.text import cut, natural_key
from flowlab.untrusted import read_bytes

COLOR_SUFFIXES = (".png", ".jpg", ".jpeg")
DEPTH_SUFFIXES = (".png", ".npy", ".npz")
_PNG = b"\x89PNG\r\n\x1a\n"
_ANIMATED = (b"acTL", b"fcTL", b"fdAT")
_JPEG = b"\xff\xd8"
_MARKER = re.compile(rb"\xff+([^\x00\xff])", re.DOTALL)
_SIZES = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}
"""Markers of a JPEG that a size follows."""
_ALONE = {0x01, *range(0xD0, 0xDA)}
"""Markers without a length."""


def list_images(folder: Path, suffixes: Sequence[str]) -> list[Path]:
    """The pictures of a folder in natural order; hidden files are no pictures."""
    try:
        found = [f for f in folder.iterdir() if f.suffix.lower() in suffixes and not f.name.startswith(".")]
    except OSError as error:
        raise DataError(f"{folder}: cannot be looked into ({error.strerror or error})") from error
    return sorted(found, key=lambda f: natural_key(f.name))


def color_stream(files: Sequence[Path], time_s: Float64[np.ndarray, "N"], timing: Timing = IN_SECONDS) -> ImageStream:
    """Color pictures of files."""
    files = tuple(files)
    return ImageStream(tuple(_name(f) for f in files), time_s, partial(_read, files, decode_color), timing)


def depth_stream(files: Sequence[Path], time_s: Float64[np.ndarray, "N"], timing: Timing = IN_SECONDS) -> ImageStream:
    """Depth pictures of files."""
    files = tuple(files)
    return ImageStream(tuple(_name(f) for f in files), time_s, partial(_read, files, decode_depth), timing)


def _name(file: Path) -> str:
    """What errors call a file."""
    return f"{file.parent.name}/{file.name}"


def _read(files, decode, index) -> np.ndarray:  # type: ignore[no-untyped-def]
    """Decode the picture of a file."""
    file: Path = files[index]
    try:
        if file.suffix.lower() in (".npy", ".npz"):
            return check_depth(_load_array(file))
        return decode(read_bytes(file, MAX_PICTURE_BYTES))
    except DataError as error:
        raise BadImage(f"cannot be read ({str(error).removeprefix(f'{file}: ')})") from error


def decode_color(content: bytes) -> UInt8[np.ndarray, "H W 3"]:
    """RGB of an encoded picture, its pixels as stored: a camera's note on how to turn it is ignored."""
    bgr = _decode(content, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)


def exif_turns(file: Path) -> bool:
    """Whether a note in a color picture says to turn it (EXIF), which :func:`decode_color` ignores."""
    try:
        content = read_bytes(file, MAX_PICTURE_BYTES)
        stored, shown = (_decode(content, cv2.IMREAD_COLOR | how) for how in (cv2.IMREAD_IGNORE_ORIENTATION, 0))
    except (DataError, BadImage):  # of a stream without files, or of one that is bad
        return False
    return stored.shape != shown.shape or bool((stored != shown).any())


def decode_depth(content: bytes) -> Num[np.ndarray, "H W"]:
    """Counts (H, W) of an encoded depth picture."""
    return check_depth(_decode(content, cv2.IMREAD_UNCHANGED))


def check_depth(counts: Shaped[np.ndarray, "..."]) -> Num[np.ndarray, "H W"]:
    """The same counts, without an axis of one channel.

    Raises:
        BadImage: They cannot be depth, which is one channel of 16 bits or more.
    """
    if counts.ndim == 3 and 1 in (counts.shape[0], counts.shape[-1]):
        counts = counts.reshape(counts.shape[:-1] if counts.shape[-1] == 1 else counts.shape[1:])
    if counts.ndim != 2 or not 0 < counts.size <= MAX_PIXELS:
        raise BadImage(f"has the shape {counts.shape}, depth is one channel (height, width)")
    if counts.dtype not in (np.uint16, np.int16, np.uint32, np.int32, np.float16, np.float32, np.float64):
        raise BadImage(f"has the type {counts.dtype}, depth is 16 bit or float")
    return counts


def _decode(content: bytes, how: int) -> np.ndarray:
    """Decode, after a look at what decoders pass over: a missing end, a wrong checksum, a size that fills memory."""
    if not content:
        raise BadImage("is empty")
    if content.startswith(_PNG):
        width, height = _check_png(content)
    elif content.startswith(_JPEG):
        width, height = _check_jpeg(content)
    else:
        raise BadImage("is neither PNG nor JPEG")
    if not 0 < width * height <= MAX_PIXELS:
        raise BadImage(f"says it has {width} x {height} pixels, expected 1 to {MAX_PIXELS:,}")
    try:
        picture = cv2.imdecode(np.frombuffer(content, np.uint8), how)
    except cv2.error:
        picture = None
    if picture is None:
        raise BadImage("cannot be decoded")
    return picture


def _check_png(content: bytes) -> tuple[int, int]:
    """Width and height that a PNG claims; one that has no end or a wrong checksum is refused."""
    at = len(_PNG)
    while at + 12 <= len(content):
        size, kind = int.from_bytes(content[at : at + 4], "big"), content[at + 4 : at + 8]
        end = at + 8 + size
        if end + 4 > len(content):
            break
        if zlib.crc32(memoryview(content)[at + 4 : end]) != int.from_bytes(content[end : end + 4], "big"):
            raise BadImage("is damaged: the checksum of the PNG is wrong")
        if (at == len(_PNG)) != (kind == b"IHDR") or kind in _ANIMATED:
            raise BadImage("is damaged: the parts of the PNG are in the wrong order, or it is animated")
        if kind == b"IEND":
            return int.from_bytes(content[16:20], "big"), int.from_bytes(content[20:24], "big")
        at = end + 4
    raise BadImage(f"is truncated: the PNG ends after {len(content)} bytes, without its end")


def _check_jpeg(content: bytes) -> tuple[int, int]:
    """Width and height that a JPEG claims; one that has no end or would take hours is refused."""
    if content.rfind(b"\xff\xd9") <= content.rfind(b"\xff\xda"):  # cameras pad their files behind the end
        raise BadImage("is truncated: the JPEG has no end")
    if content.count(b"\xff\xda") > MAX_SCANS:
        raise BadImage(f"has more than {MAX_SCANS} passes, no camera's JPEG has")
    at = 2
    while found := _MARKER.search(content, at):  # as decoders find it: whatever is in between is passed over
        kind, at = found.group(1)[0], found.end()
        if kind in _SIZES:
            return int.from_bytes(content[at + 5 : at + 7], "big"), int.from_bytes(content[at + 3 : at + 5], "big")
        if kind not in _ALONE:
            at += int.from_bytes(content[at : at + 2], "big")
    raise BadImage("is damaged: the JPEG does not say its size")


def _load_array(file: Path) -> np.ndarray:
    """The one array of a numpy file."""
    if file.suffix.lower() == ".npy":
        return load_array(file, MAX_PICTURE_BYTES)
    arrays = load_arrays(file, MAX_PICTURE_BYTES)
    if len(arrays) != 1:
        raise BadImage(f"holds the arrays {cut(', '.join(arrays)) or 'none'}, expected one")
    return next(iter(arrays.values()))
