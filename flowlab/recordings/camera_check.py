"""Whether intrinsics can be those of the pictures, whatever else is stated: size, axis, field of view, lens."""

from collections.abc import Iterator

import numpy as np

from flowlab.errors import DataError
from flowlab.recordings.intrinsics import Intrinsics
from flowlab.recordings.lens import KNOWN, Lens, undistorted_rays
from flowlab.recordings.verdicts import Check, Verdict

_Size = tuple[int, int]
_MOST_PX = 1e7
"""No focal length or place in a picture is beyond this."""
_NORMALIZED = 10.0
"""A focal length of fewer pixels is not in pixels."""
_OFF_AXIS = (0.1, 0.2)
"""A principal point this far from the middle, of width or height, is doubtful, and refused."""
_UNEQUAL = (1.15, 2.5)
"""Where fx and fy differ by these factors they are doubtful, and refused."""
_VIEW_DEG = ((25.0, 125.0), (6.0, 165.0))
"""Fields of view outside of these are doubtful, and refused."""
_ALIKE = 1.05
"""Focal lengths that are one lens's agree to this factor."""
_MIDDLE = 0.08
"""A principal point this near the corner, of width and height, counts from the middle."""
_NEAR = 0.04
"""A principal point this far from the middle of pictures is theirs."""
_FACTORS = (1 / 8, 1 / 6, 1 / 5, 1 / 4, 1 / 3, 1 / 2, 2 / 3, 3 / 4, 4 / 3, 3 / 2, 2, 5 / 2, 3, 4, 5, 6, 20 / 3, 8)
"""By these pictures are shrunk, and enlarged."""
_MEANT = {
    (True, True, False): "are not in pixels but shares of the picture",
    (True, False, False): "are not in pixels but shares of the picture",
    (True, True, True): "are not in pixels from the picture's corner but shares of it from its middle",
    (False, True, False): "are not in pixels, as if in millimeters",
    (False, True, True): "are not in pixels from the picture's corner, as if in millimeters from its middle",
    (False, False, True): "count from the picture's middle, not from its corner",
}
"""What is said of numbers by whether they are shares, whether focal lengths are none in pixels, and the middle."""
_SWAPS = {
    "the focal lengths and the principal point": {"fx": "cx", "fy": "cy", "cx": "fx", "cy": "fy"},
    "fx and cx": {"fx": "cx", "cx": "fx"},
    "fy and cy": {"fy": "cy", "cy": "fy"},
    "cx and cy": {"cx": "cy", "cy": "cx"},
    "fy and cx": {"fy": "cx", "cx": "fy"},
}
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
    if max(map(abs, (given.fx, given.fy, given.cx, given.cy))) > _MOST_PX or min(given.fx, given.fy) < 1 / _MOST_PX:
        says = f"fx, fy, cx and cy are {given.fx:g}, {given.fy:g}, {given.cx:g} and {given.cy:g} px, as of no camera"
        yield Verdict.REFUSED, f"{says}; correct '{about}' in {write_to}"
        return
    for fault in (_not_in_pixels(given, size), _off_axis(given, size)):
        if fault is not None:
            yield fault[0], f"{fault[1]} write into {write_to} those of these pictures: '{about}: {fault[2]}'"
            return
    for fault in (_view(given, size, Verdict.REFUSED), _unequal(given), _view(given, size, Verdict.DOUBTFUL)):
        if fault is not None:
            yield fault[0], f"{fault[1]}; correct '{about}' in {write_to}: {fault[2]}"
            return


_Fault = tuple[Verdict, str, str]


def _not_in_pixels(given: Intrinsics, size: _Size) -> _Fault | None:
    """Numbers that are shares of the picture, or count from its middle, not pixels from its corner."""
    f_shares = max(given.fx, given.fy) < min(_NORMALIZED, size[0] / 4)
    c_shares = 0.2 < given.cx < 1 and 0.2 < given.cy < 1
    middle = not c_shares and max(abs(given.cx) / size[0], abs(given.cy) / size[1]) < _MIDDLE
    if not (f_shares or c_shares or middle):
        return None
    focal = _focal_px(given, size) if f_shares else (given.fx, given.fy)
    center = _center_px(given, size, c_shares or (middle and f_shares), middle)
    parts = [f"fx {given.fx:g} and fy {given.fy:g}"] * f_shares
    parts += [f"cx {given.cx:g} and cy {given.cy:g}"] * (c_shares or middle)
    says = f"{', '.join(parts)} {_MEANT[c_shares or (f_shares and focal is not None), f_shares, middle]}"
    f_px = "fx: ..., fy: ..." if focal is None else f"fx: {focal[0]:.6g}, fy: {focal[1]:.6g}"
    cx, cy = (_likely(c, own, side) for c, own, side in zip(center, (given.cx, given.cy), size, strict=True))
    return Verdict.REFUSED, f"{says};", f"{{{f_px}, cx: {cx}, cy: {cy}}}"


def _likely(c: float, own: float, side: int) -> str:
    """A coordinate of a principal point to write: as found, as given, or as a share, if one may be right."""
    found = next((x for x in (c, own, own * side - 0.5) if abs((x + 0.5) / side - 0.5) <= _OFF_AXIS[0]), None)
    return "..." if found is None else f"{found:.6g}"


