"""Lifting: from where points are in the picture, and the depth read there, to where they are in the world."""

from dataclasses import dataclass

import numba
import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8
from pydantic import Field

from flowlab.config import Settings
from flowlab.geometry.transforms import apply, inverse
from flowlab.records import Clip, PositionSource, Tracks2D

MEASURED, MODEL, FILLED = int(PositionSource.MEASURED), int(PositionSource.MODEL), int(PositionSource.FILLED)


class LiftSettings(Settings):
    """Which of the depths around a point is the point's own.

    Readings near an edge belong to two surfaces or more. The one that continues the depth at which the point was
    last known is its own; if none does, something is in front of the point, or the point is not there.
    """

    window_px: int = Field(default=2, ge=0, le=7)
    """Readings up to this many rows and columns from the point's pixel are looked at."""
    spread_px: float = Field(default=0.8, gt=0)
    """Width of the Gaussian around the point by which the readings of its layer are averaged."""
    nearness_m_per_px: float = Field(default=0.005, ge=0)
    """How much better a reading that is a pixel farther away must continue the point's depth to be its own."""
    noise_m_per_m2: float = Field(default=0.005, ge=0)
    """Scatter of readings of one surface [m], times the square of its distance; in cameras that triangulate
    it grows so."""
    layer_m: float = Field(default=0.01, gt=0)
    """Depth of a layer [m], to either side of that reading and beyond the scatter."""
    jump_m: float = Field(default=0.02, gt=0)
    """How far a point may move in depth between two frames [m], beyond twice the scatter."""
    unseen_m: float = Field(default=0.005, ge=0)
    """How much farther it may have moved [m] for every frame out of sight or in a hole of the depth picture.
    Nothing is added while another surface is read there: whatever stays in front of a point would become it."""
    reach_m: float = Field(default=0.1, ge=0)
    """The most that may be added so [m]."""


@dataclass(frozen=True, slots=True)
class Lifted:
    """Tracks in the world, and how each position came about."""

    xyz_world: Float32[np.ndarray, "T M 3"]
    """[m]; finite everywhere."""
    visible: Bool[np.ndarray, "T M"]
    """Whether the tracker sees the point and depth does not contradict it; a hole in the depth picture does not."""
    source: UInt8[np.ndarray, "T M"]
    """The :class:`~flowlab.records.PositionSource` of every position."""
    depth_valid: Bool[np.ndarray, "T M"]
    """Whether the sensor gave a depth at the point's pixel, or beside it, that fits the point."""


def lift(clip: Clip, tracks: Tracks2D, settings: LiftSettings) -> Lifted:
    """Tracks in the world from tracks in the picture, of points queried at frame 0.

    At frame 0 a point is where its own pixel is read. Afterwards it is where the tracker's model of the motion puts
    it (``xyz_cam``), if there is one; else, where the tracker sees it and a layer of the depth around it continues
    the point, it is measured; else it is filled. Where the tracker sees a point in a hole of the depth picture, it is
    filled on the ray of its pixel, at a depth between those known before and after; elsewhere in a straight line
    between such instants, held before the first and after the last. A point of which no depth is ever known is filled
    at the median depth of the clip (1 m in a clip without depth).

    Args:
        clip: The pictures, depth [m] among them.
        tracks: Pixels of every point in every frame.
        settings: Which readings around a pixel are the point's own.

    Returns:
        Positions in the world frame [m], and how each came about.
    """
    model = np.zeros((*tracks.visible.shape, 3), np.float32) if tracks.xyz_cam is None else tracks.xyz_cam
    in_camera = clip.camera.at(np.eye(4))
    z, source, depth_valid, hidden = _read(
        clip.depth,
        tracks.xy,
        tracks.visible,
        model[..., 2],
        _depth_if_still(clip),
        in_camera.unproject(tracks.xy, np.ones(tracks.visible.shape)),
        window_px=settings.window_px,
        spread_px=settings.spread_px,
        nearness_m_per_px=settings.nearness_m_per_px,
        noise_m_per_m2=settings.noise_m_per_m2,
        layer_m=settings.layer_m,
        jump_m=settings.jump_m,
        unseen_m=settings.unseen_m,
        reach_m=settings.reach_m,
    )
    known = source != FILLED
    never = ~known.any(0)
    if never.any():
        readings = clip.depth[clip.depth > 0]
        z[0, never], known[0, never] = np.median(readings) if len(readings) else 1.0, True
    visible = tracks.visible & ~hidden
    z = _between(z[..., None], known)[..., 0]
    xyz_world = clip.to_world(in_camera.unproject(tracks.xy, z))
    rows, points = np.nonzero(source == MODEL)
    T_world_cam = clip.camera.T_world_cam if clip.T_world_cam is None else clip.T_world_cam[rows]
    xyz_world[rows, points] = apply(T_world_cam, model[rows, points].astype(np.float64))
    xyz_world = _between(xyz_world, known | visible)
    return Lifted(xyz_world.astype(np.float32), visible, source, depth_valid)


