"""The ``rigid-bodies`` tracker: queries carried by the motions of a fit."""

from dataclasses import dataclass, fields
from typing import ClassVar

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64
from pydantic import Field

from flowlab.records import Clip, PositionSource, Tracks2D
from flowlab.tracking.base import Tracker
from flowlab.tracking.chunking import ChunkSettings, follow
from flowlab.tracking.lifting import LiftSettings, lift
from flowlab.tracking.trackers.lucas_kanade import LucasKanade
from flowlab.tracking.trackers.rigid_bodies import doubt
from flowlab.tracking.trackers.rigid_bodies._surfaces import is_seen
from flowlab.tracking.trackers.rigid_bodies.choice import FollowedPoints
from flowlab.tracking.trackers.rigid_bodies.features import ClipFeatures, extract_features, large_enough
from flowlab.tracking.trackers.rigid_bodies.fit import fit_bodies
from flowlab.tracking.trackers.rigid_bodies.propagation import PropagatedTracks, propagate
from flowlab.tracking.trackers.rigid_bodies.slippage import slippage

_BELIEVED = 0.6
"""Confidence above which where a point was followed helps to tell its motion: what is thin is led astray at less."""
COMPANION = ChunkSettings(stride=16)
"""How points are followed in the pictures: on 41 films its own are as good as with twice as many chunks."""
_MIN_FRAMES = 3
"""A shorter clip shows no motion to fit."""


class RigidBodies(Tracker):
    """Rigid multi-body RGB-D tracking: a few motions, fitted to the whole clip, carry every point.

    A point that no motion explains, or that has no depth where it is asked for, is followed by
    :class:`~flowlab.tracking.trackers.lucas_kanade.LucasKanade` in chunks instead. Source: the method is flowlab's own;
    its parts are Horn (1987), RANSAC over trajectories, point-to-plane and photometric Gauss-Newton.
    """

    name: ClassVar[str] = "rigid-bodies"
    license: ClassVar[str] = "flowlab, Apache-2.0; no weights"
    chunked: ClassVar[bool] = False

    max_depth: float = Field(default=4.0, gt=0)
    """Depth beyond this [m] counts as missing."""
    unexplained: float = Field(default=1.2, gt=0)
    """Mean cost above which a motion does not explain a point."""
    seed: int = 0
    """Of the random choices; the same seed gives the same tracks."""

    def open(self, clip: Clip) -> "RigidBodiesSession":
        """Get ready to track points of a clip; the fit is made when it is known from which frame on."""
        return RigidBodiesSession(clip, self)


class RigidBodiesSession:
    """A clip to fit motions to."""

    def __init__(self, clip: Clip, options: RigidBodies) -> None:
        self._clip = clip
        self._options = options

    def track(self, queries_txy: Float32[np.ndarray, "M 3"], start: int, stop: int) -> Tracks2D:
        """See :class:`~flowlab.tracking.base.Session`; one fit is made for each frame that has queries.

        ``disagreement`` is how far apart the motions that explain a point almost as well would put it, or optical
        flow does, if that is more.
        """
        tracks = _blank(stop - start, queries_txy[:, 1:])
        frame = queries_txy[:, 0].astype(int)
        for first in np.unique(frame):
            mine = np.flatnonzero(frame == first)
            _put(tracks, mine, self._from(first, stop, queries_txy[mine, 1:]), np.s_[first - start :])
        return tracks

    def _from(self, first: int, stop: int, xy: np.ndarray) -> Tracks2D:
        """Follow points (M, 2) of frame ``first`` to the frame before ``stop``."""
        whole = self._clip
        poses = None if whole.T_world_cam is None else whole.T_world_cam[first:stop]
        clip = Clip(whole.rgb[first:stop], whole.depth[first:stop], whole.camera, poses)
        followed = follow(clip, xy, LucasKanade(), COMPANION)
        return combined(clip, followed, fit_points(clip, xy, followed, self._options), self._options.unexplained)


@dataclass(frozen=True, slots=True)
class FittedPoints:
    """Points that have depth, carried by the bodies of a clip."""

    pictures: ClipFeatures
    points: Int64[np.ndarray, "M"]
    """Which of those asked for."""
    carried: PropagatedTracks
    seen: Bool[np.ndarray, "T M"]
    """Whether the sensor sees them."""
    evidence: Float64[np.ndarray, "T M E"]
    """Against their positions, see :func:`~flowlab.tracking.trackers.rigid_bodies.doubt.evidence`."""


