"""flowlab: 3D-flow datasets from robot demonstrations, and policies trained on them."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from flowlab.version import __version__

if TYPE_CHECKING:
    from flowlab.deployment.policy import Policy
    from flowlab.evaluation.evaluate import evaluate

__all__ = ["Policy", "__version__", "evaluate"]

_LAZY = {"Policy": "flowlab.deployment.policy", "evaluate": "flowlab.evaluation.evaluate"}
"""Where each public name lives: imported only when it is asked for, so that ``import flowlab`` is instant."""


def __getattr__(name: str) -> Any:
    """Import a public name when it is first asked for."""
    if name in _LAZY:
        return getattr(import_module(_LAZY[name]), name)
    raise AttributeError(f"module 'flowlab' has no attribute '{name}'")
