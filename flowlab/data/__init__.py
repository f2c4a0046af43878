"""From datasets to what training sees. :class:`Windows` is for anybody's own training loop."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from flowlab.data.windows import Windows

__all__ = ["Windows"]


def __getattr__(name: str) -> Any:
    """Import what needs torch when it is first asked for."""
    if name == "Windows":
        from flowlab.data.windows import Windows

        return Windows
    raise AttributeError(f"module 'flowlab.data' has no attribute '{name}'")
