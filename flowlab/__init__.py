"""flowlab: 3D-flow datasets from robot demonstrations, and policies trained on them."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from flowlab.evaluation.robot import Policy

__version__ = "0.1.0"
__all__ = ["Policy", "__version__"]


def __getattr__(name: str) -> Any:
    """Imports what is large only when it is asked for, so that the command line starts at once."""
    if name == "Policy":
        from flowlab.evaluation.robot import Policy

        return Policy
    raise AttributeError(f"module 'flowlab' has no attribute '{name}'")
