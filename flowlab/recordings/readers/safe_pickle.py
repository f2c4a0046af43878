"""Pickled numpy objects of others' calibrations, read without running what they may ask for."""

import io
import pickle
from pathlib import Path
from typing import Any

import numpy as np

from flowlab.errors import DataError

_ALLOWED = {
    *((f"numpy.{core}.multiarray", name) for core in ("core", "_core") for name in ("_reconstruct", "scalar")),
    *((f"numpy.{core}.numeric", "_frombuffer") for core in ("core", "_core")),
    ("numpy", "ndarray"),
    ("numpy", "dtype"),
    ("_codecs", "encode"),
    ("collections", "OrderedDict"),
}


class _Unpickler(pickle.Unpickler):
    """Makes arrays, numbers, text and mappings of them; a pickle that asks for more is refused."""

    def find_class(self, module: str, name: str) -> Any:
        """A class or function that may be used; all others are refused."""
        if (module, name) not in _ALLOWED:
            raise pickle.UnpicklingError(f"it asks for {module}.{name}")
        return super().find_class(module, name)


def load_pickled_mapping(path: Path) -> dict[str, Any]:
    """The mapping that ``numpy.save`` stored as an object; empty where there is no such file."""
    try:
        content = io.BytesIO(path.read_bytes())
        version = np.lib.format.read_magic(content)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        read(content)
        value = _Unpickler(content).load()
        found = value.item() if isinstance(value, np.ndarray) else value
    except FileNotFoundError:
        return {}
    except Exception as error:  # a damaged pickle raises anything
        raise DataError(f"{path}: cannot be read ({error}); expected a mapping of arrays by camera") from error
    if not isinstance(found, dict):
        raise DataError(f"{path}: holds a {type(found).__name__}, expected a mapping of arrays by camera")
    return {str(key): values for key, values in found.items()}
