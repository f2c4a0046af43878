"""The plain folder: ``color/``, ``depth/`` and a ``recording.yaml``; what flowlab itself writes."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from flowlab.errors import DataError
from flowlab.recordings.base import Streams
from flowlab.recordings.file_stamps import read_names
from flowlab.recordings.image_files import COLOR_SUFFIXES, DEPTH_SUFFIXES, color_stream, depth_stream, list_images
from flowlab.recordings.readers.open3d_json import FILES, open3d_calibration
from flowlab.recordings.recording_yaml import FILE_NAME, TRUE_TRACKS, Metadata, load_metadata
from flowlab.recordings.sample_files import load_times
from flowlab.recordings.stamps import Timing
from flowlab.recordings.writing import write_rgbd_recording
from flowlab.text import counted

__all__ = ["PlainReader", "write_rgbd_recording"]


class PlainReader:
    """Reads folders of color and depth pictures."""

    name = "plain"
    expects = f"a folder with color/, depth/ and {FILE_NAME}"
    fallback = True

    def probe(self, path: Path) -> bool:
        """Whether it has the two folders, which ``recording.yaml`` may call otherwise."""
        folders = Metadata()
        if (path / FILE_NAME).is_file():
            try:
                folders = load_metadata(path / FILE_NAME)
            except DataError:
                return True  # so that reading it says what is wrong
        return (path / folders.color).is_dir() and (path / folders.depth).is_dir()

    def read(self, path: Path, given: Metadata) -> Streams:
        """The streams; their times are the numbers in the names over ``fps``, or from files."""
        known, checks, unread = open3d_calibration(path, given.ignore)
        fps = given.fps or next((m.fps for _, m in known if m.fps), None)
        return replace(read_folder(path, given, fps, known), checks=checks, unread=unread)


def read_folder(path: Path, given: Metadata, fps: float | None, known: tuple[tuple[str, Metadata], ...]) -> Streams:
    """The streams of a folder with two folders of pictures."""
    color = _list(path, "color", given.color, COLOR_SUFFIXES)
    depth = _list(path, "depth", given.depth, DEPTH_SUFFIXES)
    read = [name for name in FILES if (path / name).is_file()][:1]
    used = (TRUE_TRACKS, *read, *(f.relative_to(path).as_posix() for f in (*color, *depth)))
    if given.times is not None:
        color_stamps = _listed(path / given.times, color)
        own = given.depth_times is not None
        depth_stamps = _listed(path / given.depth_times, depth) if own else _shared(path, given, color, depth)  # type: ignore[operator]
        return Streams(color_stream(color, *color_stamps), depth_stream(depth, *depth_stamps), known=known, used=used)
    return Streams(
        color_stream(*read_names(color, f"the names in {given.color}/")),
        depth_stream(*read_names(depth, f"the names in {given.depth}/")),
        known=known,
        used=used,
    )


def _list(path: Path, what: str, folder: str, suffixes: tuple[str, ...]) -> list[Path]:
    """The pictures of a folder, of which there must be some."""
    if not (path / folder).is_dir():
        raise DataError(
            f"{path}: has no folder '{folder}'; name that of the {what} pictures in {FILE_NAME}, '{what}: ...'"
        )
    found = list_images(path / folder, suffixes)
    if not found:
        raise DataError(f"{path / folder}: has no {what} pictures; expected {', '.join(suffixes)}")
    return found


def _listed(file: Path, pictures: list[Path]) -> tuple[Float64[np.ndarray, "N"], Timing]:
    """The times of pictures from a file."""
    stamps, timing = load_times(file)
    if len(stamps) != len(pictures):
        raise DataError(
            f"{file}: has {len(stamps)} times for {counted(len(pictures), 'picture')} in {pictures[0].parent.name}/; "
            "give one a picture, and depth its own file with 'depth_times' where its pictures are others"
        )
    return stamps, timing


def _shared(
    path: Path, given: Metadata, color: list[Path], depth: list[Path]
) -> tuple[Float64[np.ndarray, "N"], Timing]:
    """The times of color for depth, where every depth picture is named as a color picture is."""
    names = [[re.sub(r"\D+", " ", f.stem).split() or [f.stem] for f in files] for files in (color, depth)]
    if names[0] != names[1] and [f.stem for f in color] != [f.stem for f in depth]:
        raise DataError(
            f"{path / str(given.times)}: has the times of the color pictures, and the depth pictures are not named as "
            f"those are ({color[0].name} to {color[-1].name}, {depth[0].name} to {depth[-1].name}); give depth its own "
            "file with 'depth_times'"
        )
    return _listed(path / str(given.times), depth)
