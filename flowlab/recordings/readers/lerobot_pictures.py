"""Pictures of a LeRobot episode: embedded in its table or frames of a video; depth of any code as distances."""

import math
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, Num, UInt8, UInt16

from flowlab.errors import DataError, FlowlabError
from flowlab.recordings.base import BadImage, ImageStream
from flowlab.recordings.depth_unit_check import CUSTOM
from flowlab.recordings.image_files import check_depth, decode_color, decode_depth
from flowlab.recordings.readers.lerobot_episodes import LeRobotEpisode
from flowlab.recordings.readers.lerobot_info import LeRobotFeature
from flowlab.recordings.readers.lerobot_process import ask, decode_tiff
from flowlab.recordings.recording_yaml import Metadata
from flowlab.recordings.stamps import Timing
from flowlab.recordings.verdicts import Check, Verdict
from flowlab.text import shown

NEAREST = 0.25
"""A frame of a video is that of a step where it is off by less than this share of the period of the pictures."""
_LAST_CODE = 4095
_UNITS = {"m": 1.0, "mm": 0.001}
_TIFF = (b"II*\0", b"MM\0*")


@dataclass(frozen=True, slots=True)
class DepthCode:
    """How distances become the codes of a depth video, from 0 to 4095."""

    depth_min: float = 0.01
    """[m]"""
    depth_max: float = 10.0
    """[m]"""
    shift: float = 3.5
    """Added before the logarithm is taken [m]."""
    use_log: bool = True

    @property
    def fault(self) -> str:
        """Why it is none; empty where it is one."""
        numbers = (self.depth_min, self.depth_max, self.shift)
        if not all(math.isfinite(x) for x in numbers) or not 0 <= self.depth_min < self.depth_max <= 1e4:
            found = f"depth_min {self.depth_min:g} and depth_max {self.depth_max:g}"
            return f"{found}, expected 0 <= depth_min < depth_max [m]"
        return (
            f"shift {self.shift:g}, expected more than -depth_min"
            if self.use_log and self.depth_min + self.shift <= 0
            else ""
        )

    def meters(self, codes: UInt16[np.ndarray, "..."]) -> Num[np.ndarray, "..."]:
        """Distances [m]; 0 for the first and the last code, into which everything nearer and farther was put."""
        low, high = (math.log(x + self.shift) if self.use_log else x for x in (self.depth_min, self.depth_max))
        value = low + codes.astype(np.float64) * ((high - low) / _LAST_CODE)
        value = np.exp(value) - self.shift if self.use_log else value
        return np.where((codes > 0) & (codes < _LAST_CODE), value, 0).astype(np.float32)

    def step_m(self, depth_m: float) -> float:
        """How far apart two codes are at a distance [m]."""
        span = (self.depth_max + self.shift) / (self.depth_min + self.shift)
        return (
            (depth_m + self.shift) * math.log(span) / _LAST_CODE
            if self.use_log
            else (self.depth_max - self.depth_min) / _LAST_CODE
        )


@dataclass(frozen=True, slots=True)
class LeRobotPictures:
    """The pictures of one feature in an episode."""

    stream: ImageStream
    known: tuple[tuple[str, Metadata], ...] = ()
    checks: tuple[Check, ...] = ()


def read_pictures(one: LeRobotEpisode, feature: LeRobotFeature, first: int, time_s: Float64[np.ndarray, "N"],
                  stamps_s: Float64[np.ndarray, "N"]) -> LeRobotPictures:  # fmt: skip
    """The pictures of a feature, none of them decoded yet.

    Args:
        one: The episode.
        feature: Of color or of depth.
        first: Its first row in the table.
        time_s: When every picture was taken.
        stamps_s: Where every picture is in the part of the video that is the episode's.

    Raises:
        DataError: The video is missing, too short, or has other pictures than the feature.
    """
    names = tuple(f"{feature.name}[{k}]" for k in range(len(time_s)))
    timing = Timing("the timestamps")
    code = depth_code(one, feature) if feature.is_depth and feature.dtype == "video" else None
    if feature.dtype == "image":
        read = partial(_depth_image if feature.is_depth else _color_image, one.data, feature.name, first)
        kind = _kind_of_images(one, feature, read)
        unit = _unit_of_images(one, feature, kind) if feature.is_depth else ()
        return LeRobotPictures(ImageStream(names, time_s, read, timing), unit)
    path, start_s = one.video(feature.name)
    _check_film(one, path, feature, start_s + float(stamps_s[-1]))
    read = partial(_frame, path, start_s + stamps_s, NEAREST / one.info.fps, code)
    stream = ImageStream(names, time_s, read, timing)
    if code is None:
        return LeRobotPictures(stream)
    said = any(f"video.{k}" in feature.info or k in feature.info for k in ("depth_min", "depth_max"))
    return LeRobotPictures(
        stream, (("the code of the depth video", Metadata(depth_unit_m=1.0)),), (_of_code(code, said),)
    )


