"""An episode of an HDF5 file: which group it is, by which layout it is read, and which of its cameras is used."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from flowlab.errors import DataError
from flowlab.recordings.hdf5_map import HDF5Map
from flowlab.recordings.readers.hdf5_array import HDF5Array
from flowlab.recordings.readers.hdf5_layouts import IN_HAND, LAYOUTS, HDF5Layout, cameras_of, known_layout, map_of
from flowlab.recordings.readers.hdf5_pictures import is_encoded
from flowlab.recordings.readers.hdf5_process import HDF5Access
from flowlab.recordings.recording_yaml import Metadata
from flowlab.recordings.unused_files import some_of
from flowlab.recordings.verdicts import Check, Verdict
from flowlab.text import counted, shown


@dataclass(frozen=True, slots=True)
class HDF5Episode:
    """An episode, and how it is read."""

    data: HDF5Access
    group: str
    """Empty where the file is one episode."""
    names: tuple[str, ...]
    """Of its arrays."""
    layout: HDF5Layout | None
    """None where a map tells all."""
    meant: HDF5Map
    """Where everything is, and how it is meant."""
    said: HDF5Map
    """What of this the user says."""
    checks: tuple[Check, ...]

    @property
    def where(self) -> Path:
        """What errors call it."""
        return self.data.path / self.group

    def pictures(self, what: str) -> HDF5Array:
        """The array of ``color`` or ``depth``. Raises :class:`DataError` where there is none."""
        name = getattr(self.meant, what)
        found = self.data.array(self.group, name)
        if found is None:
            has = some_of(self.names)
            raise DataError(f"{self.where}: has no array {shown(name)} to be the {what}; it has {has}")
        return found

    def value(self, source: str | None) -> Any:
        """Numbers or text from the file; None where nothing names any, or there are none."""
        return None if source is None else self.data.value(self.group, source)


def episode_pattern(data: HDF5Access, given: Metadata) -> str:
    """Which groups are an episode each: as the user says, or as a layout has it whose groups are there."""
    said = given.hdf5 or HDF5Map()
    if said.episodes is not None:
        return said.episodes.strip("/")
    if said.color is not None and said.depth is not None:
        return ""
    return next((p for x in LAYOUTS if (p := x.map.episodes) and data.matching(p)), "")


def episode_group(data: HDF5Access, path: Path, part: str, episodes: Sequence[str]) -> str:
    """The group of the episode that a path means.

    Args:
        data: The file.
        path: The recording.
        part: What of it leads on into the file.
        episodes: Those that there are; none where the file is one.

    Raises:
        DataError: It is none of them, or there are several and it names none.
    """
    if part in episodes or (not part and not episodes):
        return part
    if not part and len(episodes) == 1:
        return episodes[0]
    if not episodes:
        raise DataError(f"{path}: {data.path.name} has no episode {shown(part)}; name the file alone")
    found = f"has {counted(len(episodes), 'episode')}" if not part else f"{data.path.name} has no episode {shown(part)}"
    example = data.path / episodes[0]
    raise DataError(f"{path}: {found}; name one of them, as in {example}; there are {some_of(episodes)}")


def understood(data: HDF5Access, group: str, given: Metadata) -> HDF5Episode:
    """The episode by its layout, whose map the user's own changes; or by that alone, where it names both pictures.

    Raises:
        DataError: The layout is not known, has no depth, or several cameras of which none is named.
    """
    said, names = given.hdf5 or HDF5Map(), tuple(data.arrays(group))
    if said.color is not None and said.depth is not None:
        check = Check("layout", Verdict.OK, f"as the map says; color is {said.color}, depth {said.depth}")
        return HDF5Episode(data, group, names, None, said, said, (check,))
    layout = known_layout(None if said.episodes else episode_pattern(data, given), names)
    write_to = data.path.with_suffix(".yaml").name
    if layout is None:
        told = [f"{name} {a.says}" for name in names[:8] if (a := data.array(group, name)) is not None]
        raise DataError(f"{data.path / group}: is HDF5 of a layout that is not known, with "
                        f"{'; '.join(told) or 'no arrays'}; write 'hdf5: {{color: ..., depth: ..., state: [...], "
                        f"action: [...]}}' into {write_to} (docs/hdf5.md)")  # fmt: skip
    cameras = cameras_of(layout, names, with_depth=said.depth is None)
    lacking = [c for c in cameras_of(layout, names, with_depth=False) if c not in cameras]
    try:
        camera, check = _chosen(layout, cameras, lacking, given.camera)
    except DataError as error:
        raise DataError(f"{data.path / group}: {error}; it goes into {write_to}") from error
    meant = _meant(data, group, layout, camera, names, said)
    void = {what for what, is_so in (("color", meant.color_order == "rgb"), ("flip", meant.flip == "none")) if is_so}
    notes = [Check(about, Verdict.ASSUMED, says) for about, says in layout.notes.items() if about not in void]
    return HDF5Episode(data, group, names, layout, meant, said, (check, *notes))


def _meant(
    data: HDF5Access, group: str, layout: HDF5Layout, camera: str, names: Sequence[str], said: HDF5Map
) -> HDF5Map:
    """Where everything is: as the layout has it, of what there is, and as the user says."""
    color = data.array(group, said.color or str(layout.map.color).replace("{camera}", camera))
    meant = map_of(layout, camera, encoded=color is not None and is_encoded(color))
    numbers = {"state": next((s for s in layout.states if _any_of(names, s)), ()), "action": meant.action}
    there = {what: tuple(p for p in patterns if _any_of(names, (p,))) for what, patterns in numbers.items()}
    if layout.convention is not None and data.value(group, layout.convention) == "opencv":
        meant = meant.model_copy(update={"flip": "none"})
    return meant.model_copy(update={**there, **{key: getattr(said, key) for key in said.model_fields_set}})


def _any_of(names: Sequence[str], patterns: Sequence[str]) -> bool:
    return any(fnmatchcase(name, pattern) for name in names for pattern in patterns)


def _chosen(layout: HDF5Layout, cameras: list[str], lacking: list[str], named: str | None) -> tuple[str, Check]:
    """The camera to use: the one that is named, the only one with depth, or the only one that no robot holds."""
    where = f"is a file of {layout.name}"
    if not cameras:
        found = f"holds color of {some_of(lacking)} but no depth" if lacking else "holds no pictures"
        raise DataError(f"{where} that {found}; {layout.without}, or name it with 'hdf5: {{color: ..., depth: ...}}'")
    if named is not None and named not in cameras:
        raise DataError(f"{where} whose cameras with depth are {some_of(cameras)}, and 'camera' says {shown(named)}")
    still = [c for c in cameras if not IN_HAND.search(c) and not re.fullmatch(layout.held, c)] or cameras
    if named is None and len(still) > 1:
        raise DataError(f"{where} with several cameras, {some_of(cameras)}; choose one with 'camera: {still[0]}'")
    camera = named or still[0]
    held = [] if named else [c for c in cameras if c != camera]
    says = f"{layout.name}, of the camera {camera}"
    says += f"; in a hand, and so not taken: {some_of(held)} ('camera: {held[0]}' takes it)" if held else ""
    says += f"; without depth: {some_of(lacking)}" if lacking else ""
    return camera, Check("layout", Verdict.ASSUMED if held else Verdict.OK, says)
