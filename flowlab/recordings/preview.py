"""What people are shown of a recording before the work: some pictures, the cloud, and every stream over time."""

import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64, Int64, UInt8

from flowlab.errors import DataError
from flowlab.geometry.camera import Camera
from flowlab.recordings.base import BadImage, ImageStream, SampleStream, Streams, choose_reader, read_streams
from flowlab.recordings.frame_processing import FrameProcessor
from flowlab.recordings.parsing import ParsedRecording, RecordingSettings, known_beforehand
from flowlab.recordings.registration_check import depth_edges
from flowlab.recordings.sync import find_gaps

_CLOUD_POINTS = 80_000
_REACH_M = 3.0
"""Numbers that spread over more are not the places of a gripper."""
_PLACES = re.compile(r"(?:^|[^a-z0-9])(?:p(?:os)?_?)?[xyz]$", re.IGNORECASE)
"""What coordinates are called: ``x``, ``tcp_x``, ``ee.pos_x``."""


@dataclass(frozen=True, slots=True)
class PicturePreview:
    """A color picture, with the edges of the depth that belongs to it."""

    name: str
    time_s: float | None
    """Since the first color frame [s]; None where the clock is not clear."""
    rgb: UInt8[np.ndarray, "H W 3"]
    edges: Bool[np.ndarray, "H W"] | None
    """Pixels at which something near ends before something farther away; None where depth is seen from elsewhere."""


@dataclass(frozen=True, slots=True)
class StreamPreview:
    """When the samples of a stream were taken, since the first color frame [s]."""

    name: str
    time_s: Float64[np.ndarray, "N"]
    gaps: tuple[tuple[float, float], ...] = ()
    """Start and length."""
    repeated_s: Float64[np.ndarray, "R"] | None = None
    """Pictures that are the same as the one before; None of a stream of numbers."""
    skipped_s: Float64[np.ndarray, "B"] | None = None
    """Color frames that make no row, since they are bad; None of other streams."""


@dataclass(frozen=True, slots=True)
class CloudPreview:
    """The first frame's points in the world, and where the camera and the gripper are."""

    xyz_world: Float64[np.ndarray, "P 3"]
    rgb: UInt8[np.ndarray, "P 3"]
    camera: Camera
    gripper_world: Float64[np.ndarray, "T 3"] | None
    """Where the state says that the gripper was; None where its numbers cannot be that."""
    gripper_names: str = ""
    """Which numbers of the state these are."""
    camera_path_world: Float64[np.ndarray, "T 3"] | None = None
    """Where a camera that moves is in every row."""


@dataclass(frozen=True, slots=True)
class RecordingPreview:
    """As much as can be shown of a recording; of one that is refused, what could be read."""

    pictures: tuple[PicturePreview, ...] = ()
    """The first, the middle and the last."""
    streams: tuple[StreamPreview, ...] = ()
    """Empty where the clock is not clear."""
    cloud: CloudPreview | None = None
    """None where calibration is missing."""


def preview_recording(path: Path, settings: RecordingSettings, source: ParsedRecording | None) -> RecordingPreview:
    """What can be shown of a recording.

    Args:
        path: The recording.
        settings: How it is read.
        source: What was understood of it; None where nothing could be, so that its pictures are all there is.

    Returns:
        The preview, empty where not even pictures could be found.
    """
    if source is None:
        with suppress(DataError):
            streams = read_streams(choose_reader(path, settings.reader), path, known_beforehand(path, settings))
            return RecordingPreview(tuple(_undated(streams)))
        return RecordingPreview()
    processor = None
    with suppress(DataError):
        processor = source.frame_processor(settings)
    pictures = tuple(_pictures(source, processor, settings.max_width)) or tuple(_undated(source.streams))
    return RecordingPreview(pictures, tuple(_streams(source)), _cloud(source, processor))


