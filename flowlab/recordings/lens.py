"""Lens distortion: which models are known by which names, and how pixels are straightened by each."""

from enum import StrEnum

import cv2
import numpy as np
from jaxtyping import Float, Float64

from flowlab.errors import DataError
from flowlab.text import shown

Maps = tuple[np.ndarray, np.ndarray]


class Lens(StrEnum):
    """Families of distortion models, by how they are computed."""

    PINHOLE = "pinhole"
    """OpenCV's k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4, tx, ty, as far as they are given."""
    FISHEYE = "fisheye"
    """OpenCV's ``cv2.fisheye``: k1, k2, k3, k4 of the angle."""
    INVERSE = "inverse"
    """RealSense's: k1, k2, p1, p2, k3 that lead from the distorted to the ideal picture."""


COUNTS = {Lens.PINHOLE: (4, 5, 8, 12, 14), Lens.FISHEYE: (4,), Lens.INVERSE: (4, 5)}
"""How many coefficients each may have."""
_NAMES = {
    Lens.PINHOLE: (
        "pinhole", "opencv", "plumb_bob", "brown", "brown_conrady", "radtan", "radial_tangential",
        "rational_polynomial", "rational", "thin_prism", "rational_polynomial_thin_prism", "tilted",
        "modified_brown_conrady",
    ),
    Lens.FISHEYE: ("fisheye", "opencv_fisheye", "equidistant", "equi", "kannala_brandt", "kannala_brandt4"),
    Lens.INVERSE: ("inverse_brown_conrady",),
}  # fmt: skip
_BY_NAME = {name: lens for lens, names in _NAMES.items() for name in names}
_NONE = ("", "none", "perfect_pinhole", "no_distortion", "undistorted")
KNOWN = "plumb_bob, rational_polynomial, thin_prism, tilted, equidistant (fisheye), inverse_brown_conrady"
"""The names that messages suggest."""
_STEPS = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 200, 1e-10)


def lens_of(model: str | None, coefficients: tuple[float, ...]) -> Lens | None:
    """The family of a model by its name in any spelling; None for a lens that does not distort.

    Args:
        model: Its name; None where only the coefficients are given, which are then OpenCV's of a pinhole.
        coefficients: In the order of the model.

    Raises:
        DataError: There is no such model, or it has another number of coefficients; the message lists the names.
    """
    if not any(coefficients):
        return None
    name = "pinhole" if model is None else model.strip().lower().replace(" ", "_").replace("-", "_")
    name = name.removeprefix("distortion.")
    lens = _BY_NAME.get(name)
    if lens is None:
        said = f"the distortion model {shown(model)} is not known" if name not in _NONE else (
            f"its distortion model is {shown(model)}, and yet it has coefficients that are not zero")  # fmt: skip
        raise DataError(f"{said}; write 'distortion_model' with one of {KNOWN}, or 'distortion: []' for none")
    if len(coefficients) not in COUNTS[lens] and any(coefficients[max(COUNTS[lens]) :]):
        counts = ", ".join(map(str, COUNTS[lens]))
        raise DataError(f"distortion has {len(coefficients)} coefficients, and {name} has {counts}")
    if name == "modified_brown_conrady" and any(coefficients[2:4]):
        raise DataError(
            "modified_brown_conrady with tangential coefficients is none of OpenCV's models; calibrate the camera "
            f"anew, and write 'distortion_model' with one of {KNOWN}"
        )
    return lens


def padded(lens: Lens, coefficients: tuple[float, ...]) -> Float64[np.ndarray, "C"]:
    """As many coefficients as OpenCV takes, the others zero."""
    count = next((n for n in COUNTS[lens] if n >= len(coefficients)), max(COUNTS[lens]))
    found = np.zeros(count)
    found[: len(coefficients[:count])] = coefficients[:count]
    return found


def undistortion_maps(lens: Lens, K: np.ndarray, coefficients: tuple[float, ...], size: tuple[int, int]) -> Maps:
    """Where to look in the distorted picture for every pixel of the ideal one of the same intrinsics."""
    D = padded(lens, coefficients)
    if lens is Lens.PINHOLE:
        return cv2.initUndistortRectifyMap(K, D, np.eye(3), K, size, cv2.CV_32FC1)
    if lens is Lens.FISHEYE:
        return cv2.fisheye.initUndistortRectifyMap(K, D, np.eye(3), K, size, cv2.CV_32FC1)
    pixels = np.stack(np.meshgrid(np.arange(size[0]), np.arange(size[1])), -1).reshape(-1, 1, 2).astype(float)
    # What leads from distorted to ideal is inverted as OpenCV inverts what leads from ideal to distorted.
    bent = _straightened(pixels, K, D, K).reshape(size[1], size[0], 2)
    return bent[..., 0].astype(np.float32), bent[..., 1].astype(np.float32)


def undistorted_rays(
    lens: Lens | None, K: np.ndarray, coefficients: tuple[float, ...], pixels: Float[np.ndarray, "*N 2"]
) -> Float64[np.ndarray, "*N 2"]:
    """x / z and y / z of what is seen at pixels of the distorted picture."""
    flat = pixels.reshape(-1, 1, 2).astype(np.float64)
    straight = (flat - K[:2, 2]) / K[[0, 1], [0, 1]]
    if lens is Lens.PINHOLE:
        straight = _straightened(flat, K, padded(lens, coefficients), np.eye(3))
    elif lens is Lens.FISHEYE:
        straight = cv2.fisheye.undistortPoints(flat, K, padded(lens, coefficients))
    elif lens is Lens.INVERSE:
        rays = np.concatenate([straight, np.ones((len(flat), 1, 1))], -1)
        straight, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), np.eye(3), padded(lens, coefficients))
    return np.asarray(straight, np.float64).reshape(pixels.shape)


def _straightened(pixels: np.ndarray, K: np.ndarray, D: np.ndarray, P: np.ndarray) -> np.ndarray:
    """Ideal points of distorted ones, to well below a pixel; OpenCV 4 has a function of its own for that."""
    if hasattr(cv2, "undistortPointsIter"):
        return cv2.undistortPointsIter(pixels, K, D, np.eye(3), P, _STEPS)
    return cv2.undistortPoints(pixels, K, D, None, np.eye(3), P, _STEPS)