def _focal_px(given: Intrinsics, size: _Size) -> tuple[float, float] | None:
    """Focal lengths in pixels of shares of both sides, of their halves or of one side; None where none is likely."""
    (w, h) = size
    options = [(given.fx * x, given.fy * y) for x, y in ((w, h), (w / 2, h / 2), (w, w), (h, h), (w / 2, w / 2))]
    likely = [o for o in options if max(o) / min(o) < _ALIKE and _within(o, size, _VIEW_DEG[0])]
    return likely[0] if likely else None


def _center_px(given: Intrinsics, size: _Size, shares: bool, middle: bool) -> tuple[float, float]:
    """The principal point in pixels of one in shares, of both sides or of one, or that counts from the middle."""
    (w, h), (cx, cy) = size, (given.cx, given.cy)
    if middle:
        return (cx * w if shares else cx) + (w - 1) / 2, (cy * h if shares else cy) + (h - 1) / 2
    if shares:
        options = [(cx * x - 0.5, cy * y - 0.5) for x, y in ((w, h), (w, w), (h, h))]
        return min(options, key=lambda c: abs(c[0] / w - 0.5) + abs(c[1] / h - 0.5))
    return cx, cy


def _off_axis(given: Intrinsics, size: _Size) -> _Fault | None:
    """A principal point far from the middle, and why that may be."""
    off = max(abs(given.cx / size[0] - 0.5), abs(given.cy / size[1] - 0.5))
    if given.cropped or off <= _OFF_AXIS[0]:
        return None
    says = f"the principal point ({given.cx:g}, {given.cy:g}) is far from the middle of pictures of {size[0]}x{size[1]}"
    for what, names in _SWAPS.items():
        values = given.model_dump()
        turned = given.model_copy(update={to: values[of] for to, of in names.items()})
        if min(turned.fx, turned.fy) > 0 and _is_usual(turned, size):
            return Verdict.REFUSED, f"{says}: {what} look swapped;", turned.to_yaml()
    verdict = Verdict.REFUSED if off > _OFF_AXIS[1] else Verdict.DOUBTFUL
    of = _size_of(given, size)
    if of is None:
        says += ", as of a part cut out of larger ones; if they are that, add 'cropped: true', else"
        return verdict, says, "{fx: ..., fy: ..., cx: ..., cy: ...}"
    whole = _same_shape(of, size)
    says = f"{says}, as of {'the same pictures in' if whole else 'pictures of'} {of[0]}x{of[1]};"
    return Verdict.REFUSED if whole else verdict, says, resized(given, of, size).to_yaml()


def _is_usual(given: Intrinsics, size: _Size) -> bool:
    """Whether intrinsics are those of a usual camera with pictures of a size."""
    alike = 1 / _UNEQUAL[0] < given.fx / given.fy < _UNEQUAL[0]
    return alike and _is_central(given, size, _NEAR) and _within((given.fx, given.fy), size, _VIEW_DEG[0])


def _size_of(given: Intrinsics, size: _Size) -> _Size | None:
    """The size of the pictures that intrinsics are of, by their principal point; None where that does not tell."""
    usual = [*((round(size[0] * k), round(size[1] * k)) for k in _FACTORS), *_SIZES]
    near = [of for of in usual if of != size and min(of) > 0 and _is_central(given, of, _NEAR / 2)]
    if near:
        return min(near, key=lambda of: (not _same_shape(of, size), abs((given.cx + 0.5) / of[0] - 0.5)))
    of = (round(2 * given.cx + 1), round(2 * given.cy + 1))
    x, y = of[0] / size[0], of[1] / size[1]
    whole = min(x, y) > 0 and abs(x / y - 1) < 2 * _NEAR
    return of if whole or (abs(min(x, y) - 1) < 2 * _NEAR and max(x, y) > 1) else None


def _unequal(given: Intrinsics) -> _Fault | None:
    """Focal lengths that differ too much for one lens."""
    ratio = max(given.fx, given.fy) / min(given.fx, given.fy)
    if ratio <= _UNEQUAL[0]:
        return None
    verdict = Verdict.REFUSED if ratio > _UNEQUAL[1] else Verdict.DOUBTFUL
    says = (f"fx {given.fx:g} and fy {given.fy:g} differ by {ratio - 1:.0%}, as if the pictures had been stretched, or "
            "the numbers were of other pictures")  # fmt: skip
    return verdict, says, "they are about equal for pictures that are not stretched"


def _view(given: Intrinsics, size: _Size, verdict: Verdict) -> _Fault | None:
    """A field of view that cameras do not have; fisheyes have any."""
    if given.lens is Lens.FISHEYE or _within((given.fx, given.fy), size, _VIEW_DEG[verdict is Verdict.REFUSED]):
        return None
    width, height = _view_deg(given.fx, given.fy, size)
    says = f"fx {given.fx:g} and fy {given.fy:g} px make a field of view of {width:.0f} x {height:.0f} degrees"
    return verdict, says, "focal lengths are in pixels of these pictures"


def _within(focal: tuple[float, float], size: _Size, limits: tuple[float, float]) -> bool:
    """Whether both fields of view lie between limits."""
    return all(limits[0] < view < limits[1] for view in _view_deg(*focal, size))


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


def _view_deg(fx: float, fy: float, size: _Size) -> tuple[float, float]:
    """Field of view, along both axes, of the ideal picture."""
    half = np.degrees(np.arctan([size[0] / (2 * fx), size[1] / (2 * fy)]))
    return 2 * float(half[0]), 2 * float(half[1])


def _as_it_is(about: str, given: Intrinsics, size: _Size) -> Check:
    """What is said of intrinsics that may be right."""
    width, height = _view_deg(given.fx, given.fy, size)
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
