"""Where this machine keeps what can be made again: decoded datasets, extracted bags."""

import os
from pathlib import Path


def user_cache() -> Path:
    """``$FLOWLAB_CACHE``, else ``$XDG_CACHE_HOME/flowlab``, else ``~/.cache/flowlab``; it need not be there.

    Raises:
        OSError: Nothing tells where the user's home is.
    """
    below = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    try:
        return Path(os.environ.get("FLOWLAB_CACHE") or Path(below, "flowlab")).expanduser().absolute()
    except RuntimeError as error:
        raise OSError(None, "there is no home folder; set FLOWLAB_CACHE") from error
