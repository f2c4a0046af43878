"""Tables of numbers in text files, as robots, loggers and spreadsheets write them; columns are told by their names."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from flowlab.array_files import load_array
from flowlab.errors import DataError
from flowlab.recordings.cells import POINT, find_splitter, is_grouped, is_number
from flowlab.text import cut, shown
from flowlab.untrusted import read_text

_NO_TABLES = {".json", ".jsonl", ".yaml", ".yml", ".npz", ".mat", ".pkl", ".pickle", ".xlsx", ".h5", ".hdf5"}
_COMMENT = re.compile(r"\s*(#|%|//)")


@dataclass(frozen=True, slots=True)
class SampleTable:
    """Rows of numbers."""

    path: Path
    names: tuple[str, ...]
    """Of the columns; empty where the file has none."""
    values: Float64[np.ndarray, "N D"]
    """nan for what is no number in a column of text."""
    text: frozenset[int] = frozenset()
    """Columns that hold text, as a frame's name."""
    integers: bool = False
    """Whether all numbers are written without a fraction."""
    words: Mapping[int, tuple[str, ...]] = field(default_factory=dict)
    """The cells of the columns that hold text."""

    def column(self, name: str) -> int:
        """The place of a column. Raises :class:`DataError` with the names there are."""
        found = [k for k, n in enumerate(self.names) if plain_name(n) == plain_name(name)]
        exact = [k for k in found if self.names[k] == name] or found
        if len(exact) != 1:
            have = "no names of columns" if not self.names else f"the columns {cut(', '.join(map(repr, self.names)))}"
            raise DataError(f"{self.path}: has {'two columns' if exact else 'no column'} {shown(name)}; it has {have}")
        return exact[0]


def read_table(path: Path) -> SampleTable:
    """The table of a text file or a numpy array. Raises :class:`DataError` where it is none."""
    if path.suffix.lower() in _NO_TABLES:
        raise DataError(f"{path}: is no table; write its numbers as .npy, or as text with a row a line")
    if path.suffix.lower() != ".npy":
        return parse_table(path, read_text(path))
    values = load_array(path)
    if values.dtype.kind not in "biuf":
        raise DataError(f"{path}: holds {cut(str(values.dtype))}, expected numbers")
    values = values[:, None] if values.ndim == 1 else values
    if values.ndim != 2 or not len(values):
        raise DataError(f"{path}: has the shape {cut(str(values.shape))}, expected (rows, numbers)")
    return SampleTable(path, (), values.astype(np.float64), integers=values.dtype.kind in "iu")


def parse_table(path: Path, text: str) -> SampleTable:
    """The table of a text. Raises :class:`DataError` where it is none, or can be read in two ways."""
    lines = [(n, x.strip()) for n, x in enumerate(text.lstrip("\ufeff").splitlines(), 1) if x.strip()]
    first = next((k for k, (_, x) in enumerate(lines) if not _COMMENT.match(x)), len(lines))
    rows = [(n, line) for n, line in lines[first:] if not _COMMENT.match(line)]
    split = find_splitter(path, [line for _, line in rows])
    cells = [(n, split(line)) for n, line in rows]
    names: list[str] = []
    if cells and not any(map(is_number, cells[0][1])):
        names = cells.pop(0)[1]
    elif first and cells:  # names may be in a comment, as in rostopic's '%time,field.x' and TUM's '# timestamp tx ty'
        words = split(_COMMENT.sub("", lines[first - 1][1], count=1).strip())
        names = words if len(words) == len(cells[0][1]) and not any(map(is_number, words)) else []
        names[:1] = [f"%{names[0]}"] if names and lines[first - 1][1].startswith("%") else names[:1]
    if not cells:
        raise DataError(f"{path}: holds no row of numbers")
    return _numbers(path, names, cells, dict(rows))


def _numbers(path: Path, names: list[str], cells: list[tuple[int, list[str]]], lines: Mapping[int, str]) -> SampleTable:
    """A table of cells; a column that never holds a number is one of text where it has a name."""
    width = len(names) or len(cells[0][1])
    text = {k for k in range(width if names else 0) if not any(len(c) > k and is_number(c[k]) for _, c in cells)}
    rows = []
    _check_grouped(path, cells, text)
    for n, row in cells:
        if len(row) != width or not all(is_number(x) for k, x in enumerate(row) if k not in text):
            raise DataError(f"{path}: line {n} {_not_numbers(names, width, row, lines[n])}")
        rows.append([np.nan if k in text else float(x) for k, x in enumerate(row)])
    integers = all(x.lstrip("+-").isdecimal() for _, row in cells for x in row)
    words = {k: tuple(row[k].strip() for _, row in cells) for k in text}
    called = tuple(n.strip() for n in names)
    if twice := next((n for k, n in enumerate(called) if n and n in called[:k]), ""):
        raise DataError(f"{path}: has two columns {shown(twice)}; give each a name of its own")
    return SampleTable(path, called, np.array(rows, np.float64), frozenset(text), integers, words)


def _not_numbers(names: list[str], width: int, row: list[str], line: str) -> str:
    """What is said of a line that is no row of a table, cell by cell as it was cut."""
    cells = shown(line)
    if len(row) == width:
        return f"is not {width} numbers: {cells}"
    says = f"has {len(row)} cells, expected {width}, {'as many as names' if names else 'as in the first'}: {cells}"
    halves = len(row) == 2 * width and all(x.lstrip("+-").isdecimal() for x in row)
    return f"{says}; its numbers look as if the comma were a decimal one, too: {POINT}" if halves else says


def _check_grouped(path: Path, cells: list[tuple[int, list[str]]], text: set[int]) -> None:
    """Refuse numbers with a decimal comma or a sign between thousands, also in a column that has no others."""
    every = [row for _, row in cells]
    of_numbers = {k for k in text if all(len(row) > k and (is_grouped(row[k]) or is_number(row[k])) for row in every)}
    for n, row in cells:
        for k, cell in enumerate(row):
            if is_grouped(cell) and (k not in text or k in of_numbers):
                what = "with a decimal comma or a sign between thousands"
                raise DataError(f"{path}: line {n} has {shown(cell)}, {what}; {POINT}")


def plain_name(name: str) -> str:
    """A name of a column by its letters and digits."""
    return re.sub(r"[^a-z0-9]", "", name.lower())
