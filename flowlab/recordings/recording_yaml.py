"""What is known of a recording besides its pictures: ``recording.yaml``, or one calibration file for many."""

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, Field, ValidationError

from flowlab.config import Settings
from flowlab.errors import DataError, unknown_name
from flowlab.recordings.hdf5_map import HDF5Map
from flowlab.recordings.intrinsics import FiniteSettings, Intrinsics
from flowlab.recordings.stamps import PICTURE_STEP_S, StatedUnit
from flowlab.text import cut, is_path_inside, shown
from flowlab.untrusted import read_yaml

FILE_NAME = "recording.yaml"
TRUE_TRACKS = "ground_truth.npz"
"""What grading compares with, where a recording has it."""
SIMULATED = "simulated.json"
"""What flowlab's simulator keeps beside a recording of how it was made."""
_FARTHEST_M = 1e6
Row = tuple[float, float, float, float]


def _inside(name: str) -> str:
    """Refuse names that lead out of the recording's folder."""
    if not is_path_inside(name):
        raise ValueError("must name a file in the recording's folder, without '..' or a '/' at its start")
    return name


def check_rigid(rows: tuple[Row, Row, Row, Row]) -> tuple[Row, Row, Row, Row]:
    """Refuse rows that are no rigid transform."""
    T = np.array(rows)
    R = T[:3, :3]
    off = np.abs(R @ R.T - np.eye(3)).max() if np.abs(T).max() < _FARTHEST_M else np.inf
    if not off < 1e-3 or np.linalg.det(T[:3, :3]) < 0 or tuple(rows[3]) != (0, 0, 0, 1):
        raise ValueError(
            "must be a rigid transform: four rows of four numbers, a rotation (determinant 1) and a position [m], "
            "and the last row 0, 0, 0, 1"
        )
    return rows


PathInside = Annotated[str, AfterValidator(_inside)]
Rigid = Annotated[tuple[Row, Row, Row, Row], AfterValidator(check_rigid)]


class Topics(Settings):
    """Which topics of a ROS bag to read, where types and names do not tell."""

    color: str | None = None
    """Color pictures."""
    depth: str | None = None
    """Depth pictures."""
    color_info: str | None = None
    """``CameraInfo`` of the color camera."""
    depth_info: str | None = None
    """``CameraInfo`` of the depth camera."""
    state: str | None = None
    """Numbers of the robot."""
    action: str | None = None
    """What the robot was told to do."""
    T_world_cam: str | None = None
    """Poses of a camera that moves."""


