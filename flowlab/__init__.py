"""flowlab: 3D-flow datasets from robot demonstrations, and policies trained on them."""

__version__ = "0.1.0"
