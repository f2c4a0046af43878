"""Whether intrinsics can be those of the pictures, whatever else is stated: size, axis, field of view, lens."""

from collections.abc import Iterator

import numpy as np

from flowlab.errors import DataError
from flowlab.recordings.intrinsics import Intrinsics
from flowlab.recordings.lens import KNOWN, Lens, undistorted_rays
from flowlab.recordings.verdicts import Check, Verdict

_Size = tuple[int, int]
_NORMALIZED = 10.0
"""A focal length of fewer pixels is not in pixels."""
_OFF_AXIS = (0.1, 0.2)
"""A principal point this far from the middle, of width or height, is doubtful, and refused."""
_CLOSE = 0.05
"""A principal point this far from the middle is in it."""
_UNEQUAL = (1.15, 2.5)
"""Where fx and fy differ by these factors they are doubtful, and refused."""
_VIEW_DEG = ((25.0, 125.0), (6.0, 165.0))
"""Fields of view outside of these are doubtful, and refused."""
_SIZES = (
    (1920, 1080), (1280, 720), (960, 540), (848, 480), (640, 480), (640, 360), (512, 424), (480, 270), (424, 240),
    (320, 240), (1280, 800), (2048, 1536), (1920, 1440), (1440, 1080), (1280, 960), (1024, 768), (2560, 1440),
    (3840, 2160),
)  # fmt: skip
"""Sizes that cameras have, to say which one intrinsics may be of."""


def check_camera(about: str, given: Intrinsics, size: _Size, write_to: str) -> list[Check]:
    """What speaks for and against intrinsics of pictures of a size.

    Args:
        about: The key of ``recording.yaml`` that they are.
        given: The intrinsics.
        size: Width and height of the pictures [px].
        write_to: Where the user is to correct them.

    Returns:
        One check, or one for each thing that is doubtful or refused.
    """
    found = [Check(about, verdict, says) for verdict, says in _faults(about, given, size, write_to)]
    return found or [_as_it_is(about, given, size)]


def _faults(about: str, given: Intrinsics, size: _Size, write_to: str) -> Iterator[tuple[Verdict, str]]:
    """What is doubtful, or refused, of which only the first is said: the others follow from it."""
    try:
        given.lens  # noqa: B018
    except DataError as error:
        yield Verdict.REFUSED, f"{error}, in '{about}' in {write_to}"
        return
    of = (given.width or size[0], given.height or size[1])
    if of != size:
        yield Verdict.REFUSED, _other_size(about, given, of, size, write_to)
        return
    yield from _likely_faults(about, given, size, write_to)


def _likely_faults(about: str, given: Intrinsics, size: _Size, write_to: str) -> Iterator[tuple[Verdict, str]]:
    """The worst of what speaks against the numbers themselves, the first of several."""
    found = [
        (fault[0], f"{fault[1]}; write into {write_to} those of these pictures: '{about}: {fault[2]}'")
        for fault in (_normalized(about, given, size), _off_axis(about, given, size), _swapped(about, given))
        if fault is not None
    ]
    view = _view(about, given, size, write_to)
    found += [] if view is None else [view]
    yield from [fault for fault in found if fault[0] is Verdict.REFUSED][:1] or found[:1]


def _view(about: str, given: Intrinsics, size: _Size, write_to: str) -> tuple[Verdict, str] | None:
    """A field of view that no lens has, or few."""
    width, height = _view_deg(given, size)
    if given.lens is Lens.FISHEYE:
        return None
    for verdict, (low, high) in zip((Verdict.REFUSED, Verdict.DOUBTFUL), _VIEW_DEG[::-1], strict=True):
        if not (low < width < high and low < height < high):
            return verdict, (f"fx {given.fx:g} and fy {given.fy:g} px make a field of view of {width:.0f} x "
                             f"{height:.0f} degrees; correct '{about}' in {write_to}")  # fmt: skip
    return None


_Fault = tuple[Verdict, str, str]


