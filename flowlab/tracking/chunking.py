"""Following points through long clips in overlapping chunks: each starts where the ones before have led."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32
from pydantic import Field, model_validator

from flowlab.config import Settings
from flowlab.records import Clip, Tracks2D
from flowlab.tracking.base import Tracker

LEAST_WEIGHT = 0.01
"""Of a chunk that has lost a point: where all have, the point is still somewhere."""

SEEN_SHARE = 1 / 3
"""A point is seen where chunks with this share of the weight see it: the later ones know its look of today best."""


class ChunkSettings(Settings):
    """Which chunks a clip is cut into. The paper (3D FDP, real-world data) has 33 frames, and one every frame."""

    length: int = Field(default=33, ge=2)
    """Frames of a chunk."""
    stride: int = Field(default=8, ge=1)
    """Frames from the start of one chunk to the start of the next. On eight simulated tasks, as many Lucas-Kanade
    tracks come within 20 mm with 8 as with 1, to 2 %, at an eighth of the cost."""

    @model_validator(mode="after")
    def _overlapping(self) -> "ChunkSettings":
        """Refuse chunks that leave a gap."""
        if self.stride >= self.length:
            raise ValueError(f"stride ({self.stride}) must be below length ({self.length}): chunks have to overlap")
        return self


def follow(clip: Clip, queries_xy: Float32[np.ndarray, "M 2"], tracker: Tracker, settings: ChunkSettings) -> Tracks2D:
    """Follow points of frame 0 through a clip.

    A tracker that wants the clip whole gets it whole. Else every chunk is asked for all points where the chunks
    before it have put them at its first frame, and a point's position in a frame is that of the chunk that most
    agrees with all others there, weighted by their confidence; how far the others are from it is kept as
    ``disagreement``.

    What is lost stays lost: a chunk has no way to know whether its first frame shows the point or something in
    front of it, so its confidence is multiplied by what its start deserves, and where the point was not visible
    at its start the chunk cannot make it visible. Only one that began while the point was in sight can find it
    again; a point out of sight for about ``length - stride`` frames is not found again. Of a model's positions and
    residual nothing is kept: a tracker that fits one wants the clip whole.
    """
    session = tracker.open(clip)
    if not tracker.chunked:
        return session.track(_queries(queries_xy, 0), 0, len(clip))
    stitched, active = _started(queries_xy, len(clip)), list[_Chunk]()
    for start in range(0, len(clip) - 1, settings.stride):
        stop = min(start + settings.length, len(clip))
        tracks = session.track(_queries(stitched.xy[start], start), start, stop)
        active = [c for c in active if c.stop > start + 1] + [_Chunk(start, stop, _inherited(tracks, stitched, start))]
        for t in range(start + 1, min(start + settings.stride + 1, len(clip))):
            _merge(stitched, t, [c for c in active if t < c.stop])
    return stitched


@dataclass(frozen=True, slots=True)
class _Chunk:
    """Frames ``start`` to ``stop - 1`` of a clip."""

    start: int
    stop: int
    tracks: Tracks2D

    def row(self, t: int) -> tuple[np.ndarray, ...]:
        """Position, visibility, confidence and forward-backward error of all points in frame t of the clip."""
        k, error = t - self.start, self.tracks.forward_backward
        confidence = self.tracks.confidence[k]
        unmeasured = np.full_like(confidence, -1)
        return self.tracks.xy[k], self.tracks.visible[k], confidence, unmeasured if error is None else error[k]


def _queries(xy: np.ndarray, t: int) -> np.ndarray:
    """Queries (M, 3) as (t, x, y) of points (M, 2) in frame t."""
    return np.insert(xy, 0, t, axis=1).astype(np.float32)


def _started(queries_xy: np.ndarray, frames: int) -> Tracks2D:
    """Tracks through a clip of which frame 0 is known."""
    shape = (frames, len(queries_xy))
    xy = np.broadcast_to(queries_xy.astype(np.float32), (*shape, 2)).copy()
    visible, error, disagreement = np.zeros(shape, bool), *np.full((2, *shape), -1, np.float32)
    visible[:1], error[:1] = True, 0
    return Tracks2D(xy, visible, visible.astype(np.float32), error, disagreement)


def _inherited(tracks: Tracks2D, stitched: Tracks2D, start: int) -> Tracks2D:
    """The tracks of a chunk, none surer than where they start."""
    visible, confidence = stitched.visible[start], stitched.confidence[start]
    return replace(tracks, visible=tracks.visible & visible, confidence=tracks.confidence * confidence * visible)


def _merge(stitched: Tracks2D, t: int, chunks: list[_Chunk]) -> None:
    """Fill in frame t from the chunks that cover it."""
    xy, visible, confidence, error = (np.stack(v) for v in zip(*(c.row(t) for c in chunks), strict=True))
    weight = np.maximum(confidence, LEAST_WEIGHT)
    total = weight.sum(0)
    distance = (weight[:, None] * np.linalg.norm(xy[:, None] - xy[None], axis=-1)).sum(0)
    chosen = distance.argmin(0), np.arange(xy.shape[1])
    stitched.xy[t] = xy[chosen]
    stitched.visible[t] = (weight * visible).sum(0) > SEEN_SHARE * total
    stitched.confidence[t] = (weight * confidence).sum(0) / total
    assert stitched.forward_backward is not None
    assert stitched.disagreement is not None
    stitched.forward_backward[t] = error[chosen]
    if len(chunks) > 1:
        stitched.disagreement[t] = distance[chosen] / (total - weight[chosen])
