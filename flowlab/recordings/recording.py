"""Recordings of real robots as demonstrations: found, and opened."""

import logging
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from flowlab.demonstrations import Demonstration
from flowlab.errors import DataError, FlowlabError, UsageError
from flowlab.recordings.base import (
    BadImage,
    EpisodesReader,
    Reader,
    Streams,
    channel_names,
    expected_layouts,
    load_readers,
    recognizes,
)
from flowlab.recordings.description import RecordingDescription, StreamInfo, describe
from flowlab.recordings.folder_files import entries
from flowlab.recordings.foreign import foreign_format
from flowlab.recordings.frame_check import FrameCheck
from flowlab.recordings.frame_processing import FrameProcessor
from flowlab.recordings.identity import changed_since
from flowlab.recordings.parsing import (
    AlignedSamples,
    ParsedRecording,
    RecordingSettings,
    known_beforehand,
    parse_recording,
)
from flowlab.recordings.parts import place_of
from flowlab.recordings.sync import find_gaps
from flowlab.recordings.verdicts import CHECKS, raise_refused
from flowlab.records import Frame
from flowlab.text import shown

_LOG = logging.getLogger(__name__)
__all__ = [
    "Recording",
    "RecordingDescription",
    "RecordingSettings",
    "StreamInfo",
    "describe",
    "find_recordings",
    "open_recording",
]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Recording(Demonstration):
    """A recording of a real robot. Row t is a color picture, with the depth picture nearest in time.

    ``extras`` tells where everything comes from: see ``docs/recordings.md``.
    """

    path: Path
    streams: Streams
    processor: FrameProcessor
    frame_check: FrameCheck
    settings: RecordingSettings
    """How it is read."""
    content: str = ""
    """What it was known by when it was opened (:func:`~flowlab.recordings.identity.identity`), where that was asked."""

    def frame(self, t: int) -> Frame:
        """Decode the pictures of row t: depth float32 [m] seen from the color camera, and color."""
        try:
            rgb = self.streams.color.read(int(self.frame_check.color[t]))
            counts = self.streams.depth.read(int(self.frame_check.depth[t]))
        except BadImage as error:
            raise DataError(f"{self.path}: row {t} could be read when it was opened, and now it {error}") from error
        return Frame(self.processor.depth(counts), self.camera_at(t), rgb=self.processor.color(rgb))

    def changed(self) -> str:
        """What of the recording has changed since it was opened, after its path; empty where nothing has."""
        return changed_since(self.content, self.path, self.settings) if self.content else ""


def find_recordings(
    paths: Sequence[Path], reader: str | None = None, settings: RecordingSettings = RecordingSettings()
) -> list[Path]:
    """Every recording at or below some files and folders, and in files that hold several.

    Args:
        paths: Where to look. Hidden files below them are passed over; links are followed.
        reader: Import path ``module:Class`` of a reader to ask besides the installed ones; an installed one's name
            changes nothing.
        settings: Of these only the calibration file, which may say which groups of a file are recordings.

    Returns:
        The recordings, in natural order, each once.

    Raises:
        UsageError: A path does not exist or has no recording; the message says what was looked for.
    """
    readers = load_readers(reader)
    found: dict[Path, None] = {}
    for path in map(Path, paths):
        if not place_of(path).exists():
            raise UsageError(f"{path}: there is no such file or folder")
        below = [one for found in _below(path, readers) for one in _episodes(found, readers, settings)]
        if not below:
            says = foreign_format(path)
            raise UsageError(
                f"{path}: {says}"
                if says
                else f"{path}: no recording at or below it; looked for {expected_layouts(readers)}"
            )
        found.update(dict.fromkeys(below))
    return list(found)


