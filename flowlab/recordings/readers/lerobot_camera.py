"""The camera of a LeRobot dataset: which pictures are its color and its depth, and what is known of its calibration."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from flowlab.errors import DataError
from flowlab.recordings.intrinsics import Intrinsics
from flowlab.recordings.poses import check_poses
from flowlab.recordings.readers.hdf5_layouts import IN_HAND
from flowlab.recordings.readers.lerobot_episodes import LeRobotEpisode
from flowlab.recordings.readers.lerobot_info import LeRobotFeature
from flowlab.recordings.recording_yaml import FILE_NAME, Metadata
from flowlab.recordings.unused_files import some_of
from flowlab.recordings.verdicts import Check, Verdict
from flowlab.text import shown

CALIBRATION = "camera"
"""Key of a feature's ``info``, and beginning of columns of the episodes, that hold the calibration."""
_SAID_OF_ALL = {"observation", "observations", "image", "images", "rgb", "color", "depth", "cam", "camera"}
_AXES = {"opencv": (1, 1, 1, 1), "opengl": (1, -1, -1, 1)}


@dataclass(frozen=True, slots=True)
class LeRobotCamera:
    """Pictures of color and depth that belong together."""

    color: LeRobotFeature
    depth: LeRobotFeature
    checks: tuple[Check, ...]


def choose_camera(one: LeRobotEpisode, named: str | None) -> LeRobotCamera:
    """The camera to use: the one that is named, the only one with depth, or the only one that no robot holds.

    Args:
        one: The episode.
        named: What the user calls it: its feature, or the last part of that.

    Raises:
        DataError: There is none with depth, or several of which none is named.
    """
    pictures = [f for f in one.info.features.values() if f.is_picture]
    colors, depths = [f for f in pictures if not f.is_depth], [f for f in pictures if f.is_depth]
    where = f"{one.info.folder}: is a LeRobot dataset"
    if not colors or not depths:
        what = some_of([shown(f.name)[1:-1] for f in pictures]) or "none"
        raise DataError(f"{where} without {'depth' if colors else 'color'} pictures (its pictures are {what}), and "
                        "flowlab needs both; record it with a depth camera, or mark the feature with info: "
                        "{is_depth_map: true}")  # fmt: skip
    pairs, guessed = _pairs(colors, depths)
    names = _by_name(pairs, where)
    if not names:
        found, others = (some_of([f.name for f in features]) for features in (depths, colors))
        raise DataError(f"{where} whose depth ({found}) belongs to none of its color pictures by its name ({others}); "
                        "call it as those, with '_depth' at the end")  # fmt: skip
    still = [n for n in names if not IN_HAND.search(n)] or list(names)
    wanted = named if named is None else next((n for n, (c, _) in names.items() if named in (n, c.name)), "")
    if wanted == "":
        raise DataError(
            f"{where} whose cameras with depth are {some_of(list(names))}, and 'camera' says {shown(named)}"
        )
    if wanted is None and len(still) > 1:
        raise DataError(f"{where} with several cameras, {some_of(list(names))}; choose one with "
                        f"'camera: {still[0]}' in {one.info.folder / FILE_NAME} (or the calibration file)")  # fmt: skip
    color, depth = names[wanted or still[0]]
    return LeRobotCamera(color, depth, tuple(_told(one, names, color, depth, wanted, guessed)))


def _by_name(
    pairs: Sequence[tuple[LeRobotFeature, LeRobotFeature]], where: str
) -> dict[str, tuple[LeRobotFeature, LeRobotFeature]]:
    """Cameras by what they are called. Of several depths that fit a color it is the one that is called like that, with
    ``_depth`` at the end; raises :class:`DataError` where there is none."""
    names: dict[str, tuple[LeRobotFeature, LeRobotFeature]] = {}
    for color in {color.name: color for color, _ in pairs}.values():
        depths = [depth for c, depth in pairs if c is color]
        exact = [depth for depth in depths if depth.name == f"{color.name}_depth"]
        if len(depths) > 1 and not exact:
            raise DataError(
                f"{where} in which {some_of([d.name for d in depths])} may all be the depth of {color.name}; call the "
                f"one that is {color.name}_depth"
            )
        short = _short(color) if _short(color) not in names else color.name
        names[short] = (color, (exact or depths)[0])
    return names


def _told(one: LeRobotEpisode, names: Sequence[str] | Mapping[str, Any], color: LeRobotFeature, depth: LeRobotFeature,
          wanted: str | None, guessed: bool) -> Iterator[Check]:  # fmt: skip
    """What is said of the choice."""
    held = [] if wanted else [n for n in names if n != _short(color)]
    says = f"LeRobot {one.info.version}, {color.name} with {depth.name}"
    says += "; they are the only ones, and so belong together" if guessed else ""
    says += f"; in a hand, and so not taken: {some_of(held)} ('camera: {held[0]}' takes it)" if held else ""
    yield Check("layout", Verdict.ASSUMED if held or guessed else Verdict.OK, says)


