"""Records that refuse arrays of another shape than they declare, and that say in one line what they hold.

The declaration is the annotation: two arrays of a record whose annotations share the name of a dimension must agree in
it, and so must records within records.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cache
from typing import Any, get_args, get_origin, get_type_hints

import numpy as np

from flowlab.errors import RecordError

_KINDS = (("float", "f"), ("uint", "u"), ("int", "iu"), ("bool", "b"))
"""Letters of NumPy for the kind of a number, by what the name of its type contains."""
_SHOWN_TEXT = 40


@dataclass(frozen=True, slots=True)
class Size:
    """How long a dimension is, and what says so."""

    length: int
    where: str
    """``depth``, ``camera.height``."""


class Record:
    """Base of all records: dataclasses that are ``frozen``, with ``slots`` and ``repr=False``.

    Raises:
        RecordError: A value does not fit; the message names the field, what was found and what was expected.
    """

    __slots__ = ()

    def __post_init__(self) -> None:
        if self._fitting() is None:
            self.sizes()  # says what is wrong
        self._check_values()

    def __repr__(self) -> str:
        shown = [f"{f.name}={_short(value)}" for f in fields(self) if not _is_nothing(value := getattr(self, f.name))]  # type: ignore[arg-type]
        return f"{type(self).__name__}({', '.join(shown)})"

    def lengths(self) -> dict[str | int, int]:
        """Length of every dimension, by its name."""
        return self._fitting() or {}

    def _fitting(self) -> dict[str | int, int] | None:
        """Those lengths; None where anything may be wrong. Quick, for records are made at every step."""
        arrays, inner, fixed, plain = _declared(type(self))  # type: ignore[arg-type]
        found = dict(fixed)
        for field in plain:
            if not field.fits(getattr(self, field.name)):
                return None
        for name, kinds in inner:
            value = getattr(self, name)
            if not isinstance(value, kinds):
                return None
            for dim, length in value.lengths().items() if isinstance(value, Record) else ():
                if found.setdefault(dim, length) != length:
                    return None
        for array in arrays:
            value = getattr(self, array.name)
            if value is None and array.optional:
                continue
            if not _is_array(value) or value.dtype.kind not in array.kinds:
                return None
            if value.ndim != len(array.dims):
                return None
            for dim, length in zip(array.dims, value.shape, strict=False):
                if found.setdefault(dim, length) != length:
                    return None
        return found

    def sizes(self) -> dict[str, Size]:
        """Length of every named dimension. Raises :class:`RecordError` where arrays do not agree."""
        found: dict[str, Size] = {}
        declared, inner, _, plain = _declared(type(self))  # type: ignore[arg-type]
        for field in plain:
            if not field.fits(value := getattr(self, field.name)):
                raise self._wrong(field.name, f"is {_short(value)}, expected {field.expected}")
        for name, kinds in inner:
            value = getattr(self, name)
            if not isinstance(value, kinds):
                raise self._wrong(name, f"is {_short(value)}, expected {_a(kinds[0].__name__)}")
            if isinstance(value, Record):
                for dim, size in value.sizes().items():
                    self._check_size(found, dim, Size(size.length, f"{name}.{size.where}"))
        for array in declared:
            value = getattr(self, array.name)
            if value is not None or not array.optional:
                self._check_array(array, value, found)
        return found

    def _check_values(self) -> None:
        """Look at what the numbers are; raise :class:`RecordError` by :meth:`_wrong`."""

    def _wrong(self, field: str, problem: str) -> RecordError:
        return RecordError(f"{type(self).__name__}.{field} {problem}")

    def _check_size(self, found: dict[str, Size], dim: str, size: Size) -> None:
        known = found.setdefault(dim, size)
        if known.length != size.length:
            raise self._wrong(size.where, f"is {size.length} long in {dim}, and {known.where} is {known.length}")

    def _check_array(self, array: "_Array", value: Any, found: dict[str, Size]) -> None:
        if not _is_array(value):
            raise self._wrong(array.name, f"is {type(value).__name__}, expected a NumPy array of {array.expected}")
        if value.dtype.kind not in array.kinds:
            raise self._wrong(array.name, f"is {value.dtype}, expected {array.expected}{_remedy(array.name, value)}")
        if value.ndim != len(array.dims):
            raise self._wrong(array.name, f"has the shape {value.shape}, expected {_shape(array.dims)}")
        for dim, length in zip(array.dims, value.shape, strict=True):
            known = Size(dim, "") if isinstance(dim, int) else found.setdefault(dim, Size(length, array.name))
            if known.length != length:
                wanted = _shape([found[d].length if d in found else d for d in array.dims])
                why = f", as {known.where} has {known.length} for {dim}" if known.where else ""
                raise self._wrong(array.name, f"has the shape {value.shape}, expected {wanted}{why}")


@dataclass(frozen=True, slots=True)
class _Array:
    """A field that holds an array, by its annotation."""

    name: str
    dims: tuple[str | int, ...]
    kinds: str
    """NumPy's letters for the kinds of number that will do."""
    expected: str
    """A type that will do."""
    optional: bool


