"""Files of a recording that no stream uses: each is named, with the reason."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from flowlab.array_files import load_array
from flowlab.errors import FlowlabError
from flowlab.recordings.camera_numbers import called_poses, camera_numbers
from flowlab.recordings.folder_files import FoundFile, files_below, no_files_below
from flowlab.recordings.foreign import foreign_format
from flowlab.recordings.metadata import FILE_NAME, Metadata
from flowlab.recordings.unused_files import by_folder, robot_numbers, some_of
from flowlab.recordings.verdicts import Check, Verdict
from flowlab.text import cut
from flowlab.untrusted import read_text

if TYPE_CHECKING:
    from flowlab.recordings.parsing import ParsedRecording

_NUMBERS = (".npy", ".csv", ".txt", ".tsv", ".json", ".log")
_MOST_READ = 4 << 20
"""Larger files of numbers are told by their names alone [bytes]."""
_MANY = 3
"""So many files of poses in a folder are one for each picture."""


def find_left_out(source: "ParsedRecording") -> Iterator[Check]:
    """What of a recording's folder is not used, and why."""
    if not source.path.is_dir():
        return  # what lies beside a file belongs to other recordings
    used = _used(source)
    if used is None:
        says = f"the reader '{source.reader.name}' does not say which files it uses"
        yield Check("left out", Verdict.ASSUMED, says)
        return
    unused = [f for f in files_below(source.path) if not _is_used(f.name, used)]
    asked, unused = _pose_folders(source, unused)
    for file in list(unused):
        if (check := _asked(source, file)) is not None:
            asked.append(check)
            unused.remove(file)
    yield from asked
    groups: dict[str, list[str]] = {}
    for file in unused:
        groups.setdefault(_reason(file), []).append(file.name)
    for name, why in no_files_below(source.path):
        groups.setdefault(why, []).append(name)
    says = "; ".join(f"{some_of(by_folder(names))} ({why})" for why, names in groups.items())
    yield Check("left out", Verdict.OK, says or "every file is used")


def _is_used(name: str, used: set[str]) -> bool:
    """Whether a file, or a folder that it is in, is used."""
    return name in used or any(folder.as_posix() in used for folder in Path(name).parents)


def _used(source: "ParsedRecording") -> set[str] | None:
    """The files that are used, by their names below the folder; None where that is not known."""
    known, used = source.metadata, {FILE_NAME}
    used |= {f for f in (known.times, known.depth_times, known.state, known.state_times, known.action,
                         known.action_times, known.T_world_cam_file, known.T_world_cam_times) if f}  # fmt: skip
    return None if source.streams.used is None else used | set(source.streams.used)


def _asked(source: "ParsedRecording", file: FoundFile) -> Check | None:
    """A doubt about a file that may be the robot's numbers or the camera's poses, with what to write."""
    name = Path(file.name)
    if name.suffix.lower() not in _NUMBERS or len(name.parts) > 2:
        return None
    for what in ("state", "action"):
        if robot_numbers(name.stem, what) and not getattr(source.streams, what):
            says = (
                f"{cut(file.name)} is not used; if it is the {what}, write '{what}: {cut(file.name)}' into {FILE_NAME}"
            )
            return Check(what, Verdict.DOUBTFUL, says)
    values = _values(file.path)
    if (asked := _of_rows(source, file, values)) is not None:
        return asked
    why = _of_camera(source, file, values)
    return None if why is None else Check("camera", Verdict.DOUBTFUL, f"{cut(file.name)} is not used; {why}")


def _of_rows(source: "ParsedRecording", file: FoundFile, values: np.ndarray | None) -> Check | None:
    """A doubt about a file with numbers for every picture, which may be the robot's; None where it has none."""
    steps = {len(source.streams.color), len(source.streams.depth)}
    if values is None or values.ndim != 2 or len(values) not in steps or called_poses(Path(file.name).stem.lower()):
        return None
    rises = values.shape[1] == 1 and len(values) > 1 and (np.diff(values[:, 0]) > 0).all()
    if source.streams.state or rises:  # as times do, which are compared with those that are used
        return None
    name = cut(file.name)
    says = f"{name} has {values.shape[1]} numbers for every picture and is not used; if it is the state, write"
    return Check("state", Verdict.DOUBTFUL, f"{says} 'state: {name}' into {FILE_NAME}")


def _of_camera(source: "ParsedRecording", file: FoundFile, values: np.ndarray | None) -> str | None:
    """What is said of a file that may have numbers of the camera; None where it has none."""
    name, posed = Path(file.name), source.streams.poses is not None
    says = None if values is None else camera_numbers(name.stem, values, source.metadata, posed)
    if says is not None or (values is not None and values.shape[-2:] in ((4, 4), (3, 4), (3, 3))):
        return says
    if posed or not called_poses(name.stem):
        return None
    return (f"if it has poses of a camera that moves, each camera to world, write 'T_world_cam_file: {cut(file.name)}' "
            f"into {FILE_NAME}, if one of a camera that stands still, that as 'T_world_cam'")  # fmt: skip


def _values(path: Path) -> np.ndarray | None:
    """The numbers of a small file; None where it holds something else."""
    try:
        if path.stat().st_size > _MOST_READ:
            return None
        if path.suffix.lower() == ".npy":
            return load_array(path)
        return np.array([[float(x) for x in re.split(r"[,;\s]+", line.strip())]
                         for line in read_text(path).splitlines() if line.strip()])  # fmt: skip
    except (FlowlabError, ValueError, OSError):
        return None


def _pose_folders(source: "ParsedRecording", files: list[FoundFile]) -> tuple[list[Check], list[FoundFile]]:
    """A doubt for each folder with a pose for every picture; and the other files."""
    folders: dict[str, list[FoundFile]] = {}
    for file in files:
        if Path(file.name).suffix.lower() in _NUMBERS:
            folders.setdefault(Path(file.name).parent.as_posix(), []).append(file)
    asked, left = [], list(files)
    for folder, found in folders.items():
        if folder == "." or len(found) < _MANY or source.streams.poses is not None:
            continue
        values = _values(found[0].path)
        if values is None or camera_numbers("poses", values, Metadata(), False) is None:
            continue
        says = (f"{cut(folder)}/ has {len(found)} files with a rigid transform each, and is not used; if they are the "
                f"poses of the camera, write them, camera to world, into one file, named as 'T_world_cam_file' in "
                f"{FILE_NAME}")  # fmt: skip
        asked.append(Check("camera", Verdict.DOUBTFUL, says))
        left = [file for file in left if file not in found]
    return asked, left


def _reason(file: FoundFile) -> str:
    return foreign_format(file.path) or "no stream uses it"


def check_widths_known(source: "ParsedRecording") -> Iterator[Check]:
    """Whether there are numbers of a robot at all."""
    widths = {what: sum(s.values.shape[1] for s in getattr(source.streams, what)) for what in ("state", "action")}
    if not widths["state"]:
        says = "there is none" + (", so the actions stand alone" if widths["action"] else ", and no action: no policy "
                                  "can be trained on it; name the robot's numbers with 'state'")  # fmt: skip
        yield Check("state", Verdict.ASSUMED, says)