def _pairs(
    colors: Sequence[LeRobotFeature], depths: Sequence[LeRobotFeature]
) -> tuple[list[tuple[LeRobotFeature, LeRobotFeature]], bool]:
    """Color and depth of one name; and whether they belong together only because there are no others."""
    pairs = [(c, d) for c in colors for d in depths if _key(c) == _key(d)]
    if not pairs and len(colors) == len(depths) == 1:
        return [(colors[0], depths[0])], True
    return pairs, False


def _key(feature: LeRobotFeature) -> tuple[str, ...]:
    """What is special in the name of a camera."""
    return tuple(x for x in re.split(r"[._/\- ]+", feature.name.lower()) if x not in _SAID_OF_ALL)


def _short(feature: LeRobotFeature) -> str:
    """The name without what all have in common."""
    return feature.name.removeprefix("observation.").removeprefix("images.")


def known_calibration(one: LeRobotEpisode, camera: LeRobotCamera) -> Iterator[tuple[str, Metadata]]:
    """What the episode, and the feature, say of the camera, the first first.

    Raises:
        DataError: It is no calibration.
    """
    columns = {key: one.said.get(f"{CALIBRATION}/{key}") for key in ("K", "T_world_cam")}
    about = camera.color.info.get(CALIBRATION) or {}
    if not isinstance(about, dict):
        raise DataError(
            f"{one.info.place}: info.{CALIBRATION} of {shown(camera.color.name)} is {shown(about)}, expected a mapping "
            "with K and T_world_cam"
        )
    for name, said in ((f"the columns {CALIBRATION}/* of meta/episodes", columns), ("meta/info.json", about)):
        where = f"{one.where}: {name}: {CALIBRATION}"
        known: dict[str, Any] = {}
        if said.get("K") is not None:
            known["intrinsics"] = _intrinsics(where, said["K"], about)
        if said.get("T_world_cam") is not None:
            known["T_world_cam"] = _pose(where, said["T_world_cam"], about)
        if known:
            yield name, Metadata(**known)


def _intrinsics(where: str, K: Any, about: Mapping[str, Any]) -> Intrinsics:
    """A matrix with pixel centers at whole numbers."""
    matrix = _matrix(f"{where}.K", K, (3, 3))
    first = about.get("pixel_centers", 0.0)
    if first not in (0, 0.5):
        raise DataError(f"{where}.pixel_centers is {shown(first)}, expected 0, or 0.5 where cx is half the width")
    matrix[:2, 2] -= first
    size = {key: about[key] for key in ("width", "height") if isinstance(about.get(key), int)}
    lens = {key: about[key] for key in ("distortion", "distortion_model") if about.get(key)}
    return Intrinsics.from_matrix(matrix, **size, **lens)


def _pose(where: str, T: Any, about: Mapping[str, Any]) -> list[list[float]]:
    """A pose of a camera with the axes of OpenCV."""
    axes = about.get("axes", "opencv")
    if not isinstance(axes, str) or axes not in _AXES:
        raise DataError(
            f"{where}.axes is {shown(axes)}, expected opencv (x right, y down, z forward) or opengl (x right, y up)"
        )
    found: list[list[float]] = (check_poses(f"{where}.T_world_cam", _matrix(f"{where}.T_world_cam", T, (4, 4))[None])[0]
                                * np.array(_AXES[axes], float)).tolist()  # fmt: skip
    return found


def _matrix(where: str, values: Any, shape: tuple[int, int]) -> np.ndarray:
    """A matrix, as rows or row by row."""
    try:
        found = np.asarray(values, np.float64)
    except (TypeError, ValueError, OverflowError):
        found = np.empty(0)
    if found.size != shape[0] * shape[1] or not np.isfinite(found).all():
        raise DataError(f"{where} is {shown(values)}, expected {shape[0]} x {shape[1]} finite numbers")
    return found.reshape(shape).copy()


def is_registered(camera: LeRobotCamera) -> bool | None:
    """Whether depth is seen from the color camera; None where that is not said.

    Raises:
        DataError: Depth has a calibration of its own, by which it is not.
    """
    color, depth = (f.info.get(CALIBRATION) for f in (camera.color, camera.depth))
    if not isinstance(color, dict) or not isinstance(depth, dict):
        return None
    if other := [
        key for key in ("K", "T_world_cam", "width", "height") if color.get(key) != depth.get(key, color.get(key))
    ]:
        raise DataError(
            f"info.{CALIBRATION} of {shown(camera.depth.name)} has another {' and '.join(other)} than that of "
            f"{shown(camera.color.name)}, and flowlab takes depth that is registered to color; register it, or correct "
            "meta/info.json"
        )
    return color == depth or None