def _check_film(one: LeRobotEpisode, path: Path, feature: LeRobotFeature, last_s: float) -> None:
    """Refuse a video that ends before the episode does, or whose pictures have another size than the feature says."""
    about = ask(path, "film")
    size = {about["width"], about["height"]}
    if len(feature.shape) == 3 and not size <= set(feature.shape):
        raise DataError(f"{path}: has pictures of {about['width']}x{about['height']}, and {shown(feature.name)} in "
                        f"meta/info.json has the shape {list(feature.shape)}")  # fmt: skip
    if about["end_s"] and about["end_s"] < last_s:
        raise DataError(f"{path}: ends after {about['end_s']:.3f} s, and the last picture of {one.where.name} would "
                        f"be at {last_s:.3f} s; copy it again")  # fmt: skip
    if feature.is_depth and about["format"] not in ("gray12le", "yuv420p12le"):
        found = shown(about["format"])[1:-1]
        raise DataError(f"{path}: is said to be depth and has pixels of {found}, expected gray12le, 12-bit codes; "
                        "colors are no distances")  # fmt: skip


_MOST = 1e6
"""No whole number of a depth code is as large."""


def depth_code(one: LeRobotEpisode, feature: LeRobotFeature) -> DepthCode:
    """The code of a depth video, by what the feature says of it. Raises :class:`DataError` where that cannot be."""
    values: dict[str, Any] = {}
    for key, kind in (("depth_min", float), ("depth_max", float), ("shift", float), ("use_log", bool)):
        value = feature.info.get(f"video.{key}", feature.info.get(key))
        fits = (
            isinstance(value, bool)
            if kind is bool
            else isinstance(value, float) or (type(value) is int and abs(value) < _MOST)
        )
        if value is not None and not fits:
            raise DataError(
                f"{one.info.place}: video.{key} of {shown(feature.name)} is {shown(value)}, expected a {kind.__name__}"
            )
        values |= {} if value is None else {key: kind(value)}
    code = DepthCode(**values)
    if code.fault:
        raise DataError(f"{one.info.place}: the depth code of {shown(feature.name)} has {code.fault}")
    return code


def _of_code(code: DepthCode, said: bool) -> Check:
    steps = ", ".join(f"{1000 * code.step_m(x):.1f} at {x:g} m" for x in (0.3, 1.0, 2.0))
    says = (f"12-bit code of the video from {code.depth_min:g} to {code.depth_max:g} m, in steps of {steps} [mm]; "
            "what is at either end is no reading, since the code puts pixels without one there")  # fmt: skip
    says += "" if said else "; the dataset does not say its range, and LeRobot's usual one was taken"
    return Check("depth code", Verdict.OK if said else Verdict.ASSUMED, says)


def _kind_of_images(one: LeRobotEpisode, feature: LeRobotFeature, read: Any) -> str:
    """Of which kind the numbers of the first picture are; empty where it is bad. Refuses another size than is said."""
    try:
        picture: np.ndarray = read(0)
    except (BadImage, FlowlabError):
        return ""
    if len(feature.shape) == 3 and not set(picture.shape[:2]) <= set(feature.shape):
        height, width = picture.shape[:2]
        raise DataError(f"{one.data}: has pictures of {width}x{height}, and {shown(feature.name)} in "
                        f"meta/info.json has the shape {list(feature.shape)}")  # fmt: skip
    return picture.dtype.kind


def _unit_of_images(one: LeRobotEpisode, feature: LeRobotFeature, kind: str) -> tuple[tuple[str, Metadata], ...]:
    """The unit of depth pictures: as the feature says, else millimeters for whole numbers and meters for others."""
    said = feature.info.get("depth_unit")
    if said is not None:
        if said not in ("m", "mm"):
            raise DataError(f"{one.info.place}: depth_unit of {shown(feature.name)} is {shown(said)}, expected m or mm")
        return ((f"{one.info.place.name}:{feature.name}", Metadata(depth_unit_m=_UNITS[said])),)
    if not kind:
        return ()
    return ((f"{CUSTOM}LeRobot", Metadata(depth_unit_m=_UNITS["m" if kind == "f" else "mm"])),)


def _color_image(path: Path, name: str, first: int, index: int) -> UInt8[np.ndarray, "H W 3"]:
    return decode_color(_embedded(path, name, first + index))


def _depth_image(path: Path, name: str, first: int, index: int) -> Num[np.ndarray, "H W"]:
    content = _embedded(path, name, first + index)
    if not content.startswith(_TIFF):
        return decode_depth(content)
    try:
        return check_depth(decode_tiff(path, content))
    except DataError as error:
        raise BadImage(_without(path, error)) from error


def _embedded(path: Path, name: str, row: int) -> bytes:
    try:
        content: bytes = ask(path, "picture", name, row)
    except DataError as error:
        raise BadImage(_without(path, error)) from error
    return content


def _frame(
    path: Path, at_s: Float64[np.ndarray, "N"], tolerance_s: float, code: DepthCode | None, index: int
) -> Num[np.ndarray, "..."]:
    try:
        pixels: np.ndarray = ask(path, "frame", float(at_s[index]), tolerance_s, code is not None)
    except DataError as error:
        raise BadImage(_without(path, error)) from error
    return pixels if code is None else code.meters(pixels)


def _without(path: Path, error: DataError) -> str:
    """What is wrong with a picture: the file is told by its name."""
    return f"{path.name} {str(error).removeprefix(f'{path}: ')}"


def picture_files(one: LeRobotEpisode) -> Iterator[Path]:
    """The videos of an episode, those that can be named: one that is not used may lack what names it."""
    for feature in one.info.features.values():
        if feature.dtype == "video":
            with suppress(DataError):
                yield one.video(feature.name)[0]
