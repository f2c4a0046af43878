"""What a file that nothing uses may be, and what to write where it is that."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

import numpy as np

from flowlab.errors import FlowlabError
from flowlab.recordings.camera_numbers import called_poses, camera_numbers
from flowlab.recordings.file_contents import Contents
from flowlab.recordings.poses import read_poses
from flowlab.recordings.recording_yaml import FILE_NAME, Metadata
from flowlab.recordings.stated_elsewhere import contradictions, states_what_is_used
from flowlab.recordings.tables import read_table
from flowlab.recordings.unused_files import quoted, robot_numbers
from flowlab.recordings.unused_times import called_times, times_doubt
from flowlab.recordings.verdicts import Check, Verdict
from flowlab.text import cut

if TYPE_CHECKING:
    from flowlab.recordings.parsing import ParsedRecording

_CAMERA = re.compile(
    r"calib|intrin|extrin|cam(era)?(_?info|s)?([^a-z]|$)|distort|(^|[^a-z])(dist|lens|focal|fx|fy|ppx|fov|d|k|k1|sensor)([^a-z]|$)"
)
_TIMES = re.compile(r"time|stamp|(^|[^a-z])(fps|hz|t|ts|sec|secs|clock|sync)([^a-z]|$)|frame_?rate")
_ROBOT = re.compile(
    r"qpos|joint|state|action|gripper|tcp|eef|proprio|robot|teleop|rtde|(^|[^a-z])(ee|arm|q|obs|ur\d+)([^a-z]|$)"
)
_POSES = re.compile(r"pose|odom|slam|traj|(^|[^a-z])(q[xyzw]|t[xyz]|rotation|transform\w*)([^a-z]|$)")


@dataclass(frozen=True, slots=True)
class Unused:
    """A file, a folder of alike files, or an array, that nothing uses."""

    name: str
    """Below the recording, a folder's with a ``/`` at its end."""
    path: Path | None
    """Of the file, or of the first of the folder; None for an array."""
    count: int
    contents: Contents

    @property
    def pattern(self) -> str:
        """What to ignore it by."""
        suffix = "" if self.path is None or self.name != "./" else self.path.suffix
        return quoted(f"{self.name}*{suffix}" if self.name.endswith("/") else self.name)

    @property
    def told(self) -> str:
        """What messages call it."""
        return cut(self.name) + (f" ({self.count} files)" if self.name.endswith("/") else "")


def ask(source: "ParsedRecording", item: Unused) -> Check | None:
    """A doubt about what nothing uses, with what to write; None where it only says what is used."""
    about, says = next(_doubts(source, item), ("", ""))
    if not says:
        return None
    return Check(about, Verdict.DOUBTFUL, f"{says}; if it is not to be used, write 'ignore: [{item.pattern}]'")


def _doubts(source: "ParsedRecording", item: Unused) -> Iterator[tuple[str, str]]:
    """What a file may be, and what is said of it, the likeliest first; nothing where it says what is used."""
    name, files = PurePosixPath(item.name), item.path is not None
    if called_times(item.name, item.contents):
        says = times_doubt(source, item.name, item.contents)
        yield "times", f"{item.told} {says}" if says else ""
    for what in ("state", "action"):
        if files and item.count == 1 and robot_numbers(name.stem, what) and not getattr(source.streams, what):
            yield what, f"{item.told} is not used; if it is the {what}, {_how(item, what)}"
    if item.count > 1 and (says := _of_folder(source, item)):
        yield "camera", says
    if item.count == 1 and (says := _of_camera(source, item, name.stem)):
        yield "camera", f"{item.told} is not used; {says}"
    if item.count == 1 and files and (says := _of_rows(source, item, name.stem)):
        yield "state", says
    if states_what_is_used(source, name.stem, item.contents):
        yield "left out", ""
    yield "left out", _unknown(source, item)


def _how(item: Unused, key: str) -> str:
    """How a file of numbers is named, or what is to be written in its place where it cannot be read."""
    try:
        assert item.path is not None
        read_table(item.path)
    except FlowlabError:
        if item.path is not None and item.path.is_file() and item.path.suffix.lower() not in (".npy", ".csv", ".txt"):
            return f"write its numbers as .npy or .csv, and name that with '{key}: ...' in {FILE_NAME}"
    return f"write '{key}: {cut(item.name)}' into {FILE_NAME}"