def _normalized(about: str, given: Intrinsics, size: _Size) -> _Fault | None:
    """Numbers that are shares of the picture, not pixels."""
    if max(given.fx, given.fy) >= min(_NORMALIZED, size[0] / 4) or not (abs(given.cx) < 2 and abs(given.cy) < 2):
        return None
    pixels = _scaled(given, (1, 1), size, center=0.0)
    says = f"fx {given.fx:g} and cx {given.cx:g} are not in pixels but shares of the picture"
    return Verdict.REFUSED, says, pixels.to_yaml()


def _off_axis(about: str, given: Intrinsics, size: _Size) -> _Fault | None:
    """A principal point far from the middle, and why that may be."""
    off = max(abs(given.cx / size[0] - 0.5), abs(given.cy / size[1] - 0.5))
    if given.cropped or off <= _OFF_AXIS[0]:
        return None
    says = f"the principal point ({given.cx:g}, {given.cy:g}) is far from the middle of pictures of {size[0]}x{size[1]}"
    turned = given.model_copy(update={"fx": given.cx, "cx": given.fx, "fy": given.cy, "cy": given.fy})
    if given.cx > 0 and given.cy > 0 and _is_central(turned, size) and not _UNEQUAL[0] < given.cx / given.cy:
        return Verdict.REFUSED, f"{says}: the focal lengths and the principal point look swapped", turned.to_yaml()
    half = given.model_copy(update={"fx": given.cx, "cx": given.fx})
    if given.cx > 0 and _is_central(half, size) and 1 / _UNEQUAL[0] < given.cx / given.fy < _UNEQUAL[0]:
        return Verdict.REFUSED, f"{says}: fx and cx look swapped", half.to_yaml()
    crossed = given.model_copy(update={"cx": given.cy, "cy": given.cx})
    if _is_central(crossed, size, _CLOSE):
        return Verdict.REFUSED, f"{says}: cx and cy look swapped", crossed.to_yaml()
    of = min(_SIZES, key=lambda s: abs(given.cx / s[0] - 0.5) + abs(given.cy / s[1] - 0.5))
    verdict = Verdict.REFUSED if off > _OFF_AXIS[1] else Verdict.DOUBTFUL
    whole = _whole(given, size)
    if whole is not None:
        says = f"{says}, as of the same pictures in {whole[0]}x{whole[1]}"
        return Verdict.REFUSED, says, _scaled(given, whole, size).to_yaml()
    if of == size or not _is_central(given, of, 0.06):
        hint = given.model_copy(update={"width": size[0], "height": size[1], "cropped": True})
        return verdict, f"{says}, as of a part cut out of larger ones ('cropped: true')", hint.to_yaml()
    says = f"{says}, as of pictures of {of[0]}x{of[1]}"
    return verdict, says, resized(given, of, size).to_yaml()


def _whole(given: Intrinsics, size: _Size) -> _Size | None:
    """The size in which pictures of this shape would have the principal point in the middle, where that is another."""
    factors = [(given.cx + 0.5) / (size[0] / 2), (given.cy + 0.5) / (size[1] / 2)]
    factor = sum(factors) / 2
    factor = round(4 * factor) / 4 if abs(round(4 * factor) / (4 * factor) - 1) < _CLOSE / 2 else factor
    if min(factors) <= 0 or abs(factors[0] / factors[1] - 1) > 2 * _CLOSE or abs(factor - 1) <= 2 * _OFF_AXIS[0]:
        return None
    whole = round(size[0] * factor), round(size[1] * factor)
    return whole if 10 * max(given.fx, given.fy) > max(whole) else None


def _swapped(about: str, given: Intrinsics) -> _Fault | None:
    """Focal lengths that differ too much for one lens."""
    ratio = max(given.fx, given.fy) / min(given.fx, given.fy)
    if ratio <= _UNEQUAL[0]:
        return None
    verdict = Verdict.REFUSED if ratio > _UNEQUAL[1] else Verdict.DOUBTFUL
    says = (f"fx {given.fx:g} and fy {given.fy:g} differ by {ratio - 1:.0%}, as if the pictures had been stretched, or "
            "the numbers were of other pictures")  # fmt: skip
    return verdict, says, "{fx: ..., fy: ..., cx: ..., cy: ...}"


def _is_central(given: Intrinsics, size: _Size, share: float = _OFF_AXIS[0]) -> bool:
    """Whether the principal point is near the middle of pictures of a size."""
    return max(abs((given.cx + 0.5) / size[0] - 0.5), abs((given.cy + 0.5) / size[1] - 0.5)) <= share


