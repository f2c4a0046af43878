"""A camera as it was calibrated: its matrix, the size of its pictures, its lens."""

from collections.abc import Sequence
from typing import Annotated, Any

import numpy as np
from jaxtyping import Num
from pydantic import AfterValidator, ConfigDict, Field, model_validator

from flowlab.config import Settings, SettingsError
from flowlab.limits import MAX_PIXELS
from flowlab.recordings.lens import Lens, lens_of
from flowlab.text import shown

_COUNTS = (0, 4, 5, 8, 12, 14)


class FiniteSettings(Settings):
    """Settings whose numbers are finite, and no ``true`` that would be taken for 1."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _no_truths(cls, values: Any) -> Any:
        if isinstance(values, dict):
            for name, value in values.items():
                field = cls.model_fields.get(name)
                if field is not None and field.annotation is not bool and _holds_truth(value):
                    raise ValueError(f"'{name}' holds true or false, expected numbers or words")
        return values


def _holds_truth(value: Any) -> bool:
    """Whether a value of YAML is ``true`` or ``false``, or a list of some depth that holds one."""
    return isinstance(value, bool) or (isinstance(value, list) and any(map(_holds_truth, value)))


def _coefficients(values: tuple[float, ...]) -> tuple[float, ...]:
    """Refuse numbers of coefficients that no model has."""
    if len(values) not in _COUNTS:
        raise ValueError(f"has {len(values)} coefficients, expected 4, 5, 8, 12 or 14, in OpenCV's order")
    return values


class Intrinsics(FiniteSettings):
    """A camera, pixel centers at integer coordinates; a mapping of its numbers, or its matrix as nested rows."""

    fx: float = Field(gt=0)
    """[px]"""
    fy: float = Field(gt=0)
    """[px]"""
    cx: float
    """[px]"""
    cy: float
    """[px]"""
    width: int | None = Field(default=None, gt=0, le=MAX_PIXELS)
    """Of the pictures that the numbers belong to [px]."""
    height: int | None = Field(default=None, gt=0, le=MAX_PIXELS)
    """[px]"""
    distortion: Annotated[tuple[float, ...], AfterValidator(_coefficients)] = ()
    """Coefficients in the order of the model; the pictures are undistorted where there are any."""
    distortion_model: str | None = Field(default=None, max_length=200)
    """Its name, as ROS, OpenCV and RealSense have them; without one the coefficients are k1, k2, p1, p2, k3, ..."""
    cropped: bool = False
    """Whether the pictures are a part of what the camera sees, so that its axis may lie far from their middle."""

    @model_validator(mode="before")
    @classmethod
    def _from_rows(cls, values: Any) -> Any:
        """A matrix, where there are rows instead of names."""
        if not isinstance(values, list | tuple):
            return values
        try:
            K = np.array(values, float)
        except (TypeError, ValueError):
            K = np.empty(0)
        return focal_lengths(K)

    @property
    def K(self) -> np.ndarray:
        """The matrix (3, 3) [px]."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], float)

    @property
    def lens(self) -> Lens | None:
        """The family of its distortion, None without any. Raises :class:`DataError` where that is not known."""
        return lens_of(self.distortion_model, self.distortion)

    @classmethod
    def from_matrix(cls, K: Num[np.ndarray, "_ _"], **others: Any) -> "Intrinsics":
        """From a matrix (3, 3), (3, 4) or (4, 4) [px]."""
        try:
            return cls(**focal_lengths(np.asarray(K, float)), **others)
        except SettingsError:
            raise
        except ValueError as error:
            raise SettingsError(f"the intrinsics: {error}") from error

    def to_yaml(self) -> str:
        """One line of YAML."""
        values = self.model_dump(exclude_defaults=True)
        order = [k for k in ("width", "height", "fx", "fy", "cx", "cy", *values) if k in values]
        return "{" + ", ".join(f"{k}: {_plain(values[k])}" for k in dict.fromkeys(order)) + "}"


def distortion_of(model: str | None, coefficients: Sequence[float]) -> dict[str, Any]:
    """The keys of a distortion, filled up with zeros to a number of coefficients that a model has; none for none."""
    found = [float(x) for x in coefficients]
    if not any(found):
        return {}
    count = next((n for n in _COUNTS if n >= len(found)), len(found))
    return {"distortion": (*found, *[0.0] * (count - len(found))), "distortion_model": model}


def focal_lengths(K: Num[np.ndarray, "..."]) -> dict[str, float]:
    """Focal lengths and principal point of a matrix. Raises :class:`ValueError` for what is no matrix of intrinsics."""
    how = "expected rows [fx, 0, cx], [0, fy, cy], [0, 0, 1]; write '{fx: ..., fy: ..., cx: ..., cy: ...}'"
    if K.shape not in ((3, 3), (3, 4), (4, 4)):
        raise ValueError(f"is no matrix (3, 3), (3, 4) or (4, 4) but has the shape {K.shape}; {how}")
    M, scale = K[:3, :3], np.abs(K).max()
    if not np.isfinite(K).all() or not scale:
        raise ValueError(f"has numbers that are not finite, or only zeros; {how}")
    if is_transposed(M):
        fx, cx, fy, cy = M[0, 0], M[2, 0], M[1, 1], M[2, 1]
        raise ValueError(f"is transposed; write '{{fx: {fx:g}, fy: {fy:g}, cx: {cx:g}, cy: {cy:g}}}'")
    rest = np.array([M[0, 1], M[1, 0], M[2, 0], M[2, 1], *(K[3, :3] if len(K) == 4 else ())])
    if np.abs(rest).max() > 1e-3 * scale or abs(M[2, 2] - 1) > 1e-6:
        raise ValueError(f"is {shown(K.tolist())}, no pinhole camera without skew; {how}")
    return {"fx": float(M[0, 0]), "fy": float(M[1, 1]), "cx": float(M[0, 2]), "cy": float(M[1, 2])}


def is_transposed(M: Num[np.ndarray, "3 3"]) -> bool:
    """Whether a matrix of intrinsics has its principal point in the last row instead of the last column."""
    return bool(M[2, 2] == 1 and not M[:2, 2].any() and M[2, :2].any())


def _plain(value: Any) -> str:
    """A value as YAML has it."""
    if isinstance(value, bool):
        return str(value).lower()
    return f"[{', '.join(map(repr, value))}]" if isinstance(value, tuple) else str(value)
