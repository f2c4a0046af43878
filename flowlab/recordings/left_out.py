"""Files of a recording that no stream uses: each is named, with the reason."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from flowlab.recordings.folder_files import FoundFile, files_below, no_files_below
from flowlab.recordings.foreign import foreign_format
from flowlab.recordings.metadata import FILE_NAME
from flowlab.recordings.unused_files import by_folder, robot_numbers, some_of
from flowlab.recordings.verdicts import Check, Verdict
from flowlab.text import cut

if TYPE_CHECKING:
    from flowlab.recordings.parsing import ParsedRecording

_NUMBERS = (".npy", ".csv", ".txt", ".tsv")
_OF_CAMERAS = ("poses", "trajectory", "extrinsics", "camera_pose")


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
    asked: list[Check] = []
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
    known, path = source.metadata, source.path
    used = {FILE_NAME}
    used |= {f for f in (known.times, known.depth_times, known.state, known.state_times, known.action,
                         known.action_times, known.T_world_cam_file, known.T_world_cam_times) if f}  # fmt: skip
    if source.streams.used is not None:
        return used | set(source.streams.used)
    if source.reader.name not in ("plain", "tum"):
        return None
    used |= {"intrinsic.json", "camera_intrinsic.json", "rgb.txt", "depth.txt", "ground_truth.npz"}
    used |= {"associations.txt", "associated.txt", "associate.txt", "groundtruth.txt"}
    pictures = (*source.streams.color.names, *source.streams.depth.names)
    folders = [Path(f) for f in (known.color, known.depth)]
    for name in pictures:
        used.add(name)
        used |= {(f / Path(name).name).as_posix() for f in folders if f.name == Path(name).parent.name}
        if Path(name).parent.name == path.name:  # pictures that lie in the recording's own folder
            used.add(Path(name).name)
    return used


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
    if name.stem.lower().startswith(_OF_CAMERAS) and source.streams.poses is None:
        says = (
            f"{cut(file.name)} is not used; if it has poses of a camera that moves, each camera to world, write "
            f"'T_world_cam_file: {cut(file.name)}' into {FILE_NAME}, if one of a camera that stands still, that as "
            "'T_world_cam'"
        )
        return Check("camera", Verdict.DOUBTFUL, says)
    return None


def _reason(file: FoundFile) -> str:
    return foreign_format(file.path) or "no stream uses it"


def check_widths_known(source: "ParsedRecording") -> Iterator[Check]:
    """Whether there are numbers of a robot at all."""
    widths = {what: sum(s.values.shape[1] for s in getattr(source.streams, what)) for what in ("state", "action")}
    if not widths["state"]:
        says = "there is none" + (", so the actions stand alone" if widths["action"] else ", and no action: no policy "
                                  "can be trained on it; name the robot's numbers with 'state'")  # fmt: skip
        yield Check("state", Verdict.ASSUMED, says)
