"""What Open3D's recorder and bag reader write beside pictures: ``intrinsic.json``; and what others add to it."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flowlab.errors import DataError, first_line
from flowlab.recordings.intrinsics import Intrinsics, distortion_of, is_transposed
from flowlab.recordings.recording_yaml import FILE_NAME, Metadata
from flowlab.recordings.unused_files import unread_keys
from flowlab.recordings.verdicts import Check
from flowlab.text import cut, shown
from flowlab.untrusted import read_json

FILES = ("intrinsic.json", "camera_intrinsic.json")
_KNOWN = {
    "width", "height", "intrinsic_matrix", "depth_scale", "fps", "color_format", "depth_format", "device_name",
    "serial_number", "stream_length_usec", "class_name", "version_major", "version_minor",
}  # fmt: skip
"""The keys of Open3D."""
_DISTORTION = re.compile(r"(lens_?)?dist(ortion)?(_?(coeff(icient)?s?|params?|parameters?))?|(dist_?)?coeffs?|d")
_MODEL = re.compile(r"(lens_?|dist(ortion)?_?|camera_?)?(model|type)")
_ONE = re.compile(r"[kp][1-6]")
_ORDER = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_GEOMETRY = re.compile(
    r"dist|lens|model|skew|rect|extrin|pose|transform|matrix|offset|unit|scale|crop|roi|bin|^[a-z]\d?$"
)
"""What keys have in their names that may matter to where things are."""


def open3d_calibration(
    path: Path, ignore: Sequence[str]
) -> tuple[tuple[tuple[str, Metadata], ...], tuple[Check, ...], tuple[str, ...]]:
    """What the file tells of a recording's camera, what is to be said of keys that are not read, and these."""
    name = next((name for name in FILES if (path / name).is_file()), None)
    if name is None:
        return (), (), ()
    file = path / name
    values = read_json(file, f"give 'intrinsics' in {FILE_NAME}")
    try:
        K = np.array(values["intrinsic_matrix"], float).reshape(3, 3)
        K = K.T if is_transposed(K) else K  # Open3D writes it by columns, others nest its rows
        size = {"width": int(values["width"]), "height": int(values["height"])}
        lens, used = _lens(values)
        found = {"intrinsics": Intrinsics.from_matrix(K, **size, **lens)}
        scale = values.get("depth_scale")
        extra = {"fps": values.get("fps"), "depth_unit_m": float(f"{1 / scale:.6g}") if scale else None}
        known = ((name, Metadata(**found, **{k: v for k, v in extra.items() if v})),)
    except (AttributeError, ValueError, KeyError, TypeError, ArithmeticError) as error:
        raise DataError(
            f"{file}: is not what Open3D writes ({first_line(error)}); give 'intrinsics' in {FILE_NAME}"
        ) from error
    unread = {*map(str, values)} - _KNOWN - used
    matter = sorted(key for key in unread if _GEOMETRY.search(key.lower()))
    advice = f"; what {cut(', '.join(matter))} says of the camera goes into {FILE_NAME}" if matter else ""
    return known, tuple(unread_keys(name, unread, advice, ignore)), tuple(f"{name}:{key}" for key in sorted(unread))


def _lens(values: Mapping[str, Any]) -> tuple[dict[str, Any], set[str]]:
    """The distortion under whatever name, as keys of intrinsics; and the names that were used for it."""
    by_plain = {re.sub(r"[^a-z0-9]+", "_", str(key).lower()): key for key in values}
    lists = [key for plain, key in by_plain.items() if _DISTORTION.fullmatch(plain) and values[key] is not None]
    models = [key for plain, key in by_plain.items() if _MODEL.fullmatch(plain) and isinstance(values[key], str)]
    single = {plain: key for plain, key in by_plain.items() if _ONE.fullmatch(plain)}
    given: Any = [values[single[n]] if n in single else 0.0 for n in _ORDER] if single else []
    for key in lists:
        given = values[key]
        if isinstance(given, Mapping):
            inner, _ = _lens(given)
            return inner, {str(key)}
    if len(lists) > 1 or (lists and single):
        raise ValueError(f"has several distortions, {shown([*lists, *single])}")
    coefficients = np.array(given, float).ravel().tolist()
    model = values[models[0]] if models else None
    return distortion_of(model, coefficients), {str(key) for key in (*lists, *models, *single.values())}
