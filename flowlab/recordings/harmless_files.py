"""Files that tell nothing of where or when things were: a short list, for whatever is not on it is asked about."""

import re
from pathlib import Path, PurePosixPath

from flowlab.errors import DataError
from flowlab.recordings.image_files import COLOR_SUFFIXES
from flowlab.untrusted import read_text

_PROSE = re.compile(
    r"(readme|licen[cs]e|notice|citation|changelog|authors|copying)([._-].*)?|.*\.(md|rst|pdf)", re.DOTALL
)
_SUMS = re.compile(r"(md5|sha\d*)_?(sums?)?(\.txt)?|checksums?(\.txt)?|.*\.(md5|sha\d+)", re.DOTALL)
_PREVIEW = re.compile(r"(^|[_\-. ])(thumb(nail)?s?|previews?|screenshots?|snapshots?)($|[_\-. \d])")
_FILMS = (".mp4", ".avi", ".mov", ".webm", ".gif")
_COUNTS = re.compile(r"(next_?)?(rewards?|dones?|terminals?|terminated|truncated|returns?|discounts?|success(es)?)")
"""What learning by reward keeps for every step: neither of the robot's body nor of the camera."""
_LINE_TIME = re.compile(r"^\W*(\d{4}-\d\d-\d\d[T ])?\d\d:\d\d:\d\d([.,]\d+)?\W*", re.MULTILINE)
"""The time of day at the start of a line of a log."""
_MOST_READ = 1 << 16


def why_harmless(name: str, path: Path | None) -> str | None:
    """Why a file that nothing uses needs no question; None where it does.

    Args:
        name: Below the recording's folder, with ``/`` between its parts; or that of an array of an ``.npz`` file.
        path: Where it lies; None for an array.
    """
    file = PurePosixPath(name.lower())
    suffix = file.suffix
    if suffix in ("", ".npy") and _COUNTS.fullmatch(file.name.removesuffix(".npy")):
        return "counts what was achieved"
    if path is None:
        return None
    if _PROSE.fullmatch(file.name):
        return "documentation"
    if _SUMS.fullmatch(file.name):
        return "checksums"
    if file.name.endswith("~"):
        return "a copy that an editor left"
    if suffix in _FILMS or (suffix in COLOR_SUFFIXES and any(map(_PREVIEW.search, (*file.parts[:-1], file.stem)))):
        return "to look at"
    return "text without a number" if suffix in (".txt", ".log") and _is_without_numbers(path, suffix) else None


def _is_without_numbers(path: Path, suffix: str) -> bool:
    """Whether a text holds no digit, that of a log but for the times at the start of its lines."""
    try:
        text = read_text(path, _MOST_READ)
    except DataError:
        return False
    return re.search(r"\d", _LINE_TIME.sub("", text) if suffix == ".log" else text) is None