def _below(path: Path, readers: tuple[Reader, ...], above: frozenset[Path] = frozenset()) -> Iterator[Path]:
    """The recordings at or below a path, behind links too; what is known not to be read is told of."""
    if any(recognizes(r, path) for r in readers):
        yield path
    elif says := foreign_format(path):
        _LOG.warning("flowlab: %s: %s; it is left out", path, says)
    elif path.is_symlink() and not path.exists():
        _LOG.warning(
            "flowlab: %s: is a link that leads nowhere (to %s); it is left out", path, shown(os.readlink(path))
        )
    elif path.is_dir() and (real := path.resolve()) not in above:
        for name in entries(path):
            yield from _below(path / name, readers, above | {real})


def _episodes(path: Path, readers: tuple[Reader, ...], settings: RecordingSettings) -> list[Path]:
    """The recordings in a file that holds several; the file itself where that is not clear, so that opening tells."""
    reader = next(r for r in readers if recognizes(r, path))
    if not isinstance(reader, EpisodesReader) or not path.exists():
        return [path]
    try:
        return [path / name for name in reader.episodes(path, known_beforehand(path, settings))] or [path]
    except FlowlabError:
        return [path]


def open_recording(path: Path, settings: RecordingSettings, *, task: str, seed: int) -> Recording:
    """A recording as a demonstration; every picture is decoded once to find the bad ones, and none is kept.

    Where actions were not recorded, ``action[t]`` is ``state[t + 1]`` (the last row repeats its own state);
    where state was not either, both are (T, 0). ``success`` holds on the last row only. Raises
    :class:`DataError` with one sentence where it cannot be opened.
    """
    source = parse_recording(Path(path), settings)
    raise_refused(path, source.streams.checks)
    processor = source.frame_processor(settings)
    source.check_bad_frames(settings)
    raise_refused(path, source.checks)
    rows = source.rows()
    success = np.zeros(len(rows.clock_s), bool)
    success[-1] = source.metadata.success
    recording = Recording(
        task=task,
        seed=seed,
        camera=processor.camera,
        time_s=rows.clock_s - rows.clock_s[0],
        state=rows.state,
        action=rows.action,
        success=success,
        extras=_extras(source, processor, rows),
        T_world_cam=source.frame_check.T_world_cam,
        path=source.path,
        streams=source.streams,
        processor=processor,
        frame_check=source.frame_check,
        settings=settings,
    )
    if processor.registration is not None and not recording.frame(0).depth.any():
        raise DataError(
            f"{path}: with this T_color_depth no depth reading lies in the color picture; it must map coordinates "
            f"of the depth camera to the color camera, in meters; correct it in {source.write_to}"
        )
    return recording


def _world(source: ParsedRecording) -> str:
    """What the world frame is, in words."""
    if source.streams.poses is not None:
        return f"as the poses of the camera say, from {source.streams.poses.name}"
    return "as T_world_cam says" if "T_world_cam" in source.origin else "the camera's own frame"


def _source(path: Path) -> str:
    """What an episode says it is from."""
    above = place_of(path).parent if path.is_absolute() else Path()
    return path.relative_to(above).as_posix()


def _extras(source: ParsedRecording, processor: FrameProcessor, rows: AlignedSamples) -> dict[str, Any]:
    """Where a recording comes from, as JSON values."""
    seen, streams = source.frame_check, source.streams
    return {
        "source": _source(source.path),
        "reader": source.reader.name,
        "frames": {"color": len(streams.color), "depth": len(streams.depth), "looked_at": seen.looked_at},
        "bad_frames": [[b.name, b.reason] for b in seen.bad],
        "gaps_s": [list(gap) for gap in find_gaps(rows.clock_s - rows.clock_s[0])],
        "max_sync_error_s": {k: float(off.max()) for k, off in seen.sync_s.items() if len(off)},
        "depth_unit_m": processor.depth_unit_m,
        "shrunk_by": processor.factor,
        "origin": dict(sorted(source.origin.items())),
        "world": _world(source),
        "action": rows.action_source,
        "state_names": channel_names(streams.state),
        "action_names": channel_names(streams.action),
        CHECKS: [check.to_json() for check in source.checks],
    }
