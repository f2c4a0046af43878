"""What a file, or an array, that nothing uses holds: its numbers where it has some, its names, a few words."""

import re
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from flowlab.array_files import load_array, map_array, map_member
from flowlab.errors import FlowlabError
from flowlab.recordings.foreign import foreign_format
from flowlab.recordings.image_files import COLOR_SUFFIXES
from flowlab.recordings.tables import parse_table
from flowlab.text import counted, cut
from flowlab.untrusted import parse_json, parse_yaml, read_text

_MOST_READ = 4 << 20
"""Larger files of numbers are told by their names and shapes alone [bytes]."""
_HEAD = 4096
"""So much of a text is looked through for words [bytes]."""
_DEPTH = 4
"""So deep mappings are looked through."""
_NAMED = 8
_LEAVES = 2000


@dataclass(frozen=True, slots=True)
class Contents:
    """What a file holds."""

    holds: str
    """In a few words."""
    values: np.ndarray | None = None
    """Its numbers, where it is an array or a table of nothing else."""
    names: tuple[str, ...] = ()
    """Of its columns, arrays or keys."""
    leaves: tuple[tuple[str, Any], ...] = ()
    """Names and values of a mapping, to some depth."""
    words: str = ""
    """The beginning of a text."""


def array_contents(archive: Path, name: str) -> Contents:
    """What an array of an ``.npz`` file holds."""
    try:
        with zipfile.ZipFile(archive) as file:
            size = file.getinfo(f"{name}.npy").file_size
        return _of_array(map_member(archive, name), name) if size <= _MOST_READ else Contents(f"{size:,} bytes")
    except (FlowlabError, ValueError, OSError, KeyError, zipfile.BadZipFile):
        return Contents("an array that cannot be read")


def file_contents(path: Path) -> Contents:
    """What a file holds; whatever is wrong with it becomes words."""
    suffix = path.suffix.lower()
    if suffix in COLOR_SUFFIXES or suffix in (".bmp", ".tif", ".tiff", ".exr", ".pgm", ".ppm"):
        return Contents("a picture")
    if says := foreign_format(path):
        return Contents(says)
    try:
        if suffix == ".npy":
            large = path.stat().st_size > _MOST_READ
            return _of_array(map_array(path) if large else load_array(path), path.stem)
        if suffix == ".npz":
            return _of_archive(path)
        return _of_text(path, suffix) if path.stat().st_size <= _MOST_READ else _large_text(path)
    except (FlowlabError, ValueError, TypeError, OSError, RecursionError, zipfile.BadZipFile):
        return Contents("what cannot be read here")


def _of_array(values: np.ndarray, name: str) -> Contents:
    shape = f"{values.dtype} {cut(str(values.shape))}"
    if values.dtype.kind == "U" and 0 < values.nbytes <= _MOST_READ:
        return Contents(f"text: {cut(repr(str(values.flat[0])[:60]))}", leaves=((name, str(values.flat[0])),))
    if values.dtype.kind not in "biuf" or values.nbytes > _MOST_READ:
        return Contents(shape)
    leaves = ((name, values.item()),) if values.size == 1 else ()
    return Contents(f"the number {values.item():g}" if leaves else shape, np.asarray(values), leaves=leaves)


def _of_archive(path: Path) -> Contents:
    with zipfile.ZipFile(path) as archive:
        names = tuple(n.removesuffix(".npy") for n in archive.namelist())
    return Contents(f"the arrays {_some(names)}", names=names)


def _of_text(path: Path, suffix: str) -> Contents:
    text = read_text(path, _MOST_READ)
    if "\0" in text:
        return Contents("bytes of an unknown format")
    mapping = _mapping(text, suffix)
    if mapping is not None:
        return _of_mapping(mapping, text)
    try:
        table = parse_table(path, text)
    except FlowlabError:
        return Contents(f"text: {cut(repr(text.strip()[:60]))}" if text.strip() else "nothing", words=text[:_HEAD])
    rows = f"{counted(len(table.values), 'row')} of {table.values.shape[1]} numbers"
    values = None if table.text else table.values
    return Contents(
        f"{counted(len(table.values), 'row')} of {_some(table.names)}" if table.names else rows, values, table.names
    )


def _mapping(text: str, suffix: str) -> Any:
    """The values of JSON or YAML; None where the text is neither."""
    try:
        if suffix in (".json", ".jsonl", ".ndjson"):
            return parse_json(text if suffix == ".json" else text.strip().splitlines()[0], "it")
        if suffix in (".yaml", ".yml"):
            return parse_yaml(text)
    except (FlowlabError, ValueError, IndexError):
        return None
    return None


def _of_mapping(values: Any, text: str) -> Contents:
    """What JSON or YAML holds: an array, or keys."""
    if isinstance(values, list):
        try:
            return _of_array(np.array(values, np.float64), "")
        except (ValueError, TypeError):
            if values and all(isinstance(x, str) for x in values):
                return Contents(f"text: {cut(repr(values[0][:60]))}", leaves=(("", values[0]),), words=text[:_HEAD])
            values = values[0] if values and isinstance(values[0], dict) else {}
    if not isinstance(values, dict) or not values:
        return Contents(f"{cut(repr(values))}", words=text[:_HEAD])
    leaves = tuple(leaf for leaf, _ in zip(_leaves(values, "", 0), range(_LEAVES), strict=False))
    names = tuple(map(str, values))
    return Contents(f"the keys {_some(names)}", names=names, leaves=leaves, words=" ".join(n for n, _ in leaves))


def _leaves(values: Mapping[Any, Any], above: str, depth: int) -> Iterator[tuple[str, Any]]:
    for key, value in values.items():
        name = f"{above}{key}"
        if isinstance(value, dict) and value and depth < _DEPTH:
            yield from _leaves(value, f"{name}.", depth + 1)
        else:
            yield name, value


def _large_text(path: Path) -> Contents:
    with path.open("rb") as file:
        head = file.read(_HEAD)
    if b"\0" in head:
        return Contents("bytes of an unknown format")
    words = head.decode("utf-8", "replace")
    return Contents(f"text: {cut(repr(words[:60]))}", words=words)


def _some(names: tuple[str, ...]) -> str:
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return cut(", ".join(re.sub(r"\s+", " ", n) for n in names[:_NAMED])) + more
