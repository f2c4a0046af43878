"""A recording whose layout is understood: its streams, what is known of it, which frames are bad."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float32, Float64
from pydantic import Field

from flowlab.config import Settings
from flowlab.errors import DataError
from flowlab.recordings.base import Reader, Streams, choose_reader, read_streams
from flowlab.recordings.checking import check_recording
from flowlab.recordings.chosen_columns import with_chosen_columns
from flowlab.recordings.clock import put_on_one_clock
from flowlab.recordings.frame_check import FrameCheck, align_samples, check_frames
from flowlab.recordings.frame_processing import FrameProcessor, make_frame_processor
from flowlab.recordings.parts import place_of
from flowlab.recordings.poses import ABOUT, load_poses, most_apart_s
from flowlab.recordings.recording_yaml import FILE_NAME, Metadata, combine, load_metadata
from flowlab.recordings.sample_files import load_samples
from flowlab.recordings.saturation import without_saturated
from flowlab.recordings.stamps import UnclearStamps
from flowlab.recordings.sync import last_sample, nearest_sample
from flowlab.recordings.verdicts import Check, Verdict


class RecordingSettings(Settings):
    """How recordings are read."""

    reader: str | None = None
    """Name of the reader to use; else the one that recognizes the recording."""
    calibration: Path | None = None
    """A YAML file with the keys of ``recording.yaml``, for every recording; it wins over their own."""
    max_sync_s: float = Field(default=0.02, gt=0)
    """A color frame without a depth frame this near [s] is bad."""
    max_state_s: float = Field(default=0.1, gt=0)
    """A color frame without a sample of robot state this near [s] is bad."""
    bad_frames: Literal["skip", "reject"] = "skip"
    """What to do with bad frames: leave them out, or reject the recording."""
    max_bad_share: float = Field(default=0.1, ge=0, le=1)
    """A recording with a greater share of bad frames is rejected all the same."""
    max_width: int = Field(default=640, gt=0)
    """Larger pictures are shrunk by a whole factor [px]."""
    every: int = Field(default=1, gt=0)
    """Take every n-th color frame."""
    start_s: float = Field(default=0.0, ge=0)
    """Leave out what was before, since the first color frame [s]."""
    stop_s: float | None = Field(default=None, gt=0)
    """Leave out what was after, since the first color frame [s]."""


@dataclass(frozen=True, slots=True)
class AlignedSamples:
    """The numbers of every row."""

    clock_s: Float64[np.ndarray, "T"]
    """On the clock of the recording."""
    state: Float32[np.ndarray, "T S"]
    action: Float32[np.ndarray, "T A"]
    action_source: str
    """How the action was found, in words."""


@dataclass(frozen=True)
class ParsedRecording:
    """A recording whose layout is understood."""

    path: Path
    reader: Reader
    streams: Streams
    metadata: Metadata
    origin: Mapping[str, str]
    frame_check: FrameCheck

    @cached_property
    def checks(self) -> tuple[Check, ...]:
        """What was looked at, and what came of it; what is refused is among them."""
        return (*self.streams.checks, *self.frame_check.checks, *check_recording(self))

    @property
    def write_to(self) -> str:
        """What errors tell the user to write into."""
        return _write_to(self.path)

    def frame_processor(self, settings: RecordingSettings = RecordingSettings()) -> FrameProcessor:
        """What makes frames of it. Raises :class:`DataError` where calibration is missing or cannot be."""
        seen = self.frame_check
        if not len(seen.color):
            first = f"; {seen.bad[0].name} {seen.bad[0].reason}" if seen.bad else ""
            raise DataError(f"{self.path}: none of {seen.looked_at} frames can be used{first}")
        made = make_frame_processor(
            self.path,
            self.metadata,
            seen.color_size,
            seen.depth_size,
            registered=self.streams.registered,
            max_width=settings.max_width,
            write_to=self.write_to,
            median_counts=seen.median_counts,
        )
        return made if seen.T_world_cam is None else replace(made, camera=made.camera.at(seen.T_world_cam[0]))

    def check_bad_frames(self, settings: RecordingSettings) -> None:
        """Raise :class:`DataError` where there are more bad frames than the settings allow."""
        seen = self.frame_check
        allowed = 0.0 if settings.bad_frames == "reject" else settings.max_bad_share
        if len(seen.bad) > allowed * seen.looked_at or len(seen.color) < 2:
            some = "; ".join(f"{b.name} {b.reason}" for b in seen.bad[:3]) or "there are no others"
            raise DataError(
                f"{self.path}: {len(seen.bad)} of {seen.looked_at} frames are bad ({some}), "
                f"and {'none' if not allowed else f'at most {allowed:.0%}'} may be; see max_bad_share, "
                "max_sync_s and max_state_s"
            )

    def rows(self) -> AlignedSamples:
        """What the robot was and did at every row."""
        clock = self.streams.color.time_s[self.frame_check.color]
        state = align_samples(self.streams.state, clock, nearest_sample)
        if self.streams.action:
            action, how = align_samples(self.streams.action, clock, last_sample), "the last one recorded up to the row"
        elif self.streams.state:
            action, how = np.concatenate([state[1:], state[-1:]]), "state of the next row"
        else:
            action, how = state, "none recorded"
        return AlignedSamples(clock, state, action, how)


def _write_to(path: Path) -> str:
    """What errors tell the user to write into."""
    path = place_of(path)
    return f"{path / FILE_NAME if path.is_dir() else path.with_suffix('.yaml')} (or the calibration file)"


def parse_recording(path: Path, settings: RecordingSettings) -> ParsedRecording:
    """Read the streams, find out what is known of them, and look at every picture."""
    reader = choose_reader(path, settings.reader)
    given = list(_given(path, settings))
    said = combine(given)[0]
    streams = with_chosen_columns(path, read_streams(reader, path, said), said)
    for stream in (streams.color, streams.depth):
        if not len(stream):
            raise DataError(f"{path}: has no {'color' if stream is streams.color else 'depth'} pictures")
    metadata, origin = combine([*given, *streams.known])
    try:
        streams = without_saturated(put_on_one_clock(_with_files(path, streams, metadata, said), metadata))
    except UnclearStamps as error:
        raise DataError(f"{path}: clock: {error}; all this goes into {_write_to(path)}") from error
    seen = check_frames(
        streams,
        every=settings.every,
        start_s=settings.start_s,
        stop_s=settings.stop_s,
        max_sync_s=settings.max_sync_s,
        max_state_s=settings.max_state_s,
        pose_gap_s=most_apart_s(streams.color, metadata.T_world_cam_gap_s),
        stated={s: off for s in ("depth", "state") if (off := getattr(metadata, f"{s}_offset_s")) is not None},
        rendered=metadata.rendered,
        aligned=streams.registered is not False
        and metadata.depth_intrinsics is None
        and metadata.T_color_depth is None,
    )
    return ParsedRecording(path, reader, streams, metadata, origin, seen)


def known_beforehand(path: Path, settings: RecordingSettings) -> Metadata:
    """What the user says of a recording, in the calibration file and in ``recording.yaml`` in or beside it.

    Raises:
        DataError: One of these files is not as it should be.
    """
    return combine(_given(path, settings))[0]


def _given(path: Path, settings: RecordingSettings) -> Iterator[tuple[str, Metadata]]:
    """What the user says, most important first: the calibration file, then ``recording.yaml`` in or beside it."""
    if settings.calibration is not None:
        yield settings.calibration.name, load_metadata(settings.calibration)
    for file in files_of_metadata(path):
        if file.is_file():
            yield file.name, load_metadata(file)


def files_of_metadata(path: Path) -> list[Path]:
    """Where what is said of a recording may be: in its folder, or beside its file, most important first."""
    path = place_of(path)
    return [path / FILE_NAME] if path.is_dir() else [path.with_suffix(".yaml"), path.parent / FILE_NAME]


def _with_files(path: Path, streams: Streams, metadata: Metadata, said: Metadata) -> Streams:
    """The streams, with state and actions from files where ``recording.yaml`` names some."""
    folder = files_of_metadata(path)[-1].parent
    changed: dict[str, Any] = {}
    for name in ("state", "action"):
        file, times = getattr(metadata, name), getattr(metadata, f"{name}_times")
        if file is not None:
            where = None if times is None else folder / times
            columns = getattr(metadata, f"{name}_columns")
            samples = load_samples(folder / file, name, where, streams.color, FILE_NAME, columns, metadata.fps)
            changed[name] = (samples,)
    if metadata.T_world_cam_file is not None:
        times = metadata.T_world_cam_times
        where = None if times is None else folder / times
        changed["poses"] = load_poses(folder / metadata.T_world_cam_file, where, streams.color)
    return _with_one_pose(path, replace(streams, **changed), said)


def _with_one_pose(path: Path, streams: Streams, said: Metadata) -> Streams:
    """The same streams, whose poses are not contradicted. Raises :class:`DataError` where they are."""
    if said.T_world_cam_file is not None and said.T_world_cam is not None:
        raise DataError(f"{path}: T_world_cam says that the camera stands still, and T_world_cam_file that it moves; "
                        f"leave one of them out of {_write_to(path)}")  # fmt: skip
    if streams.poses is None:
        of_poses = [f"T_world_cam_{x}" for x in ("times", "offset_s", "gap_s")
                    if getattr(said, f"T_world_cam_{x}") is not None]  # fmt: skip
        if of_poses:
            raise DataError(f"{path}: '{of_poses[0]}' is said, but there are no poses that it could be said of; name "
                            f"them with 'T_world_cam_file' in {_write_to(path)}")  # fmt: skip
        return streams
    if said.T_world_cam is None:
        return streams
    says = (f"{streams.poses.name} has {len(streams.poses.values)} poses of it, which are not used, since "
            "T_world_cam says where it stands still; leave that out to use them")  # fmt: skip
    return replace(streams, poses=None, checks=(*streams.checks, Check(ABOUT, Verdict.DOUBTFUL, says)))
