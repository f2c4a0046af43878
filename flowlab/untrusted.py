"""Files of strangers, read so that a wrong one is one sentence: none hangs, fills memory or is believed for its name.

Every reader of text, JSON and YAML goes through here; arrays through :mod:`flowlab.array_files`.
"""

import json
import os
import stat
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from flowlab.errors import DataError, MissingFileError, first_line
from flowlab.limits import MAX_NESTING, MAX_TEXT_BYTES, MAX_YAML_BYTES, MAX_YAML_NODES
from flowlab.text import shown

_RESTORE = "restore it or extract again into a new folder"


def check_regular(path: Path, limit: int = MAX_TEXT_BYTES) -> int:
    """The size of a file [bytes], which is a regular one no larger than ``limit``: no device, pipe or folder.

    Raises:
        MissingFileError: There is none.
        DataError: It is none that can be read.
    """
    try:
        found = path.stat()
    except FileNotFoundError as error:
        raise MissingFileError(f"{path}: there is no such file") from error
    except (OSError, ValueError) as error:  # a circle of links, a name too long, a NUL in it
        raise DataError(f"{path}: cannot be read ({getattr(error, 'strerror', None) or first_line(error)})") from error
    if not stat.S_ISREG(found.st_mode):
        kind = "a folder" if stat.S_ISDIR(found.st_mode) else "a device or a pipe"
        raise DataError(f"{path}: is {kind}, expected a file")
    if found.st_size > limit:
        raise DataError(f"{path}: has {found.st_size:,} bytes, expected at most {limit:,}")
    return found.st_size


def is_there(path: Path) -> bool:
    """Whether there is a file or folder; of a path that no file system can have, or that is hidden, there is none."""
    try:
        return path.exists()
    except (OSError, ValueError):  # a name too long, half a character in it, a folder that may not be searched
        return False


def read_bytes(path: Path, limit: int = MAX_TEXT_BYTES) -> bytes:
    """All of a regular file. Raises :class:`DataError` where it cannot be read or is larger than ``limit``."""
    check_regular(path, limit)
    try:
        with open(os.open(path, os.O_RDONLY | os.O_NONBLOCK), "rb") as file:
            return file.read(limit)
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror or error})") from error


def read_text(path: Path, limit: int = MAX_TEXT_BYTES) -> str:
    """All of a text file, which is UTF-8. Raises :class:`DataError`."""
    try:
        return read_bytes(path, limit).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: is no UTF-8 text (byte {error.start}); save it as UTF-8") from error


def read_json(path: Path, advice: str = _RESTORE) -> Any:
    """The values of a JSON file. Raises :class:`DataError` where it holds none, saying ``advice``."""
    return parse_json(read_text(path), str(path), advice)


def parse_json(text: str | bytes, where: str, advice: str = "") -> Any:
    """The values of JSON text. Raises :class:`DataError` where it is none, saying ``advice``."""
    advice = f"; {advice}" if advice else ""
    try:
        values = json.loads(text)
        opened = sum(map(text.count, (b"[", b"{") if isinstance(text, bytes) else ("[", "{")))  # type: ignore[arg-type]
        if opened > MAX_NESTING and _depth(values) > MAX_NESTING:
            raise RecursionError
        if (b"\\u" if isinstance(text, bytes) else "\\u") in text:  # type: ignore[operator]
            json.dumps(values, ensure_ascii=False).encode()  # half a character could not be written again
    except RecursionError as error:
        raise DataError(f"{where}: is nested too deep{advice}") from error
    except ValueError as error:  # also of text that is no UTF-8, and of integers of thousands of digits
        raise DataError(f"{where}: not valid JSON ({first_line(error)}){advice}") from error
    return values


def _depth(values: Any) -> int:
    level, depth = [values], 0
    while level:
        depth += 1
        inner = (v.values() if isinstance(v, dict) else v for v in level if isinstance(v, dict | list))
        level = [x for group in inner for x in group]
    return depth


def read_yaml(path: Path) -> Any:
    """The values of a YAML file. Raises :class:`DataError`."""
    try:
        return parse_yaml(read_text(path, MAX_YAML_BYTES))
    except ValueError as error:
        raise DataError(f"{path}: not valid YAML ({first_line(error)})") from error


def parse_yaml(text: str) -> Any:
    """The values of YAML text: plain ones, never objects.

    Raises:
        ValueError: It is no YAML, is nested too deep, or its aliases unfold to more than anybody writes.
    """
    import yaml

    try:
        node = yaml.compose(text, Loader=yaml.SafeLoader)
        _unfolded(node, {}, 0)
        return None if node is None else yaml.SafeLoader("").construct_document(node)
    except RecursionError as error:
        raise ValueError("it is nested too deep") from error
    except yaml.YAMLError as error:
        raise ValueError(_yaml_words(error)) from error
    except (TypeError, AttributeError, OverflowError) as error:  # what PyYAML makes of odd keys and dates
        raise ValueError(first_line(error)) from error


def _unfolded(node: Any, known: dict[int, int], depth: int) -> int:
    """How many values a node stands for, its aliases unfolded."""
    import yaml

    if node is None or isinstance(node, yaml.ScalarNode):
        return 1
    if depth > MAX_NESTING:
        raise ValueError("it is nested too deep")
    if isinstance(node, yaml.MappingNode):
        _check_once([key for key, _ in node.value if isinstance(key, yaml.ScalarNode)])
    if id(node) not in known:
        inner = [x for pair in node.value for x in pair] if isinstance(node, yaml.MappingNode) else node.value
        known[id(node)] = 1 + sum(_unfolded(x, known, depth + 1) for x in inner)
    if known[id(node)] > MAX_YAML_NODES:
        raise ValueError(f"its aliases stand for more than {MAX_YAML_NODES:,} values")
    return known[id(node)]


def _check_once(keys: Sequence[Any]) -> None:
    """Refuse a key that stands twice: YAML forbids it, and PyYAML takes the last without a word."""
    lines: dict[str, int] = {}
    for key in keys:
        line = key.start_mark.line + 1
        if key.value in lines:
            raise ValueError(f"{shown(key.value)} stands twice, in lines {lines[key.value]} and {line}; keep one")
        lines[key.value] = line


def _yaml_words(error: Any) -> str:
    """What PyYAML says, and in which line."""
    mark = getattr(error, "problem_mark", None)
    said = getattr(error, "problem", None) or first_line(error)
    return f"{said} in line {mark.line + 1}" if mark is not None else said
