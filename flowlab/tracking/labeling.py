"""Labeling: from a clip and the points to follow to 3D tracks and what is known of their error."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float32

from flowlab.records import Clip, Quality, Tracks2D, Tracks3D
from flowlab.tracking.base import Tracker
from flowlab.tracking.chunking import ChunkSettings, follow
from flowlab.tracking.lifting import LiftSettings, lift
from flowlab.tracking.sight import sight_of
from flowlab.tracking.uncertainty import stated_error


def label_clip(
    clip: Clip, queries_xy: Float32[np.ndarray, "M 2"], tracker: Tracker, chunks: ChunkSettings, lifting: LiftSettings
) -> tuple[Tracks2D, Tracks3D]:
    """Follow pixels of the first frame through a clip, in the picture and in the world."""
    tracks = follow(clip, queries_xy, tracker, chunks)
    return tracks, to_3d(clip, tracks, lifting)


def to_3d(clip: Clip, tracks: Tracks2D, lifting: LiftSettings) -> Tracks3D:
    """Tracks in the world from tracks in the picture, with their quality."""
    lifted = lift(clip, tracks, lifting)
    unknown = np.full(tracks.visible.shape, -1, np.float32)
    forward_backward, disagreement, residual = (
        unknown if x is None else x for x in (tracks.forward_backward, tracks.disagreement, tracks.residual)
    )
    start_of_track = np.zeros(tracks.visible.shape[1], np.float32)
    labels = Tracks3D(lifted.xyz_world, lifted.visible, start_of_track)
    quality = Quality(
        stated_error(clip, tracks, lifted), lifted.source, lifted.depth_valid, forward_backward, disagreement, residual,
        sight_of(clip, labels),
    )  # fmt: skip
    return replace(labels, quality=quality)
