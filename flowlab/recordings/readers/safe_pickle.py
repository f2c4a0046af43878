"""Pickled arrays of others' calibrations, read without unpickling: nothing is imported, and nothing of theirs runs.

NumPy's own unpickling is no way to read a stranger's file, even with few classes allowed: the state of a
``numpy.dtype`` alone can crash the interpreter. Here the instructions of the pickle are gone through one by one; those
that build plain values are done, NumPy's few makers are stood in for, and anything else is refused.
"""

import io
import math
import pickletools
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from flowlab.errors import DataError, first_line
from flowlab.limits import MAX_CALIBRATION_BYTES
from flowlab.text import cut, shown
from flowlab.untrusted import read_bytes

_EXPECTED = "expected a mapping of arrays by camera, which numpy.save wrote"
_MOST_NUMBERS = 1000
_LONGEST_LIST = 16
_MOST_STEPS = 100_000
_MARK = object()
_CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False, "EMPTY_TUPLE": ()}
_LITERALS = {
    "BININT", "BININT1", "BININT2", "LONG1", "BINFLOAT", "BINBYTES", "SHORT_BINBYTES", "BYTEARRAY8", "BINUNICODE",
    "SHORT_BINUNICODE",
}  # fmt: skip
_MAKERS = {
    "_codecs encode", "numpy dtype", "numpy ndarray",
    *(f"numpy.{core}.{made}" for core in ("core", "_core")
      for made in ("multiarray _reconstruct", "multiarray scalar", "numeric _frombuffer")),
}  # fmt: skip
_TYPES = {"b1", *(f"{kind}{size}" for kind in "iu" for size in (1, 2, 4, 8)), "f2", "f4", "f8"}


def pickled_numbers(path: Path, key: str) -> Float64[np.ndarray, "K"] | None:
    """The numbers of an array in a mapping that ``numpy.save`` stored as an object, in one row.

    Args:
        path: The file.
        key: Of the array: a text, or a number written as one.

    Returns:
        The numbers; None where there is no such file, or nothing of that name in it.

    Raises:
        DataError: It holds anything else, or asks for anything but plain values and arrays.
    """
    if not path.exists():
        return None
    try:
        found = _unpacked(read_bytes(path, MAX_CALIBRATION_BYTES))
        if isinstance(found, _Array):
            found = found.values
        if isinstance(found, list) and len(found) == 1:  # an array of one object, which is the mapping
            found = found[0]
        if not isinstance(found, dict):
            raise ValueError(f"holds a {type(found).__name__.strip('_').lower()}")
        return next((_numbers(value) for name, value in found.items() if str(name) == key), None)
    except DataError:
        raise
    except Exception as error:  # what a pickle's instructions lead to where they are not those of one
        raise DataError(f"{path}: cannot be read ({first_line(error)}); {_EXPECTED}") from error


def _unpacked(content: bytes) -> Any:
    """What follows the header of an ``.npy`` file."""
    file = io.BytesIO(content)
    version = np.lib.format.read_magic(file)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    if not read(file)[2].hasobject:
        raise ValueError("holds numbers")
    return _Machine().run(content[file.tell() :])


@dataclass(slots=True)
class _Type:
    """The type of an array's numbers."""

    code: str
    order: str = "<"

    def plain(self) -> "np.dtype[Any]":
        if self.code not in _TYPES or self.order not in ("<", ">", "=", "|"):
            raise ValueError(f"holds values of type {shown(self.code)}, expected plain numbers")
        return np.dtype(("<" if self.order in "=|" else self.order) + self.code)

    def read(self, content: Any) -> np.ndarray:
        if not isinstance(content, bytes | bytearray):
            raise ValueError(f"holds numbers as {shown(content)}, expected bytes")
        return np.frombuffer(bytes(content), self.plain())


@dataclass(slots=True)
class _Array:
    """An array, empty until its state is given: its numbers in a row, or a list of objects."""

    values: Any = None


