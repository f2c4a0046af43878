"""The stages of recordings, with those they share. Each is a thin skin over the function that does the work."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from jaxtyping import Float32
from pydantic import model_validator

from flowlab.demonstrations import QueriedDemo, TrackedDemo
from flowlab.errors import DataError
from flowlab.geometry.camera import Camera
from flowlab.pipeline.stage import EpisodeRequest, Rejected, Stage
from flowlab.pipeline.stages.labeled import labeled
from flowlab.pipeline.stages.observe import ObserverStage, QueriesStage, read_as_a_whole
from flowlab.pipeline.stages.quality import QualityStage
from flowlab.pipeline.stages.write import WriteStage
from flowlab.provenance import Provenance
from flowlab.recordings.identity import changed_since, identity, wait_until_quiet
from flowlab.recordings.recording import Recording, RecordingSettings, open_recording
from flowlab.records import Clip, Episode, Queries
from flowlab.storage.recorded import CONTENT
from flowlab.tracking.base import make_tracker
from flowlab.tracking.chunking import ChunkSettings, follow
from flowlab.tracking.labeling import to_3d
from flowlab.tracking.lifting import LiftSettings

__all__ = [
    "LiftStage",
    "ObserverStage",
    "QualityStage",
    "QueriesStage",
    "RecordingStage",
    "TrackStage",
    "WriteStage",
]

WORLD_FRAME = (
    "each recording's own, as its T_world_cam says; where that is the identity, the axes of its camera: "
    "x right, y down, z forward"
)


class RecordingStage(Stage, RecordingSettings):
    """A recording is opened, its streams put on one time axis."""

    stage: str = "recording"

    def process(self, record: EpisodeRequest) -> Recording:
        """Open the recording that the request names."""
        path = Path(record.source)
        try:
            wait_until_quiet(path)
            content = identity(path, self)
            with read_as_a_whole(lambda: changed_since(content, path, self)):
                recording = open_recording(path, self, task=record.task, seed=record.seed)
        except DataError as error:
            raise Rejected(str(error), retry=True) from error
        return replace(recording, content=content, extras={**recording.extras, CONTENT: content})

    def describe(self, provenance: Provenance, task: str) -> Provenance:
        """Recorded, each in a world frame of its own; what the numbers of state and action mean is not known."""
        return provenance.model_copy(update={"kind": "recorded", "world_frame": WORLD_FRAME})


class TrackStage(Stage):
    """The query points are followed through the pictures."""

    stage: str = "track"
    tracker: str = "rigid-bodies"
    """Name of an installed tracker."""
    options: Mapping[str, Any] = {}
    """The tracker's own settings."""
    chunks: ChunkSettings = ChunkSettings()
    """How a recording is cut for trackers that take it in parts."""

    @model_validator(mode="after")
    def _tracker_exists(self) -> Self:
        make_tracker(self.tracker, self.options)
        return self

    def process(self, record: QueriedDemo) -> TrackedDemo:
        """Follow the points from their pixels in the first frame."""
        clip = clip_of(record)
        tracker = make_tracker(self.tracker, self.options)
        tracks = follow(clip, _first_pixels(record.queries, clip.camera), tracker, self.chunks)
        return TrackedDemo(record, tracks, tracker.describe())

    def describe(self, provenance: Provenance, task: str) -> Provenance:
        """The tracks are estimated."""
        return provenance.model_copy(update={"tracks": "estimated", "tracker": self.tracker})


def _first_pixels(queries: Queries, camera: Camera) -> Float32[np.ndarray, "M 2"]:
    """Where the queries are in the first picture (x, y): in the pixels they come from, as far as that is known."""
    if queries.pixel is None:
        return camera.project(queries.xyz_world.astype(np.float64))[0].astype(np.float32)
    v, u = np.divmod(queries.pixel, camera.width)
    return np.stack([u, v], -1).astype(np.float32)


def clip_of(record: QueriedDemo) -> Clip:
    """What a tracker works on. Raises :class:`Rejected` for a recording without color."""
    seen = record.observed
    if seen.rgb is None:
        raise Rejected("the recording has no color pictures, and points are followed in these; record color too")
    return Clip(seen.rgb, seen.depth, seen.demo.camera, seen.demo.T_world_cam)


class LiftStage(Stage, LiftSettings):
    """Tracks in the picture become tracks in the world, with what is known of their error."""

    stage: str = "lift"

    def process(self, record: TrackedDemo) -> Episode:
        """Lift the tracks by every frame's depth."""
        lifting = LiftSettings.model_validate(self.model_dump(exclude={"stage"}))
        tracks = to_3d(clip_of(record.queried), record.tracks, lifting)
        return labeled(record.queried, tracks, tracker=dict(record.tracker))
