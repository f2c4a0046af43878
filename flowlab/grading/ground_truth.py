"""True tracks beside a recording, and how they are read: ``ground_truth.npz``."""

from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int8

from flowlab.array_files import load_arrays
from flowlab.errors import DataError, MissingFileError
from flowlab.geometry.camera import pose_fault
from flowlab.geometry.transforms import apply
from flowlab.recordings.recording_yaml import SIMULATED, TRUE_TRACKS
from flowlab.records import Role
from flowlab.text import cut, natural_key, shown
from flowlab.untrusted import read_json

FILE_NAME = TRUE_TRACKS
MADE_WITH = SIMULATED
"""In a simulated recording's folder: what it was made with, and how many queries could not be used."""


@dataclass(frozen=True, slots=True)
class GroundTruth:
    """Where the surface points seen at some pixels of the first frame truly are at every instant."""

    query_px: Float32[np.ndarray, "N 2"]
    """Pixel (x, y) of each query in the first frame, integer pixel centers."""
    tracks_cam: Float32[np.ndarray, "T N 3"]
    """Position in the camera frame of each instant [m]."""
    visible: Bool[np.ndarray, "T N"]
    """Whether the camera sees the point."""
    role: Int8[np.ndarray, "N"] | None = None
    """The :class:`flowlab.records.Role` of what each query lies on, -1 where it is not known. None where
    "moving" means nothing, because it is the camera that moves in a way that is not known."""
    T_world_cam: Float64[np.ndarray, "T 4 4"] | None = None
    """The pose of a camera that moves, at each instant: what moves is what moves in the world."""

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays as they are stored, by name."""
        named = {f.name: getattr(self, f.name) for f in fields(self)}
        return {name: values for name, values in named.items() if values is not None}

    def save(self, recording: Path) -> None:
        """Write the tracks beside a recording."""
        np.savez_compressed(recording / FILE_NAME, **self.arrays())  # type: ignore[arg-type]

    def displacement_m(self) -> Float64[np.ndarray, "T N"]:
        """How far every point is from where it started [m]: in the world, where the camera's motion is known."""
        xyz = self.tracks_cam.astype(np.float64)
        if self.T_world_cam is not None:
            xyz = apply(self.T_world_cam[:, None], xyz)
        return np.asarray(np.linalg.norm(xyz - xyz[:1], axis=-1))


def has_ground_truth(recording: Path) -> bool:
    """Whether a recording's folder holds true tracks."""
    return (recording / FILE_NAME).is_file()


def find_with_truth(path: Path) -> list[Path]:
    """The recordings with known truth at or below a path, in natural order.

    Raises:
        DataError: There is no such folder, or no such recording.
    """
    if not path.exists():
        raise DataError(f"{path}: there is no such folder")
    found = sorted((file.parent for file in path.rglob(FILE_NAME)), key=lambda folder: natural_key(str(folder)))
    if not found:
        raise DataError(
            f"{path}: no recording at or below it has a {FILE_NAME}, so its truth is not known (see docs/grading.md); "
            "without recordings of your own, give --tasks hammer,door-open"
        )
    return found


def scene_of(recording: Path) -> str:
    """The family of scenes, or the task, that a simulated recording is of; empty for any other."""
    made = recording / MADE_WITH
    values = read_json(made, "simulate it again") if made.is_file() else {}
    made_with = values.get("made_with") if isinstance(values, dict) else None
    found = (made_with.get("scenes") or made_with.get("task")) if isinstance(made_with, dict) else ""
    return found if isinstance(found, str) else ""


def unusable_queries(recording: Path) -> int:
    """How many queries were left out of a simulated recording; 0 for any other."""
    made = recording / MADE_WITH
    if not made.is_file():
        return 0
    values = read_json(made, "simulate it again")
    found = values.get("unusable_queries") if isinstance(values, dict) else None
    if type(found) is not int or found < 0:
        raise DataError(f"{made}: 'unusable_queries' is {shown(found)}, expected a whole number from 0 on")
    return found


def read(path: Path) -> GroundTruth:
    """True tracks from a recording's folder, or from the file itself.

    Raises:
        DataError: There is no such file, or it does not hold what it should.
    """
    path = path / FILE_NAME if path.is_dir() else path
    try:
        return _checked(path, load_arrays(path))
    except MissingFileError as error:
        raise DataError(
            f"{path}: there is no such file; 'flowlab grade' needs a recording's true tracks "
            "(query_px, tracks_cam and visible; see docs/grading.md), or --tasks to simulate recordings"
        ) from error


def _checked(path: Path, arrays: dict[str, np.ndarray]) -> GroundTruth:
    """The record, once every array is known to have the right shape, type and finite values."""
    for name in ("query_px", "tracks_cam", "visible"):
        if name not in arrays:
            raise DataError(f"{path}: has no array '{name}'; found {cut(', '.join(sorted(arrays))) or 'none'}")
    query_px, tracks_cam = arrays["query_px"], arrays["tracks_cam"]
    steps, queries = tracks_cam.shape[0] if tracks_cam.ndim else 0, query_px.shape[0] if query_px.ndim else 0
    if not steps or not queries:
        raise DataError(f"{path}: holds no track; tracks_cam is (frames, queries, 3), found {tracks_cam.shape}")
    _check(path, "query_px", query_px, (queries, 2), "fiu")
    _check(path, "tracks_cam", tracks_cam, (steps, queries, 3), "f")
    _check(path, "visible", arrays["visible"], (steps, queries), "b")
    role = arrays.get("role")
    if role is not None:
        _check(path, "role", role, (queries,), "iu")
        if not (role.min() >= -1 and role.max() <= max(Role)):
            raise DataError(f"{path}: 'role' is {role.min()} to {role.max()}, expected -1 to {int(max(Role))}")
        role = role.astype(np.int8)
    poses = arrays.get("T_world_cam")
    if poses is not None:
        _check(path, "T_world_cam", poses, (steps, 4, 4), "f")
        poses = poses.astype(np.float64)
        if fault := next(filter(None, map(pose_fault, poses)), ""):
            raise DataError(f"{path}: a pose of 'T_world_cam' {fault}")
    with np.errstate(over="ignore"):
        query_px, tracks_cam = query_px.astype(np.float32), tracks_cam.astype(np.float32)
    for name, values in (("query_px", query_px), ("tracks_cam", tracks_cam)):
        _check(path, name, values, values.shape, "f")
    return GroundTruth(query_px, tracks_cam, arrays["visible"], role, poses)


def _check(path: Path, name: str, values: np.ndarray, shape: tuple[int, ...], kinds: str) -> None:
    """Refuse an array of another shape or kind of type, or with values that are not finite."""
    if values.shape != shape:
        raise DataError(f"{path}: '{name}' has the shape {values.shape}, expected {shape} as the other arrays say")
    if values.dtype.kind not in kinds:
        expected = {"f": "floats", "i": "whole numbers", "b": "booleans"}[kinds[0]]
        raise DataError(f"{path}: '{name}' has the type {values.dtype}, expected {expected}")
    if not np.isfinite(values).all():
        raise DataError(f"{path}: '{name}' holds {(~np.isfinite(values)).sum()} values that are not finite")
