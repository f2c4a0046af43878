"""What a LeRobot dataset says of itself in ``meta/info.json``: its version, rate, features, and where its files are."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flowlab.errors import DataError
from flowlab.limits import MAX_PIXELS, MAX_WIDTH
from flowlab.recordings.parts import FOLDER_INDEX
from flowlab.recordings.stamps import PICTURE_STEP_S
from flowlab.text import is_path_inside, shown
from flowlab.untrusted import read_json

_FIELD = re.compile(r"\{(\w+)(?::0(\d)d)?\}")
_PATHS = {
    3: ("data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"),
    2: ("data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
        "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"),
}  # fmt: skip
_CONVERT = "convert it with LeRobot's own script"

_DEPTH_MARKS = ("is_depth_map", "video.is_depth_map")
"""Keys of a feature's info that tell depth, the second of which is of earlier versions."""


@dataclass(frozen=True, slots=True)
class LeRobotFeature:
    """A column, or a video."""

    name: str
    dtype: str
    """``image``, ``video``, or the type of its numbers."""
    shape: tuple[int, ...]
    names: tuple[str, ...]
    """What its numbers are called; empty where that is not said."""
    info: Mapping[str, Any]

    @property
    def is_picture(self) -> bool:
        """Whether it has a picture for each step."""
        return self.dtype in ("image", "video")

    @property
    def is_depth(self) -> bool:
        """Whether its pictures are said to be depth; or have one channel, and depth in their name."""
        said = [self.info[k] for k in _DEPTH_MARKS if k in self.info]
        return bool(said[0]) if said else self.dtype == "image" and 1 in self.shape and "depth" in self.name.lower()


@dataclass(frozen=True, slots=True)
class LeRobotInfo:
    """``meta/info.json``, as far as it is used."""

    folder: Path
    version: str
    fps: float
    features: Mapping[str, LeRobotFeature]
    total_episodes: int | None
    episodes_to_chunk: int
    data_path: str
    video_path: str

    @property
    def is_v3(self) -> bool:
        """Whether several episodes share a file."""
        return self.version.startswith("v3")

    @property
    def place(self) -> Path:
        """Where this is said."""
        return self.folder / FOLDER_INDEX

    def file(self, template: str, **values: int | str) -> Path:
        """A file of the dataset.

        Args:
            template: One of the two paths.
            values: What stands in it for names in braces.

        Raises:
            DataError: The template names something else, or a file outside the folder.
        """

        def value(found: re.Match[str]) -> str:
            name, width = found.groups()
            if name not in values:
                raise DataError(
                    f"{self.place}: the path {shown(template)} has '{{{name}}}', expected {', '.join(values)}"
                )
            return f"{values[name]:0{width}d}" if width and isinstance(values[name], int) else str(values[name])

        name = _FIELD.sub(value, template)
        if "{" in name or "}" in name or not is_path_inside(name):
            raise DataError(f"{self.place}: the path {shown(template)} names {shown(name)}, expected a file below the "
                            f"dataset, as in {_PATHS[3 if self.is_v3 else 2][0]}")  # fmt: skip
        return self.folder / name


def read_info(folder: Path) -> LeRobotInfo:
    """What a dataset says of itself.

    Args:
        folder: Of the dataset.

    Raises:
        DataError: It is not as it should be; the message says which key, what was found and what was expected.
    """
    place = folder / FOLDER_INDEX
    said = read_json(place)
    if not isinstance(said, dict):
        raise DataError(f"{place}: is {shown(said)}, expected a mapping with 'codebase_version'")
    version = str(said.get("codebase_version"))
    major = next((n for n in _PATHS if re.fullmatch(rf"v{n}\.\d{{1,3}}", version)), None)
    if major is None:
        raise DataError(f"{place}: codebase_version is {shown(version)}, flowlab reads v3.0, v2.1 and v2.0; {_CONVERT}")
    fps, low, high = said.get("fps"), 1 / PICTURE_STEP_S[1], 1 / PICTURE_STEP_S[0]
    if isinstance(fps, bool) or not isinstance(fps, int | float) or not low <= fps <= high:
        raise DataError(f"{place}: fps is {shown(fps)}, expected pictures a second, {low:g} to {high:g}")
    features = said.get("features")
    if not isinstance(features, dict) or not features:
        raise DataError(f"{place}: features is {shown(features)}, expected a mapping of names to dtype and shape")
    data, video = (
        said.get(key) or usual for key, usual in zip(("data_path", "video_path"), _PATHS[major], strict=True)
    )
    for key, path in (("data_path", data), ("video_path", video)):
        if not isinstance(path, str):
            raise DataError(f"{place}: {key} is {shown(path)}, expected a path as {_PATHS[major][0]}")
    total = said.get("total_episodes")
    if total is not None and (isinstance(total, bool) or not isinstance(total, int)):
        raise DataError(f"{place}: total_episodes is {shown(total)}, expected a whole number")
    known = {name: _feature(place, name, about) for name, about in features.items()}
    return LeRobotInfo(folder, version, float(fps), known, total,
                       _whole(place, said, "chunks_size", 1000), data, video)  # fmt: skip


def _whole(place: Path, said: Mapping[str, Any], key: str, usual: int) -> int:
    value = said.get(key, usual)
    if isinstance(value, bool) or not isinstance(value, int) or not 0 < value <= 10**9:
        raise DataError(f"{place}: {key} is {shown(value)}, expected a whole number above 0")
    return value


def _feature(place: Path, name: str, about: Any) -> LeRobotFeature:
    """A feature whose shape can be. Raises :class:`DataError`."""
    if not isinstance(about, dict) or not isinstance(about.get("dtype"), str):
        raise DataError(
            f"{place}: the feature {shown(name)} is {shown(about)}, expected a mapping with dtype and shape"
        )
    shape, dtype = about.get("shape") or (), about["dtype"]
    if not isinstance(shape, list | tuple) or not all(type(n) is int and n >= 0 for n in shape):
        raise DataError(f"{place}: the feature {shown(name)} has the shape {shown(shape)}, expected whole numbers")
    product = 1
    for n in shape:
        product *= n
    most = 4 * MAX_PIXELS if dtype in ("image", "video") else 1000 * MAX_WIDTH
    if product > most:
        raise DataError(
            f"{place}: the feature {shown(name)} has the shape {shown(shape)}, expected at most {most:,} numbers"
        )
    info = about.get("info") or about.get("video_info") or {}
    info = info if isinstance(info, dict) else {}
    for key in _DEPTH_MARKS:
        if not isinstance(info.get(key, False), bool):
            raise DataError(f"{place}: {key} of {shown(name)} is {shown(info[key])}, expected true or false")
    return LeRobotFeature(name, dtype, tuple(shape), _names(about.get("names"), shape), info)


def _names(names: Any, shape: Any) -> tuple[str, ...]:
    """What the numbers of a feature are called, in a list or in lists by part of the robot."""
    parts = list(names.values()) if isinstance(names, dict) else [names]
    flat = [x for part in parts if isinstance(part, list | tuple) for x in part]
    fits = len(shape) == 1 and len(flat) == shape[0] and all(isinstance(x, str) for x in flat)
    return tuple(shown(x)[1:-1] for x in flat) if fits and len(set(flat)) == len(flat) else ()
