"""What a settings class says of its fields: name, type, default, and the docstring below each."""

import ast
import inspect
import json
import textwrap
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic_core import PydanticUndefined

_WORDS = {
    int: "whole number",
    float: "number",
    str: "text",
    bool: "true or false",
    Path: "path",
    Any: "anything",
    NoneType: "null",
}
_BOUNDS = (("gt", "> "), ("ge", "≥ "), ("lt", "< "), ("le", "≤ "), ("multiple_of", "multiple of "))


@dataclass(frozen=True)
class Setting:
    """One field, by its path of keys."""

    path: str
    kind: str
    default: str
    meaning: str


def settings_of(cls: type[BaseModel], values: BaseModel | None = None, path: str = "") -> Iterator[Setting]:
    """Every field of a class and of the groups in it.

    Args:
        cls: A class of settings.
        values: Their defaults, where a group's differ from those of its class.
        path: Keys that lead there, with a dot at their end.
    """
    docs = docstrings(cls)
    for name, field in cls.model_fields.items():
        default = getattr(values, name) if values is not None else field.get_default(call_default_factory=True)
        group = _group(field.annotation)
        if group is None or default is None or not isinstance(default, BaseModel):
            kind = _kind(field.annotation, field.metadata)
            yield Setting(f"{path}{name}", kind, _shown(default), docs.get(name, ""))
        if group is not None:
            if isinstance(default, BaseModel):
                meaning = docs.get(name) or inspect.cleandoc(group.__doc__ or "").split("\n\n")[0]
                yield Setting(f"{path}{name}", "group", "", meaning)
            yield from settings_of(group, default if isinstance(default, group) else None, f"{path}{name}.")


def docstrings(cls: type) -> dict[str, str]:
    """The docstring below each field of a class or of a class that it comes from."""
    found: dict[str, str] = {}
    for base in reversed(cls.__mro__):
        if not issubclass(base, BaseModel) or base.__module__.startswith("pydantic"):
            continue
        body = ast.parse(textwrap.dedent(inspect.getsource(base))).body[0].body  # type: ignore[attr-defined]
        for field, below in pairwise(body):
            if isinstance(field, ast.AnnAssign) and isinstance(below, ast.Expr):
                found[ast.unparse(field.target)] = inspect.cleandoc(ast.literal_eval(below.value))
    return found


def _group(annotation: Any) -> type[BaseModel] | None:
    """The class of a group of settings, also of one that may be left out."""
    choices = get_args(annotation) if get_origin(annotation) in (Union, UnionType, Annotated) else (annotation,)
    found = [c for c in choices if isinstance(c, type) and issubclass(c, BaseModel)]
    return found[0] if found else None


def _kind(annotation: Any, metadata: Any = ()) -> str:
    """A type in words, with its bounds."""
    origin, inner = get_origin(annotation), get_args(annotation)
    bounds = _bounds(metadata)
    if origin is Annotated:
        return _kind(inner[0], (*inner[1:], *metadata))
    if origin is Literal:
        return " or ".join(f"`{choice}`" for choice in inner)
    if origin in (Union, UnionType):
        return " or ".join(_kind(i, metadata if i is not NoneType else ()) for i in inner)
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return f"mapping of {_kind(inner[0])} to {_kind(inner[1])}"
    if origin is tuple and inner[-1] is not ...:
        return f"{len(inner)} × {_kind(inner[0])}"
    if origin in (tuple, frozenset):
        return f"list of {_kind(inner[0])}"
    name = _WORDS.get(annotation) or f"`{getattr(annotation, '__name__', annotation)}`"
    return f"{name} {bounds}".strip()


def _bounds(metadata: Any) -> str:
    """Limits, wherever annotations keep them."""
    told = [m for data in metadata for m in (data, *getattr(data, "metadata", ()))]
    return ", ".join(
        f"{sign}{value}" for key, sign in _BOUNDS for m in told if (value := getattr(m, key, None)) is not None
    )


def _shown(value: Any) -> str:
    """A default as YAML has it."""
    if value is PydanticUndefined:
        return "must be given"
    if hasattr(value, "__dataclass_fields__"):
        value = {name: getattr(value, name) for name in value.__dataclass_fields__}
    if isinstance(value, frozenset):
        value = sorted(value)
    if isinstance(value, str) and value:
        return f"`{value}`"
    return f"`{json.dumps(value, default=str)}`"
