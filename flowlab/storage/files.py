"""Small files that are either there and whole, or not there."""

import json
import os
from pathlib import Path
from typing import Any

from flowlab.errors import DataError


def write_whole(path: Path, text: str) -> None:
    """Replace a file in one step."""
    temporary = path.with_name(f".tmp-{os.getpid()}-{path.name}")
    try:
        temporary.write_text(text)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_json(path: Path, values: Any) -> None:
    """Replace a JSON file in one step; the same values give the same bytes."""
    write_whole(path, json.dumps(values, indent=1) + "\n")


def read_json(path: Path) -> Any:
    """The values of a JSON file."""
    try:
        return json.loads(path.read_text())
    except FileNotFoundError as error:
        raise DataError(f"{path}: there is no such file") from error
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: not valid JSON ({error}); restore it or extract again into a new folder") from error