def _three(count: int) -> Int64[np.ndarray, "K"]:
    """The first, the middle and the last of so many."""
    return np.unique([0, (count - 1) // 2, count - 1]) if count else np.empty(0, np.int64)


def _undated(streams: Streams) -> Iterator[PicturePreview]:
    """Color pictures of a recording whose clock is not clear, or none of whose frames can be used."""
    for i in _three(len(streams.color)):
        with suppress(BadImage):
            rgb = streams.color.read(int(i))
            if rgb.ndim == 3:
                yield PicturePreview(streams.color.names[i], None, _thinned(rgb, 640), None)


def _pictures(source: ParsedRecording, processor: FrameProcessor | None, width: int) -> Iterator[PicturePreview]:
    """Some rows, as frames where calibration is known, else as they were recorded."""
    seen, streams = source.frame_check, source.streams
    for row in _three(len(seen.color)):
        i, j = int(seen.color[row]), int(seen.depth[row])
        with suppress(BadImage):
            rgb, depth = streams.color.read(i), streams.depth.read(j)
            if processor is not None:
                rgb, depth = processor.color(rgb), processor.depth(depth)
            else:
                rgb, depth = _thinned(rgb, width), _thinned(depth, width)
            apart = depth.shape != rgb.shape[:2] or (processor is None and streams.registered is False)
            edges = None if apart else depth_edges(depth).max(0) > 0
            yield PicturePreview(streams.color.names[i], float(_since(streams, streams.color)[i]), rgb, edges)


def _thinned(picture: np.ndarray, width: int) -> np.ndarray:
    """One pixel of every block, of a picture that is wider."""
    n = -(-picture.shape[1] // width)
    return picture[::n, ::n]


def _since(streams: Streams, stream: ImageStream | SampleStream) -> Float64[np.ndarray, "N"]:
    return np.asarray(stream.time_s - streams.color.time_s[0])


def _streams(source: ParsedRecording) -> Iterator[StreamPreview]:
    """Every stream over time."""
    streams, seen = source.streams, source.frame_check
    for name, stream in (("color", streams.color), ("depth", streams.depth)):
        time_s = _since(streams, stream)
        skipped = time_s[seen.skipped] if name == "color" else None
        yield StreamPreview(name, time_s, find_gaps(time_s), time_s[seen.repeated[name]], skipped)
    poses = () if streams.poses is None else (streams.poses,)
    for samples in (*streams.state, *streams.action, *poses):
        time_s = _since(streams, samples)
        yield StreamPreview(samples.name, time_s, find_gaps(time_s))


def _cloud(source: ParsedRecording, processor: FrameProcessor | None) -> CloudPreview | None:
    """The points of the first row."""
    seen, streams = source.frame_check, source.streams
    if processor is None:
        return None
    with suppress(BadImage):
        depth = processor.depth(streams.depth.read(int(seen.depth[0])))
        rgb = processor.color(streams.color.read(int(seen.color[0])))
        n = max(1, int(np.ceil(np.sqrt(depth.size / _CLOUD_POINTS))))
        v, u = np.nonzero(depth[::n, ::n])
        v, u = v * n, u * n
        xyz_world = processor.camera.unproject(np.stack([u, v], -1), depth[v, u])
        path = None if seen.T_world_cam is None else seen.T_world_cam[:, :3, 3]
        return CloudPreview(xyz_world, rgb[v, u], processor.camera, *_gripper(source), path)
    return None


def _gripper(source: ParsedRecording) -> tuple[Float64[np.ndarray, "T 3"] | None, str]:
    """The numbers of the state that may be the gripper's place, and which these are; only what can be one."""
    state = source.rows().state.astype(float)
    names = [name for s in source.streams.state for name in s.columns or [""] * s.values.shape[1]]
    columns = _coordinates(names)
    if columns is None or not len(state):
        return None, ""
    path, told = state[:, columns], ", ".join(names[c] for c in columns).strip(", ")
    reach = np.ptp(path, axis=0)
    if not np.isfinite(path).all() or not 0 < reach.max() < _REACH_M or np.abs(path).max() > 2 * _REACH_M:
        return None, ""
    return path, told or "numbers 1 to 3 of the state"


def _coordinates(names: Sequence[str]) -> list[int] | None:
    """Three columns that follow each other and are called x, y and z; the first three where none has a name."""
    if len(names) >= 3 and not any(names):
        return [0, 1, 2]
    for k in range(len(names) - 2):
        three = names[k : k + 3]
        if [n[-1:].lower() for n in three] == ["x", "y", "z"] and all(map(_PLACES.search, three)):
            return [k, k + 1, k + 2]
    return None