def _depth_if_still(clip: Clip) -> Float64[np.ndarray, "T 4"]:
    """Row t gives the depth in frame t of what stands still in the world, from where it was in frame t - 1."""
    poses = clip.poses()
    forward = np.tile(np.array([0.0, 0, 1, 0]), (len(clip), 1))
    if clip.T_world_cam is not None:
        forward[1:] = (inverse(poses[1:]) @ poses[:-1])[:, 2]
    return forward


def _between(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """``values`` (T, M, D) with what is not ``known`` (T, M) interpolated in time, and held at both ends."""
    t = np.arange(len(values))
    for m in np.flatnonzero(~known.all(0)):
        at = known[:, m]
        for axis in range(values.shape[2]):
            values[:, m, axis] = np.interp(t, t[at], values[at, m, axis])
    return values


@numba.njit(cache=True)
def _read(  # type: ignore[no-untyped-def]
    depth,
    xy,
    visible,
    model_z,
    forward,
    rays,
    window_px,
    spread_px,
    nearness_m_per_px,
    noise_m_per_m2,
    layer_m,
    jump_m,
    unseen_m,
    reach_m,
) -> tuple[np.ndarray, ...]:
    """Depth, source, whether a reading fits, and whether something else was read instead: (T, M) each."""
    steps, points = visible.shape
    z, source = np.zeros((steps, points)), np.full((steps, points), FILLED, np.uint8)
    fits, hidden = np.zeros((steps, points), np.bool_), np.zeros((steps, points), np.bool_)
    side = 2 * window_px + 1
    around, distance = np.empty(side * side), np.empty(side * side)
    for m in range(points):
        last, extra = 0.0, 0.0  # depth where last known, and how much farther it may have moved since
        for t in range(steps):
            u, v = xy[t, m]
            if t > 0 and last > 0:  # what comes nearer only because the camera does has not moved
                x, y, _ = rays[t - 1, m]
                last = (forward[t, 0] * x + forward[t, 1] * y + forward[t, 2]) * last + forward[t, 3]
            own = _own_reading(depth[t], u, v)
            count = _readings(depth[t], u, v, window_px, around, distance)
            if t == 0 and own > 0:
                z[t, m], source[t, m], fits[t, m] = own, MEASURED, True
            elif model_z[t, m] > 0:
                z[t, m], source[t, m] = model_z[t, m], MODEL
                nearest = _continuing(around[:count], distance[:count], z[t, m], nearness_m_per_px)
                fits[t, m] = abs(nearest - z[t, m]) < jump_m + 2 * noise_m_per_m2 * z[t, m] ** 2
            elif visible[t, m] and own >= 0 and count > 0:
                nearest = _continuing(around[:count], distance[:count], last, nearness_m_per_px)
                fits[t, m] = last == 0 or abs(nearest - last) < jump_m + 2 * noise_m_per_m2 * last**2 + extra
                hidden[t, m] = not fits[t, m]
                if fits[t, m]:
                    thickness = layer_m + noise_m_per_m2 * nearest**2
                    z[t, m] = _layer_mean(around[:count], distance[:count], nearest, thickness, spread_px)
                    source[t, m] = MEASURED
            else:
                hidden[t, m] = own < 0
                extra = min(extra + unseen_m, reach_m)
            if source[t, m] != FILLED:
                last, extra = z[t, m], 0.0
    return z, source, fits, hidden


@numba.njit(cache=True)
def _own_reading(depth, u, v) -> float:  # type: ignore[no-untyped-def]
    """Depth at the nearest pixel; -1 outside the picture."""
    column, row = int(np.rint(u)), int(np.rint(v))
    inside = 0 <= row < depth.shape[0] and 0 <= column < depth.shape[1]
    return np.float64(depth[row, column]) if inside else -1.0


@numba.njit(cache=True)
def _readings(depth, u, v, window, around, distance) -> int:  # type: ignore[no-untyped-def]
    """Fill in the depths in the window around a point, and their pixels' distances from it; how many there are."""
    column, row = int(np.rint(u)), int(np.rint(v))
    count = 0
    for y in range(max(row - window, 0), min(row + window + 1, depth.shape[0])):
        for x in range(max(column - window, 0), min(column + window + 1, depth.shape[1])):
            if depth[y, x] > 0:
                around[count], distance[count] = depth[y, x], np.hypot(x - u, y - v)
                count += 1
    return count


@numba.njit(cache=True)
def _continuing(around, distance, last, nearness) -> float:  # type: ignore[no-untyped-def]
    """The reading that best continues depth ``last``, or the nearest where that is not known (0); inf if none."""
    best, cost = np.inf, np.inf
    for z, d in zip(around, distance):  # noqa: B905 (numba)
        c = nearness * d + (abs(z - last) if last > 0 else 0.0)
        if c < cost:
            best, cost = z, c
    return best


@numba.njit(cache=True)
def _layer_mean(around, distance, z, thickness, spread) -> float:  # type: ignore[no-untyped-def]
    """Mean of the readings that lie within ``thickness`` of depth ``z``, weighted by nearness to the point."""
    total, weight = 0.0, 0.0
    for other, d in zip(around, distance):  # noqa: B905
        if abs(other - z) < thickness:
            w = np.exp(-0.5 * (d / spread) ** 2)
            total, weight = total + w * other, weight + w
    return total / weight