class Metadata(FiniteSettings):
    """The keys of ``recording.yaml``; every one is optional where the layout itself tells."""

    color: PathInside = "color"
    """Folder of the color pictures."""
    depth: PathInside = "depth"
    """Folder of the depth pictures."""
    fps: float | None = Field(default=None, ge=1 / PICTURE_STEP_S[1], le=1 / PICTURE_STEP_S[0])
    """Pictures per second, where their names number frames; where there are times, these must agree."""
    times: PathInside | None = None
    """File with the time of every color picture [s], one a line; of the depth pictures too without ``depth_times``."""
    depth_times: PathInside | None = None
    """File with the time of every depth picture [s]."""
    time_unit: StatedUnit | None = None
    """Unit of times in names, lists and files, where it is not clear: s, ms, us or ns."""
    clock: Literal["stamps", "recorded"] | None = None
    """Which times of messages to take, where their stamps and the times of recording do not agree."""
    depth_offset_s: float | None = None
    """Added to the times of depth [s]; 0 says that equal frame numbers belong together."""
    state_offset_s: float | None = None
    """Added to the times of state and actions [s], where their clock is behind that of the pictures."""
    intrinsics: Intrinsics | None = None
    """The color camera."""
    depth_unit_m: float | None = Field(default=None, gt=0)
    """Meters per count of the depth pictures."""
    T_world_cam: Rigid | None = None
    """Pose of the color camera: maps its coordinates to the world's [m]. Without it the world is the camera."""
    T_world_cam_file: PathInside | None = None
    """Of a camera that moves: ``.npy`` or text with its pose at every color picture, or at times of their own."""
    T_world_cam_times: PathInside | None = None
    """File with the time of every pose [s], on the clock of the pictures."""
    T_world_cam_offset_s: float | None = None
    """Added to the times of the poses [s]."""
    T_world_cam_gap_s: float | None = Field(default=None, gt=0)
    """Poses this far apart [s] still tell what is between them; without it, 1.5 times the period of the pictures."""
    depth_intrinsics: Intrinsics | None = None
    """The depth camera, where depth is not registered to color."""
    T_color_depth: Rigid | None = None
    """Maps coordinates of the depth camera to those of the color camera [m]."""
    state: PathInside | None = None
    """``.npy`` or ``.csv`` with a row of robot state per color picture, or per time of ``state_times``."""
    state_times: PathInside | None = None
    """File with the time of every row of state [s], on the clock of the pictures."""
    state_columns: tuple[str, ...] | None = Field(default=None, min_length=1)
    """Names of the columns of ``state`` to take, in this order; else all that are not times."""
    action: PathInside | None = None
    """Likewise, the actions."""
    action_columns: tuple[str, ...] | None = Field(default=None, min_length=1)
    """Names of the columns of ``action`` to take, in this order."""
    action_times: PathInside | None = None
    """File with the time of every row of actions [s]."""
    one_robot: bool = False
    """Whether state and actions are one robot's though they leap as those of two that publish in turn."""
    rendered: bool = False
    """Whether the pictures were rendered: where they have no noise, equal ones are no sign of a camera that froze."""
    success: bool = True
    """Whether the demonstration solved its task."""
    task: str | None = None
    """What the robot does."""
    camera: str | None = None
    """Serial number, or name, of the camera to use, where a recording has several."""
    topics: Topics = Topics()
    """Topics of a ROS bag."""
    hdf5: HDF5Map | None = None
    """Where everything is in an HDF5 file, and how it is meant."""
    ignore: tuple[str, ...] = ()
    """Patterns of files that are not to be used: of names below the recording, of arrays, or of keys (``file:key``)."""


def load_metadata(path: Path) -> Metadata:
    """The content of a YAML file. Raises :class:`DataError` that names the key."""
    values = read_yaml(path)
    if values is not None and not isinstance(values, dict):
        raise DataError(f"{path}: must be a mapping such as 'fps: 30', found {shown(values)}")
    try:
        return Metadata.model_validate(values or {})
    except ValidationError as error:
        raise DataError(f"{path}: {_explain(error)}") from error


def _explain(error: ValidationError) -> str:
    """The first thing that is wrong, with what exists where a key does not."""
    # A key misspelt is why another is missing, so it is named first.
    first = min(error.errors(), key=lambda e: e["type"] != "extra_forbidden")
    where = ".".join(map(str, first["loc"]))
    if first["type"] == "extra_forbidden":
        inner: dict[str, type[Settings]] = {
            "intrinsics": Intrinsics, "depth_intrinsics": Intrinsics, "topics": Topics, "hdf5": HDF5Map,
        }  # fmt: skip
        model = inner.get(str(first["loc"][0]), Metadata) if len(first["loc"]) > 1 else Metadata
        return str(unknown_name("key", str(first["loc"][-1]), model.model_fields))
    return f"{cut(where)}: {first['msg'].removeprefix('Value error, ')} (found {shown(first['input'])})"


def combine(sources: Iterable[tuple[str, Metadata]]) -> tuple[Metadata, dict[str, str]]:
    """One from several, the first that has a key winning; and where each key came from."""
    values: dict[str, Any] = {}
    origin: dict[str, str] = {}
    for name, metadata in sources:
        for key in metadata.model_fields_set:
            if key not in values and getattr(metadata, key) is not None:
                values[key], origin[key] = getattr(metadata, key), name
    return Metadata(**values), origin
