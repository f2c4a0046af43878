"""What a pose of a camera may be meant as, where it is not what it must be: camera to world, in OpenCV's axes."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from flowlab.geometry.transforms import inverse

_OPENGL = np.diag([1.0, -1, -1, 1])
_BODY = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""From x right, y down, z forward to the axes of a robot's body: x forward, y left, z up."""

READINGS: dict[str, Callable[[Float[np.ndarray, "*batch 4 4"]], Float[np.ndarray, "*batch 4 4"]]] = {
    "the inverse, world to camera": inverse,
    "in OpenGL's axes (y up, z backward)": lambda T: T @ _OPENGL,
    "the inverse, in OpenGL's axes": lambda T: inverse(T) @ _OPENGL,
    "that of a body (x forward, y left, z up)": lambda T: T @ _BODY,
    "the inverse of a body's (x forward, y left, z up)": lambda T: inverse(T) @ _BODY,
}
"""In words that follow "if it were": the pose camera to world that a matrix would then be. The inverse of one in
OpenGL's axes is "the inverse, in OpenGL's axes", too: these axes are their own inverse."""
