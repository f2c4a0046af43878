"""flowlab: 3D-flow datasets from robot demonstrations, and policies trained on them."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from flowlab.version import __version__

if TYPE_CHECKING:
    from flowlab import data
    from flowlab.deployment.policy import Policy
    from flowlab.evaluation.evaluate import evaluate
    from flowlab.training.train import TrainedRun, train

__all__ = ["Policy", "TrainedRun", "__version__", "data", "evaluate", "train"]

_LAZY = {
    "Policy": "flowlab.deployment.policy",
    "TrainedRun": "flowlab.training.train",
    "data": "flowlab",
    "evaluate": "flowlab.evaluation.evaluate",
    "train": "flowlab.training.train",
}
"""Where each public name lives: imported only when it is asked for, so that ``import flowlab`` is instant."""


def __getattr__(name: str) -> Any:
    """Import a public name when it is first asked for."""
    if name in _LAZY:
        if _LAZY[name] == "flowlab":
            return import_module(f"flowlab.{name}")
        return getattr(import_module(_LAZY[name]), name)
    raise AttributeError(f"module 'flowlab' has no attribute '{name}'")