def _of_rows(source: "ParsedRecording", item: Unused, stem: str) -> str:
    """What is said of a file with numbers for every picture, which may be the robot's."""
    steps, values = {len(source.streams.color), len(source.streams.depth)}, item.contents.values
    if values is None or values.ndim != 2 or len(values) not in steps or called_poses(stem.lower()):
        return ""
    if item.contents.names and all(_TIMES.search(name.lower()) for name in item.contents.names):
        return ""
    rises = values.shape[1] == 1 and len(values) > 1 and (np.diff(values[:, 0]) > 0).all()
    if source.streams.state or rises:  # as times do
        return ""
    name, poses = cut(item.name), _readable_poses(item)
    says = f"{name} has {values.shape[1]} numbers for every picture and is not used; if it is the state, write"
    also = f"; if it has poses of a camera that moves, camera to world, 'T_world_cam_file: {name}'" if poses else ""
    return f"{says} 'state: {name}' into {FILE_NAME}{also}"


def _of_camera(source: "ParsedRecording", item: Unused, stem: str) -> str | None:
    """What is said of a file that may have numbers of the camera; None where it has none."""
    values, posed = item.contents.values, source.streams.poses is not None
    says = None if values is None else camera_numbers(stem, values, source.metadata, posed)
    if says is not None and "write 'T_world_cam_file' into" not in says:
        return says
    matrix = values is not None and values.shape[-2:] in ((4, 4), (3, 4), (3, 3)) and says is None
    table = called_poses(stem) or _is_pose_table(item)
    if posed or matrix or not (says or table) or (item.path is None and not says):
        return says
    if item.path is None:
        return says
    start = says.partition("; if they")[0] + "; " if says else ""
    if _readable_poses(item):
        how = f"write 'T_world_cam_file: {cut(item.name)}' into {FILE_NAME}"
    else:
        how = f"write them as .npy of (N, 4, 4), or as rows of time tx ty tz qx qy qz qw, and name that with 'T_world_cam_file' in {FILE_NAME}"  # noqa: E501
    return f"{start}if it has poses of a camera that moves, each camera to world, {how}, if one of a camera that stands still, that as 'T_world_cam'"  # noqa: E501


def _is_pose_table(item: Unused) -> bool:
    """Whether columns are called as positions and quaternions are."""
    return {"qx", "qy", "qz", "qw"} <= {n.lower().rpartition(".")[2] for n in item.contents.names}


def _readable_poses(item: Unused) -> bool:
    try:
        return item.path is not None and item.path.is_file() and bool(len(read_poses(item.path)[1]))
    except FlowlabError:
        return False


def _of_folder(source: "ParsedRecording", item: Unused) -> str:
    """What is said of a folder with a pose, or a camera's matrix, for every picture."""
    values, folder = item.contents.values, item.name
    if values is None or source.streams.poses is not None:
        return ""
    if values.shape[-2:] == (3, 3) and camera_numbers("K", values, Metadata(), True):
        return (f"{cut(folder)} has {item.count} files with a camera's matrix each, and is not used; one camera is "
                f"expected, with its 'intrinsics' in {FILE_NAME}; cut the recording where they change")  # fmt: skip
    if camera_numbers("poses", values, Metadata(), False) is None:
        return ""
    return (f"{cut(folder)} has {item.count} files with a rigid transform each, and is not used; if they are the "
            f"poses of the camera, write them, camera to world, into one file, named as 'T_world_cam_file' in "
            f"{FILE_NAME}")  # fmt: skip


def _unknown(source: "ParsedRecording", item: Unused) -> str:
    """What is said of what is not known for what it is."""
    contents = item.contents
    verb = "" if contents.holds.startswith("is ") else "holds "
    says = f"{item.told} is not used; it {verb}{contents.holds}"
    against = contradictions(source, contents)
    told = " ".join((item.name, *contents.names, contents.words)).lower()
    advice = "; ".join([*against, *_advice(source, item, told)])
    return f"{says}; {advice or f'what of it is to be used goes into {FILE_NAME}'}"


def _advice(source: "ParsedRecording", item: Unused, told: str) -> Iterator[str]:
    """What to write, by the words that a file is called by and has in it."""
    if item.contents.holds == "a picture":
        keys = "'color' or 'depth'" if item.name.endswith("/") else "'color' or 'depth' (folders)"
        yield f"pictures that are to be used lie in one folder each, which {keys} names"
        return
    if _CAMERA.search(told):
        yield "what it tells of the camera goes into 'intrinsics', with 'distortion', 'T_world_cam' or 'depth_unit_m'"
    if _POSES.search(told):
        yield "poses of a camera that moves into a file named with 'T_world_cam_file'"
    if _ROBOT.search(told):
        yield "a robot's numbers into a .npy or .csv file named with 'state' or 'action'"
    if _TIMES.search(told):
        yield "times of the pictures into files named with 'times' and 'depth_times', or 'fps'"
