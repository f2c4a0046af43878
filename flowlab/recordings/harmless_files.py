"""Files that tell nothing of where or when things were: a short list, for whatever is not on it is asked about."""

import re
from pathlib import Path, PurePosixPath

from flowlab.errors import DataError
from flowlab.recordings.image_files import COLOR_SUFFIXES
from flowlab.recordings.recording_yaml import SIMULATED
from flowlab.untrusted import read_json, read_text

_PROSE = re.compile(
    r"(readme|licen[cs]e|notice|citation|changelog|authors|copying)([._-].*)?|.*\.(md|rst|pdf)", re.DOTALL
)
_SUMS = re.compile(r"(md5|sha\d*)_?(sums?)?(\.txt)?|checksums?(\.txt)?|.*\.(md5|sha\d+)", re.DOTALL)
_PREVIEW = re.compile(r"(^|[_\-. ])(thumb(nail)?s?|previews?|screenshots?|snapshots?)($|[_\-. \d])")
_CODE = re.compile(
    r".*\.(py|ipynb|sh|bash|bat|cpp|cc|h|hpp|c|m|js|lock)|requirements[\w.-]*\.txt|environment\.ya?ml|(docker|make)file"
    r"|pyproject\.toml|cmakelists\.txt",
    re.DOTALL,
)
_TELLING = re.compile(
    r"\b(f[xy]|c[xy]|pp[xy]|k\d?|d|fps|hz|rate|calib\w*|intrin\w*|extrin\w*|dist\w*|focal|camera|depth|scale|unit|offset|"
    r"pose|qpos|joints?|timestamps?|stamps?|times?|matrix|rotation|translation|quat\w*|serial|width|height)\b\s*[:=,]",
    re.IGNORECASE,
)
"""Words before a colon or an equals sign, in a text that is no prose."""
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
    if name == SIMULATED and _is_of_simulator(path):
        return "what flowlab's simulator made it with"
    if _SUMS.fullmatch(file.name):
        return "checksums"
    if file.name.endswith("~"):
        return "a copy that an editor left"
    if _CODE.fullmatch(file.name):
        return "code"
    if suffix in _FILMS or (suffix in COLOR_SUFFIXES and any(map(_PREVIEW.search, (*file.parts[:-1], file.stem)))):
        return "to look at"
    return "prose" if suffix in (".txt", ".log") and _is_prose(path, suffix) else None


def _is_of_simulator(path: Path) -> bool:
    """Whether flowlab wrote a file of that name; another's may say where the camera was."""
    try:
        values = read_json(path)
    except DataError:
        return False
    return isinstance(values, dict) and values.keys() == {"made_with", "unusable_queries"}


def _is_prose(path: Path, suffix: str) -> bool:
    """Whether a text is for people to read: it names no reading, and has more words than numbers in every line.

    In a log the times at the start of its lines do not count.
    """
    try:
        text = read_text(path, _MOST_READ)
    except DataError:
        return False
    lines = [line.split() for line in (_LINE_TIME.sub("", text) if suffix == ".log" else text).splitlines()]
    numbers = [sum(any(c.isdigit() for c in word) for word in line) for line in lines]
    return not _TELLING.search(text) and all(2 * n <= len(line) for n, line in zip(numbers, lines, strict=True))