def fit_points(
    clip: Clip, xy: Float[np.ndarray, "N 2"], followed: Tracks2D, options: RigidBodies
) -> FittedPoints | None:
    """Fit bodies to a clip, and carry points of its first frame; None where it is too short or small, or has too little
    depth.

    Args:
        clip: The pictures.
        xy: Pixels of the points.
        followed: The same points, followed in the pictures.
        options: The tracker's.
    """
    z = depth_at(clip.depth[0], xy)
    deep = np.flatnonzero((z > 0) & (z < options.max_depth))
    if len(clip) < _MIN_FRAMES or len(deep) == 0 or not large_enough(clip):
        return None
    pictures = extract_features(clip, options.max_depth)
    fit, uv = fit_bodies(pictures, options.seed), pictures.from_clip_pixels(xy[deep])
    if not fit.grid.valid.any():
        return None
    beside = _lifted(clip, followed, deep)
    carried = propagate(fit, uv, z[deep], beside)
    xyz_cam = carried.xyz_cam
    seen = is_seen(clip.depth, pictures.to_clip_pixels(pictures.project(xyz_cam)), xyz_cam[..., 2])
    unseen = slippage(fit, pictures.unproject(uv.astype(np.float64), z[deep].astype(np.float64)))
    against = doubt.evidence(fit, carried, uv, z[deep], seen, beside.xyz_cam, unseen)
    return FittedPoints(pictures, deep, carried, seen, against)


def _lifted(clip: Clip, followed: Tracks2D, points: np.ndarray) -> FollowedPoints:
    """Some of the points that were followed, in the camera frame."""
    lifted = lift(clip, followed, LiftSettings())
    xyz_cam = clip.to_camera(lifted.xyz_world[:, points].astype(np.float64))
    alike = followed.visible & (followed.confidence > _BELIEVED)
    believed = alike & lifted.visible & (lifted.source == PositionSource.MEASURED)
    return FollowedPoints(xyz_cam, believed[:, points])


def combined(clip: Clip, followed: Tracks2D, fitted: FittedPoints | None, unexplained: float) -> Tracks2D:
    """Tracks of points as bodies carry them where that costs less than ``unexplained``, else as they were followed."""
    xy = followed.xy[0].copy()
    tracks = _blank(len(clip), xy)
    _put(tracks, np.arange(len(xy)), followed)
    if fitted is not None:
        explained = fitted.carried.cost < unexplained
        _put(tracks, fitted.points[explained], _modeled(clip, fitted, explained))
    # The first frame is the question, not an answer.
    tracks.xy[0], tracks.visible[0] = xy, True
    return tracks


def depth_at(depth: Float32[np.ndarray, "H W"], xy: Float[np.ndarray, "M 2"]) -> Float32[np.ndarray, "M"]:
    """The reading [m] at the pixel nearest to each point (M, 2); 0 where there is none."""
    column, row = np.rint(xy).astype(int).T
    inside = (column >= 0) & (row >= 0) & (column < depth.shape[1]) & (row < depth.shape[0])
    return np.where(inside, depth[np.where(inside, row, 0), np.where(inside, column, 0)], np.float32(0))


def _blank(frames: int, xy: np.ndarray) -> Tracks2D:
    """Points (M, 2) held where they are, unseen, with all that a track may have."""
    shape = (frames, len(xy))
    held = np.broadcast_to(xy.astype(np.float32), (*shape, 2)).copy()
    zero, minus = np.zeros(shape, np.float32), np.full(shape, -1, np.float32)
    nowhere = np.zeros((*shape, 3), np.float32)
    unknown = [minus.copy() for _ in range(3)]
    return Tracks2D(held, np.zeros(shape, bool), zero, minus, unknown[0], nowhere, *unknown[1:])


def _put(tracks: Tracks2D, columns: np.ndarray, part: Tracks2D, rows: slice = slice(None)) -> None:
    """Fill in the tracks of some points; what ``part`` does not tell stays."""
    for field in fields(Tracks2D):
        values = getattr(part, field.name)
        if values is not None:
            getattr(tracks, field.name)[rows, columns] = values


def _modeled(clip: Clip, fitted: FittedPoints, of: np.ndarray) -> Tracks2D:
    """Tracks of the points ``of`` as their motions carry them; in sight is what the whole depth pictures show."""
    pictures, carried = fitted.pictures, fitted.carried
    xyz = carried.xyz_cam[:, of]
    z = xyz[..., 2]
    ahead = z > 0.05
    # A point that the motion takes behind the camera is nowhere in the picture: it is left at its border.
    size = pictures.clip_size
    xy = np.clip(pictures.to_clip_pixels(pictures.project(xyz)), -size, 2 * size)
    cost = np.broadcast_to(carried.cost[of], z.shape)
    focal = pictures.K[0, 0] * pictures.factor
    apart = np.maximum(carried.spread[:, of], carried.slip[:, of])
    return Tracks2D(
        xy.astype(np.float32),
        fitted.seen[:, of],
        (1 - cost).clip(0, 1).astype(np.float32),
        disagreement=(apart * focal / np.maximum(z, 0.05)).astype(np.float32),
        xyz_cam=np.where(ahead[..., None], xyz, 0).astype(np.float32),
        residual=carried.residual[:, of],
        sigma=doubt.stated_error(fitted.evidence[:, of], z).astype(np.float32),
    )
