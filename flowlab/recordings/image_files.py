"""Picture files: lists of them, and decoding that notices damage."""

import zlib
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float64, Num, Shaped, UInt8

from flowlab.recordings.base import BadImage, ImageStream
from flowlab.text import natural_key

COLOR_SUFFIXES = (".png", ".jpg", ".jpeg")
DEPTH_SUFFIXES = (".png", ".npy", ".npz")
_PNG = b"\x89PNG\r\n\x1a\n"


def list_images(folder: Path, suffixes: Sequence[str]) -> list[Path]:
    """The pictures of a folder in natural order; hidden files are no pictures."""
    found = [f for f in folder.iterdir() if f.suffix.lower() in suffixes and not f.name.startswith(".")]
    return sorted(found, key=lambda f: natural_key(f.name))


def color_stream(files: Sequence[Path], time_s: Float64[np.ndarray, "N"]) -> ImageStream:
    """Color pictures of files."""
    files = tuple(files)
    return ImageStream(tuple(_name(f) for f in files), time_s, partial(_read, files, decode_color))


def depth_stream(files: Sequence[Path], time_s: Float64[np.ndarray, "N"]) -> ImageStream:
    """Depth pictures of files."""
    files = tuple(files)
    return ImageStream(tuple(_name(f) for f in files), time_s, partial(_read, files, decode_depth))


def _name(file: Path) -> str:
    """What errors call a file."""
    return f"{file.parent.name}/{file.name}"


def _read(files, decode, index) -> np.ndarray:  # type: ignore[no-untyped-def]
    """Decode the picture of a file."""
    file = files[index]
    try:
        content = file.read_bytes()
    except OSError as error:
        raise BadImage(f"cannot be read ({error.strerror})") from error
    if file.suffix.lower() in (".npy", ".npz"):
        return check_depth(_load_array(file))
    return decode(content)


def decode_color(content: bytes) -> UInt8[np.ndarray, "H W 3"]:
    """RGB of an encoded picture, its pixels as stored: a camera's note on how to turn it is ignored."""
    bgr = _decode(content, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)


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
    if counts.ndim != 2:
        raise BadImage(f"has the shape {counts.shape}, depth is one channel (height, width)")
    if counts.dtype not in (np.uint16, np.int16, np.uint32, np.int32, np.float16, np.float32, np.float64):
        raise BadImage(f"has the type {counts.dtype}, depth is 16 bit or float")
    return counts


def _decode(content: bytes, how: int) -> np.ndarray:
    """Decode, after a look at what decoders of some versions pass over: a missing end, a wrong checksum."""
    if not content:
        raise BadImage("is empty")
    if content.startswith(_PNG):
        _check_png(content)
    elif content.startswith(b"\xff\xd8") and b"\xff\xd9" not in content[-1024:]:
        raise BadImage("is truncated: the JPEG has no end")
    try:
        picture = cv2.imdecode(np.frombuffer(content, np.uint8), how)
    except cv2.error:
        picture = None
    if picture is None:
        raise BadImage("cannot be decoded")
    return picture


def _check_png(content: bytes) -> None:
    """Refuse a PNG that has no end or a wrong checksum."""
    at = len(_PNG)
    while at + 12 <= len(content):
        size, kind = int.from_bytes(content[at : at + 4], "big"), content[at + 4 : at + 8]
        end = at + 8 + size
        if end + 4 > len(content):
            break
        if zlib.crc32(memoryview(content)[at + 4 : end]) != int.from_bytes(content[end : end + 4], "big"):
            raise BadImage("is damaged: the checksum of the PNG is wrong")
        if kind == b"IEND":
            return
        at = end + 4
    raise BadImage(f"is truncated: the PNG ends after {len(content)} bytes, without its end")


def _load_array(file: Path) -> np.ndarray:
    """The one array of a numpy file."""
    try:
        loaded = np.load(file)
        if isinstance(loaded, np.ndarray):
            return loaded
        with loaded:
            if len(loaded.files) != 1:
                raise BadImage(f"holds the arrays {', '.join(loaded.files) or 'none'}, expected one")
            return loaded[loaded.files[0]]
    except BadImage:
        raise
    except Exception as error:  # numpy raises many kinds for a damaged file
        raise BadImage(f"cannot be read ({error})") from error