@dataclass(slots=True)
class _Machine:
    """Goes through the instructions of a pickle."""

    stack: list[Any] = field(default_factory=list)
    memo: dict[int, Any] = field(default_factory=dict)

    def run(self, content: bytes) -> Any:
        """The value that the pickle stands for."""
        for opcode, argument, _ in islice(pickletools.genops(content), _MOST_STEPS):
            if opcode.name == "STOP":
                return self.stack.pop()
            self._do(opcode.name, argument)
        raise ValueError("has more instructions than a calibration needs")

    def _do(self, name: str, argument: Any) -> None:
        match name:
            case "PROTO" | "FRAME":
                pass
            case "MARK" | "EMPTY_LIST" | "EMPTY_DICT":
                self.stack.append({"MARK": _MARK, "EMPTY_LIST": [], "EMPTY_DICT": {}}[name])
            case "BINPUT" | "LONG_BINPUT" | "MEMOIZE":
                self.memo[len(self.memo) if argument is None else argument] = self.stack[-1]
            case "BINGET" | "LONG_BINGET":
                self.stack.append(self.memo[argument])
            case "GLOBAL":
                self.stack.append(_maker(argument))
            case _ if name in _LITERALS:
                self.stack.append(argument)
            case _ if name in _CONSTANTS:
                self.stack.append(_CONSTANTS[name])
            case _:
                self._join(name)

    def _join(self, name: str) -> None:
        match name:
            case "TUPLE" | "TUPLE1" | "TUPLE2" | "TUPLE3":
                self.stack.append(tuple(self._since_mark() if name == "TUPLE" else self._last(int(name[-1]))))
            case "APPEND" | "APPENDS":
                items = self._last(1) if name == "APPEND" else self._since_mark()
                self._top(list).extend(items)
            case "SETITEM" | "SETITEMS":
                items = self._last(2) if name == "SETITEM" else self._since_mark()
                self._top(dict).update(zip(map(_key, items[::2]), items[1::2], strict=True))
            case "STACK_GLOBAL":
                module, what = self._last(2)
                self.stack.append(_maker(f"{module} {what}"))
            case "REDUCE":
                maker, arguments = self._last(2)
                self.stack.append(_made(maker, arguments))
            case "BUILD":
                (state,) = self._last(1)
                _set_state(self.stack[-1], state)
            case _:
                raise ValueError(f"has the instruction {name}, which plain arrays do without")

    def _last(self, count: int) -> list[Any]:
        if len(self.stack) < count:
            raise ValueError("takes more values than it has")
        values = self.stack[len(self.stack) - count :]
        del self.stack[len(self.stack) - count :]
        return values

    def _since_mark(self) -> list[Any]:
        at = max(k for k, value in enumerate(self.stack) if value is _MARK)
        values = self.stack[at + 1 :]
        del self.stack[at:]
        return values

    def _top(self, kind: type) -> Any:
        if not isinstance(self.stack[-1], kind):
            raise ValueError(f"adds to {shown(self.stack[-1])}, expected a {kind.__name__}")
        return self.stack[-1]


@dataclass(frozen=True, slots=True)
class _Maker:
    """What makes a value, by its name in NumPy."""

    name: str


def _maker(place: str) -> _Maker:
    if place not in _MAKERS:
        raise ValueError(f"it asks for {cut(place.replace(' ', '.'))}")
    return _Maker(place.rpartition(" ")[2])


def _made(maker: Any, arguments: Any) -> Any:
    """What a maker makes of its arguments."""
    match maker, arguments:
        case _Maker("dtype"), (str(code), *_):
            return _Type(code)
        case _Maker("_reconstruct"), _:
            return _Array()
        case _Maker("scalar"), (_Type() as kind, content):
            return _Array(kind.read(content))
        case _Maker("_frombuffer"), (content, _Type() as kind, tuple(shape), str(order)):
            return _Array(_shaped(kind.read(content), shape, order == "F"))
        case _Maker("encode"), (str(text), "latin1"):
            return text.encode("latin1")
    raise ValueError(f"calls {shown(maker)} in a way that NumPy does not")


def _set_state(made: Any, state: Any) -> None:
    """Give an array its numbers, or a type its order of bytes."""
    match made, state:
        case _Array(), (int(), tuple(shape), _Type("O" | "O8"), _, list(values)):
            made.values = values
        case _Array(), (int(), tuple(shape), _Type() as kind, bool(fortran), content):
            made.values = _shaped(kind.read(content), shape, fortran)
        case _Type(), (int(), str(order), None, *_):
            made.order = order
        case _:
            raise ValueError(f"has the state {shown(state)}, which is that of no plain array")


def _shaped(numbers: np.ndarray, shape: tuple[Any, ...], fortran: bool) -> np.ndarray:
    lengths = tuple(n for n in shape if type(n) is int and 0 <= n <= len(numbers))
    if len(lengths) != len(shape) or math.prod(lengths) != len(numbers) or len(shape) > 4:
        raise ValueError(f"has the shape {shown(shape)} for {len(numbers)} numbers")
    return numbers.reshape(lengths, order="F" if fortran else "C")


def _key(key: Any) -> str | int:
    if isinstance(key, str) or (type(key) is int and abs(key) < 1 << 63):
        return key
    raise ValueError(f"has the key {shown(key)}, expected the name or number of a camera")


def _numbers(value: Any, depth: int = 0) -> Float64[np.ndarray, "K"]:
    """The numbers of a value, which may be an array, or a list of arrays or numbers."""
    if isinstance(value, _Array):
        value = value.values
    if isinstance(value, np.ndarray):
        found = value.astype(np.float64).ravel()
    elif isinstance(value, list | tuple) and depth < 3 and len(value) <= _LONGEST_LIST:
        found = np.concatenate([np.empty(0), *(_numbers(v, depth + 1) for v in value)])
    elif isinstance(value, int | float):
        found = np.array([value], np.float64)
    else:
        raise ValueError(f"holds {shown(value)}, expected numbers")
    if len(found) > _MOST_NUMBERS:
        raise ValueError(f"holds {len(found)} numbers for a camera, expected a matrix")
    return found