@dataclass(frozen=True, slots=True)
class _Plain:
    """A field that holds a number, text, names and values, or some things of one class, by its annotation."""

    name: str
    kind: type
    of: type | None = None
    """What all in a tuple are."""

    @property
    def expected(self) -> str:
        """What will do, in words."""
        words = {int: "a whole number", str: "text", Mapping: "names and values"}
        return words.get(self.kind) or f"a tuple of {self.of.__name__ if self.of else 'values'}"

    def fits(self, value: Any) -> bool:
        """Whether a value will do."""
        if self.kind is int:
            return type(value) is int or (isinstance(value, int | np.integer) and not isinstance(value, bool))
        if not isinstance(value, self.kind):
            return False
        return self.of is None or not isinstance(value, tuple) or all(isinstance(v, self.of) for v in value)


_Inner = tuple[str, tuple[type, ...]]
"""A field that holds a record: its name, and what may stand in it, such as Quality or None."""


@cache
def _declared(cls: type) -> tuple[tuple[_Array, ...], tuple[_Inner, ...], dict[str | int, int], tuple[_Plain, ...]]:
    """The arrays of a record, the records in it, the dimensions whose name is their length, and its other fields."""
    hints = get_type_hints(cls)
    names = [f.name for f in fields(cls)]
    arrays = tuple(array for name in names if (array := _array(name, hints[name])) is not None)
    fixed: dict[str | int, int] = {dim: dim for array in arrays for dim in array.dims if isinstance(dim, int)}
    inner = tuple((name, kinds) for name in names if (kinds := _record_types(hints[name])))
    plain = tuple(field for name in names if (field := _plain(name, hints[name])) is not None)
    return arrays, inner, fixed, plain


def _plain(name: str, hint: Any) -> _Plain | None:
    if hint in (int, str):
        return _Plain(name, hint)
    if get_origin(hint) is Mapping:
        return _Plain(name, Mapping)
    return _Plain(name, tuple, get_args(hint)[0]) if get_origin(hint) is tuple else None


def _is_array(value: Any) -> bool:
    """Whether a value is an array whose numbers all count: of a masked one some do not."""
    return isinstance(value, np.ndarray) and not isinstance(value, np.ma.MaskedArray)


def _array(name: str, hint: Any) -> _Array | None:
    options = get_args(hint) or (hint,)
    for option in options:
        if hasattr(option, "dim_str") and hasattr(option, "dtypes"):
            name_of_type = option.dtypes[-1]
            kinds = next(kinds for part, kinds in _KINDS if part in name_of_type)
            dims = tuple(int(d) if d.isdigit() else d for d in option.dim_str.split())
            return _Array(name, dims, kinds, name_of_type, type(None) in options)
    return None


def _record_types(hint: Any) -> tuple[type, ...]:
    """What a field that is annotated as a record may hold, the record first; empty for other fields."""
    options = [option for option in get_args(hint) or (hint,) if isinstance(option, type)]
    records = [option for option in options if issubclass(option, Record)]
    return (*records, *(option for option in options if option not in records)) if records else ()


def _a(noun: str) -> str:
    return f"{'an' if noun[0] in 'AEIOU' else 'a'} {noun}"


def _shape(lengths: Sequence[int | str]) -> str:
    """As NumPy writes it."""
    return f"({', '.join(map(str, lengths))}{',' if len(lengths) == 1 else ''})"


def _remedy(name: str, value: np.ndarray) -> str:
    """What to type where a depth picture is as cameras give it."""
    if name != "depth" or value.dtype.kind not in "iu":
        return ""
    return "; give meters, of millimeters (depth / 1000).astype(np.float32)"


def _is_nothing(value: Any) -> bool:
    return value is None or (isinstance(value, tuple | Mapping) and not value)


def _short(value: Any) -> str:
    """A value in a few words: of an array its type and shape, of another record its name."""
    if isinstance(value, np.ndarray):
        return f"{value.dtype}[{', '.join(map(str, value.shape))}]"
    if isinstance(value, str):
        return repr(value if len(value) <= _SHOWN_TEXT else f"{value[:_SHOWN_TEXT]}...")
    if value is None or isinstance(value, bool | int | float | np.generic):
        return str(value)
    if isinstance(value, Mapping):
        return f"{{{', '.join(_keys(value))}}}"
    if isinstance(value, tuple | list):
        return f"{len(value)} x {type(value[0]).__name__}" if value else f"an empty {type(value).__name__}"
    return f"{type(value).__name__}(...)"


def _keys(values: Mapping[Any, Any]) -> Iterator[str]:
    for k, key in enumerate(values):
        if k == 4:
            yield "..."
            return
        yield str(key)
