"""Paths as they are typed."""

import os
from pathlib import Path
from typing import Any

import click

from flowlab.text import shown


class _Path(click.Path):
    """A path that is text and that a file system can have, there or not; another is told before it is looked for."""

    def __init__(self, *, on_hub: bool = False) -> None:
        super().__init__(path_type=Path)
        self._on_hub = on_hub

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if not self._on_hub and str(value).startswith("hub:") and not os.path.lexists(value):
            name = shown(str(value))
            self.fail(f"{name}: only 'flowlab train' takes names on the Hub; 'flowlab hub pull' it first", param, ctx)
        try:
            os.path.abspath(value).encode()  # whatever keeps a path, keeps it as text
            os.lstat(value)
        except (FileNotFoundError, NotADirectoryError):
            pass
        except (OSError, ValueError) as error:  # too long, a NUL or half a character in it, a folder that is locked
            reason = getattr(error, "strerror", None) or "it is no text in UTF-8, or has a NUL; rename it"
            self.fail(f"{shown(str(value))}: cannot be looked for ({reason})", param, ctx)
        return super().convert(value, param, ctx)


PATH = _Path()
"""The type of all arguments and options that are files or folders."""
PATH_OR_HUB = _Path(on_hub=True)
"""The same, where a dataset on the Hub may be named, too: ``hub:user/name``."""