def _other_size(about: str, given: Intrinsics, of: _Size, size: _Size, write_to: str) -> str:
    """What is said of intrinsics for pictures of another size."""
    how = "if they were shrunk as a whole"
    if not _same_shape(of, size):
        how = "if the camera cuts the edges off, as cameras with sizes of several shapes do"
    return (f"the intrinsics are for pictures of {of[0]}x{of[1]}, but these have {size[0]}x{size[1]}; "
            f"{how}, write into {write_to}: '{about}: {resized(given, of, size).to_yaml()}'")  # fmt: skip


def _same_shape(a: _Size, b: _Size) -> bool:
    return abs(a[0] * b[1] / (a[1] * b[0]) - 1) < 0.01


def resized(given: Intrinsics, of: _Size, size: _Size) -> Intrinsics:
    """Intrinsics in another size: of the same picture, or of its middle where it has another shape."""
    if _same_shape(of, size):
        return _scaled(given, of, size)
    scale = max(size[0] / of[0], size[1] / of[1])
    whole = (of[0] * scale, of[1] * scale)
    cut = [(w - s) / 2 for w, s in zip(whole, size, strict=True)]
    scaled = _scaled(given, of, whole)
    return scaled.model_copy(
        update={
            "width": size[0],
            "height": size[1],
            "cx": round(scaled.cx - cut[0], 6),
            "cy": round(scaled.cy - cut[1], 6),
        }
    )


def _scaled(given: Intrinsics, of: _Size, size: tuple[float, float], center: float = 0.5) -> Intrinsics:
    """Intrinsics of the same pictures in another size; ``center`` is where the center of the first pixel lies."""
    x, y = size[0] / of[0], size[1] / of[1]
    return given.model_copy(
        update={
            "width": round(size[0]),
            "height": round(size[1]),
            "fx": round(given.fx * x, 6),
            "fy": round(given.fy * y, 6),
            "cx": round((given.cx + center) * x - 0.5, 6),
            "cy": round((given.cy + center) * y - 0.5, 6),
        }
    )


def _view_deg(given: Intrinsics, size: _Size) -> tuple[float, float]:
    """Field of view, along both axes, of the ideal picture."""
    half = np.degrees(np.arctan([size[0] / (2 * given.fx), size[1] / (2 * given.fy)]))
    return 2 * float(half[0]), 2 * float(half[1])


def _as_it_is(about: str, given: Intrinsics, size: _Size) -> Check:
    """What is said of intrinsics that may be right."""
    width, height = _view_deg(given, size)
    says = (f"fx {given.fx:.5g}, fy {given.fy:.5g}, a field of view of {width:.0f} x {height:.0f} degrees, the "
            f"principal point at {given.cx / size[0]:.0%} and {given.cy / size[1]:.0%} of the picture; ")  # fmt: skip
    if given.lens is None:
        return Check(about, Verdict.OK, f"{says}no distortion")
    bend = _bend_px(given, size)
    says += f"distortion {given.distortion_model or 'of a pinhole'} of {len(given.distortion)} coefficients"
    if given.distortion_model is None and len(given.distortion) == 4:
        says += f", taken as k1, k2, p1, p2 (else write 'distortion_model' with one of {KNOWN})"
        return Check(about, Verdict.ASSUMED, f"{says}, up to {bend:.0f} px, is taken out")
    return Check(about, Verdict.OK, f"{says}, up to {bend:.0f} px, is taken out")


def _bend_px(given: Intrinsics, size: _Size) -> float:
    """How far the lens moves what is seen, at most [px]."""
    u, v = np.meshgrid(np.linspace(0, size[0] - 1, 9), np.linspace(0, size[1] - 1, 9))
    pixels = np.stack([u, v], -1).reshape(-1, 2)
    rays = undistorted_rays(given.lens, given.K, given.distortion, pixels)
    moved = np.linalg.norm(rays * [given.fx, given.fy] + [given.cx, given.cy] - pixels, axis=1)
    return float(np.nanmax(np.where(np.isfinite(moved), moved, np.nan), initial=0))
