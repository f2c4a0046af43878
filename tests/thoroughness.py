"""How many examples a property is tried on: a quarter of them in ``make test``, all in ``make test-all``."""

import os

THOROUGH = os.environ.get("FLOWLAB_TESTS") == "all"


def examples(count: int) -> int:
    """Examples to try of ``count``, at least 10 or all there are."""
    return count if THOROUGH else max(min(count, 10), count // 4)
